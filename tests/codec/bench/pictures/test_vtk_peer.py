"""VTK gets the same scene, whichever of its mappers draws it."""

from __future__ import annotations

import numpy as np
import pytest
from blobs import CAMERAS, SIZE, drawn, field, task

from fhash_codec.bench.pictures.likeness import black, picture_psnr
from fhash_codec.bench.pictures.reference import vtk_picture
from fhash_codec.bench.pictures.vtk_peer import VtkPeer
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame
from fhash_codec.rendering.scenes import Camera


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
