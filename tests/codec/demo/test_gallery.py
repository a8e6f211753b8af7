"""The series of the gallery: the kinds that its pictures are about."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.demo.gallery import GALLERY_SERIES, PICTURES
from fhash_codec.rendering.camera.grid import Grid


@pytest.mark.parametrize("name", sorted(set(GALLERY_SERIES) - {"blast"}))
def test_a_series_has_values_and_is_the_same_again(name: str) -> None:
    first, second = GALLERY_SERIES[name].make(), GALLERY_SERIES[name].make()
    assert first.shape == (first.shape[0], *first.read(0).shape)
    np.testing.assert_array_equal(first.read(1), second.read(1))
    assert 0.3 < np.isfinite(first.read(0)).mean() <= 1
    assert first.coords["t"].attributes["units"] == "s"


def test_there_is_a_plane_a_depth_and_uneven_axes() -> None:
    grids = {name: Grid.of(GALLERY_SERIES[name].make().coords) for name in ("sea", "ocean", "jet")}
    assert grids["sea"].flat
    assert grids["sea"].warp is None
    for name in ("ocean", "jet"):
        assert grids[name].warp is not None
        assert grids[name].scale[2] < 0


def test_every_picture_is_of_a_series() -> None:
    assert {picture.series for picture in PICTURES} == set(GALLERY_SERIES)
    assert len({picture.name for picture in PICTURES}) == len(PICTURES)
