"""Comparisons with VTK: the domain, the transfer functions and the sides of a turn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from blobs import SHAPE, axes, field

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.bench.pictures.beside_vtk import Comparison, transfer_functions, turned
from fhash_codec.rendering.march_task import Units
from fhash_codec.rendering.scenes import Camera, Scene
from fhash_formats.series import ArraySeries


def test_transfer_functions_are_of_the_values() -> None:
    values = field()[1]
    found = transfer_functions(values, Units())
    feature = np.array(found["feature"].opacity)
    assert np.all(np.diff(feature[:, 0]) > 0)
    inside = (values > feature[0, 0]) & (values < feature[-1, 0])
    assert 0.01 < inside.mean() < 0.2
    np.testing.assert_allclose(
        found["fog"].opacity, [(values.min(), 0), (values.max(), 0.02)], atol=1e-6
    )
    flat = np.array(
        transfer_functions(np.full((2, 2, 2), 3.0, dtype=np.float32), Units())["feature"].opacity
    )
    assert np.all(np.diff(flat[:, 0]) > 0)


def test_sides_are_spread_over_a_turn() -> None:
    scene = Scene(camera=Camera(azimuth=30))
    assert [turned(scene, turn, 4).camera.azimuth for turn in range(4)] == [30, 120, 210, 300]


def test_a_comparison_is_of_the_whole_domain(tmp_path: Path) -> None:
    path = tmp_path / "part.fhz"
    series = ArraySeries(field(), name="density", units="", coords=axes())
    fhash_codec.encode(
        series, path, EncodeConfig(features=("interval:0.5:2",), effort=1, max_error=0.002)
    )
    with fhash_codec.open(path) as opened:
        found = Comparison(opened, Scene(size=(16, 16)), 1, lambda *report: None)
    assert found.values.shape == SHAPE[1:]
    assert np.isfinite(found.values).all()
