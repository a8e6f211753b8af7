"""Tiles by prediction under a tight bound: the bound is kept, and training pays."""

from __future__ import annotations

import numpy as np
import pytest

import fhash_codec
from fhash_codec.compact.choices import predictor as prediction
from fhash_codec.compact.choices.predictor import fit
from fhash_formats.transform.entropy.predict import encode_predicted
from fhash_formats.transform.entropy.predictor import Predictor, passes_of


def _rough(dtype):
    """Noise between two ends, which a bound cuts into few values: nothing for a transform."""
    return np.random.default_rng(0).uniform(0, 1000, (6, 16, 24, 24)).astype(dtype)


@pytest.mark.parametrize("dtype", ["float32", "float64", "uint16"])
def test_a_file_by_prediction_keeps_the_bound(tmp_path, monkeypatch, dtype):
    choose = prediction.choose_predictor
    monkeypatch.setattr(
        prediction, "choose_predictor", lambda *given, **named: (choose(*given, **named)[0], 0)
    )
    values = _rough(dtype)
    path = tmp_path / "a.fhz"
    report = fhash_codec.encode(values, path, fhash_codec.EncodeConfig(max_error=100.5, effort=3))
    assert "prediction" in [gain["what"] for gain in report["gains"]]
    with fhash_codec.open(path) as volume:
        decoded = volume[...]
    assert np.abs(decoded.astype(np.float64) - values.astype(np.float64)).max() <= 100.5


def test_trained_weights_beat_none():
    y, x = np.meshgrid(np.arange(48), np.arange(48), indexing="ij")
    frame = 3000 * np.sin(x / 7 + y / 11) + 2000 * np.cos(x / 5 - y / 6)
    integers = np.rint(np.stack([frame * (1 + 0.1 * t) for t in range(4)])).astype(np.int32)[
        :, None
    ]
    levels, order, sizes = (0, 0, 3, 3), (0, 1, 2, 3), []
    nothing = (0,) * sum(len(part.taps) for part in passes_of(levels, order, 1))
    for weights in (fit([(integers, None)], levels, order, 1), nothing):
        predictor = Predictor(
            step=1.0, origin=0.0, levels=levels, order=order, reach=1, weights=weights
        )
        sizes.append(len(encode_predicted(integers, None, predictor)[0]))
    assert sizes[0] < 0.8 * sizes[1]
