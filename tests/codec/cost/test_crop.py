"""Crops of a series: as large as asked for, around its middle, the same values."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest

from fhash_codec.cost.crop import MIN_STEPS, CroppedSeries, cropped, described
from fhash_formats.errors import RegionError
from fhash_formats.series import ArraySeries


def array(shape: tuple[int, ...]) -> ArraySeries:
    return ArraySeries(np.arange(prod(shape), dtype=np.float32).reshape(shape))


def test_a_series_that_is_small_enough_stays_whole() -> None:
    series = array((3, 4, 5, 6))
    assert cropped(series, prod(series.shape)) is series
    assert described(series) == "the whole series"


@pytest.mark.parametrize("vertices", [20_000, 3000, 200, 1])
def test_a_crop_has_about_the_vertices_asked_for(vertices: int) -> None:
    series = array((20, 1, 30, 40))
    crop = cropped(series, vertices)
    assert isinstance(crop, CroppedSeries)
    assert prod(crop.shape) <= 1.3 * vertices + 2 * MIN_STEPS
    assert crop.shape[0] >= MIN_STEPS
    assert crop.shape[1] == 1
    (t, *_), (_, y, x) = (crop.steps[0],), crop.region
    expected = series.values[t : t + crop.shape[0], :, slice(*y), slice(*x)]
    np.testing.assert_array_equal(np.stack(list(crop.frames())), expected)
    assert crop.coords["x"].values[0] == x[0]
    assert "a crop, " in described(crop)
    assert f"x {x[0]}:{x[1]}" in described(crop)
    with pytest.raises(RegionError):
        crop.read(crop.shape[0])
