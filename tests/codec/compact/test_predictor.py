"""Tiles by prediction under a tight bound: the bound is kept, and training pays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec.compact import predictor as choice
from fhash_codec.compact.predictor import IntegerTile, best_predictor, fit_weights
from fhash_formats.transform.predict import Predictor, encode_predicted, passes_of


def rough(dtype: str) -> npt.NDArray[Any]:
    """Return noise between two ends, which a bound cuts into few values: no use for a transform."""
    return np.random.default_rng(0).uniform(0, 1000, (4, 12, 16, 16)).astype(dtype)


@pytest.mark.parametrize("dtype", ["float32", "float64", "uint16"])
def test_a_file_by_prediction_keeps_the_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dtype: str
) -> None:
    def of_no_bytes(*given: Any, **named: Any) -> tuple[Predictor, int]:
        best = best_predictor(*given, **named)
        assert best is not None
        return best[0], 0

    monkeypatch.setattr(choice, "best_predictor", of_no_bytes)
    values = rough(dtype)
    path = tmp_path / "a.fhz"
    report = fhash_codec.encode(values, path, fhash_codec.EncodeConfig(max_error=100.5, effort=3))
    assert "prediction" in [gain["what"] for gain in report["gains"]]
    with fhash_codec.open(path) as volume:
        decoded = volume[...]
    assert np.abs(decoded.astype(np.float64) - values.astype(np.float64)).max() <= 100.5


def test_trained_weights_beat_none() -> None:
    y, x = np.meshgrid(np.arange(48), np.arange(48), indexing="ij")
    frame = 3000 * np.sin(x / 7 + y / 11) + 2000 * np.cos(x / 5 - y / 6)
    steps = np.stack([frame * (1 + 0.1 * t) for t in range(4)])
    integers = np.rint(steps).astype(np.int32)[:, None]
    levels, order = (0, 0, 3, 3), (0, 1, 2, 3)
    trained = fit_weights([IntegerTile(integers, None)], levels, order, 1)
    zeros = (0,) * sum(len(refinement.taps) for refinement in passes_of(levels, order, 1))
    sizes = []
    for weights in (trained, zeros):
        predictor = Predictor(
            step=1.0, origin=0.0, levels=levels, order=order, reach=1, weights=weights
        )
        sizes.append(len(encode_predicted(integers, None, predictor)[0]))
    assert sizes[0] < 0.8 * sizes[1]
