"""The picture by VTK's conventions is VTK's picture."""

from __future__ import annotations

import pytest
from blobs import CAMERAS, drawn, field, task

from fhash_codec.bench.pictures.likeness import black, picture_psnr
from fhash_codec.bench.pictures.reference import vtk_picture
from fhash_codec.rendering.scenes import Camera


@pytest.mark.parametrize("camera", CAMERAS, ids=["turned", "parallel", "near"])
@pytest.mark.parametrize("shaded", [False, True], ids=["unlit", "lit"])
def test_vtk_by_its_own_rules_is_the_reference(camera: Camera, shaded: bool) -> None:
    values, asked = field()[1], task(camera, shaded=shaded, step=0.4)
    theirs = drawn(asked, values)
    assert theirs.max() > 60
    psnr = picture_psnr(black(vtk_picture(values, asked)), theirs, 255.0)
    assert psnr is None or psnr > 50
