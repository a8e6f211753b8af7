"""Decoding by the coreset alone beside the whole box: what is decoded, and the figures."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from fhash_codec.bench import decode
from fhash_codec.bench.decode import TURNS, bench_decode
from fhash_codec.features.bricks import build_coreset
from fhash_codec.features.features import FeatureChoice, Interval
from fhash_codec.features.occupancy import unpack
from fhash_codec.features.scan import scan
from fhash_codec.paper.network import Architecture
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def test_both_ways_decode_the_same_key_frames(
    field: Callable[..., np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock of one second a call to the decoder, two for the whole box."""
    values = np.zeros((7, 8, 40, 70), np.float32)
    values[:, 2:4, 3:5, 1:9] = 1.0
    values[:, 7, 39, 69] = 1.0
    series = ArraySeries(values)
    features = [Interval(0.5, 2.0)]
    coreset = build_coreset(series, scan(series, silent), FeatureChoice(range(7), features), silent)
    box = coreset.box.shape
    architecture = Architecture.for_box(box, 7, width=4)
    layers = [
        (np.ones((out, inputs), np.float32), np.ones(out, np.float32))
        for out, inputs in architecture.layer_shapes
    ]
    seen, now = [], [0.0]

    def decoded(network, key, region, *, requested):
        now[0] += 2.0 if requested.sum() > 33 else 1.0
        seen.append((key, requested))
        assert network.levels == architecture.levels

    monkeypatch.setattr(decode, "decode_region", decoded)
    monkeypatch.setattr(decode, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    figures = bench_decode(architecture, coreset, layers)
    assert figures["decode_ratio"] == 2.0
    assert figures["decode_msamples_s"] == pytest.approx(33e-6)
    keys = [0.0, 2.0, 4.0, 6.0]
    assert [key for key, _ in seen] == (keys + keys) * TURNS
    mask, whole = seen[0][1], seen[4][1]
    np.testing.assert_array_equal(mask, unpack(coreset.occupancy[0], box))
    assert whole.all()
