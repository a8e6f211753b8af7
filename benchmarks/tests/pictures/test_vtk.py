"""Comparisons with VTK: the domain, the transfer functions and the sides of a turn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blobs import CAMERAS, SHAPE, SIZE, axes, drawn, field, task

import fhash_codec
from fhash_bench.pictures.vtk import Comparison, VtkPeer, transfer_functions, turned, vtk_picture
from fhash_codec import EncodeConfig
from fhash_codec.cost.uses import black, picture_psnr
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Units
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


@pytest.mark.parametrize("camera", CAMERAS, ids=["turned", "parallel", "near"])
@pytest.mark.parametrize("shaded", [False, True], ids=["unlit", "lit"])
def test_vtk_by_its_own_rules_is_the_reference(camera: Camera, shaded: bool) -> None:
    values, asked = field()[1], task(camera, shaded=shaded, step=0.4)
    theirs = drawn(asked, values)
    assert theirs.max() > 60
    psnr = picture_psnr(black(vtk_picture(values, asked)), theirs, 255.0)
    assert psnr is None or psnr > 50


@pytest.mark.parametrize("camera", CAMERAS, ids=["turned", "parallel", "near"])
def test_the_same_picture_as_vtk_unlit(camera: Camera) -> None:
    values, asked = field()[1], task(camera, shaded=False, step=0.05)
    ours = black(march(Frame(values=values, first=(0, 0, 0)), asked).rgba)
    psnr = picture_psnr(ours, drawn(asked, values), 255.0)
    assert psnr is None or psnr > 50


def test_the_ray_caster_of_vtk_gets_the_same_scene() -> None:
    values, asked = field()[1], task(CAMERAS[0], shaded=False, step=0.5)
    psnr = picture_psnr(black(vtk_picture(values, asked)), drawn(asked, values, "cpu"), 255.0)
    assert psnr is None or psnr > 35


def test_vtk_takes_up_another_frame_and_an_empty_window_is_black() -> None:
    asked = task(CAMERAS[0], shaded=False, step=0.5)
    assert asked.table is not None
    first, last = field()[0], field()[3]
    peer = VtkPeer(first, asked.rays.grid, asked.table, unit=1.0, size=SIZE, step=0.5)
    empty = VtkPeer(first, asked.rays.grid, asked.table, unit=1.0, size=SIZE, step=0.5, empty=True)
    peer.look(asked.rays)
    before = peer.draw().pixels
    peer.load(last)
    after = peer.draw()
    np.testing.assert_array_equal(after.pixels, drawn(asked, last, "cpu"))
    assert not np.array_equal(before, after.pixels)
    assert after.seconds > 0
    assert not empty.draw().pixels.any()
    assert "VTK 9" in peer.version
    peer.close()
    empty.close()
