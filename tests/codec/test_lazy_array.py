"""A lazy array has the dimensions of the source in their order, whatever is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from cf_files import smooth
from xarray.core import indexing

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.lazy_array import FhashArray, Form

DIMENSIONS = {"lon": "x", "one": "", "time": "t", "lat": "y"}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> tuple[Path, np.ndarray]:
    """A container of one level, and its values as (x, 1, t, y)."""
    path = tmp_path_factory.mktemp("lazy") / "run.fhz"
    config = EncodeConfig(effort=1, psnr=30, without=("ssim",), tile="2x1x4x4")
    fhash_codec.encode(smooth(4, 1, 9, 7), path, config)
    with fhash_codec.open(path) as volume:
        return path, volume[:, 0].transpose(2, 0, 1)[:, None]


def array(path: Path, **form: Any) -> FhashArray:
    options = {"dimensions": DIMENSIONS, "lod": None, "outside": "nan", **form}
    return FhashArray(str(path), "values", Form(**options), None)


@pytest.mark.parametrize(
    "key",
    [
        (slice(None),) * 4,
        (3, 0, -1, 2),
        (slice(6, 1, -2), 0, slice(1, 3), slice(None)),
        (slice(2, 5), slice(None), 1, slice(8, None)),
        (slice(0, 0), slice(0, 0), 0, slice(None)),
        (5, slice(None, None, -1), slice(3, None, -3), 0),
    ],
)
def test_keys_are_those_of_numpy(run, key: tuple[Any, ...]) -> None:
    path, whole = run
    lazy = array(path)
    assert (lazy.shape, lazy.dtype) == (whole.shape, whole.dtype)
    np.testing.assert_array_equal(lazy[indexing.BasicIndexer(key)], whole[key])


def test_arrays_of_indices_are_taken(run) -> None:
    path, whole = run
    variable = xr.Variable(tuple(DIMENSIONS), indexing.LazilyIndexedArray(array(path)))
    found = variable[[6, 0, 3], 0, :, [1, 1]].values
    np.testing.assert_array_equal(found, whole[[6, 0, 3], 0][:, :, [1, 1]])


def test_chunks_are_the_tiles_of_the_dimensions(run) -> None:
    path, _ = run
    with fhash_codec.open(path) as volume:
        form = Form(dimensions=DIMENSIONS, lod=None, outside="nan")
        t, _, y, x = volume.chunks
        assert form.chunks(volume) == {"lon": x, "one": 1, "time": t, "lat": y}
        coarse = Form(dimensions=DIMENSIONS, lod=1, outside="nan")
        assert coarse.sizes(volume) == {"lon": 4, "one": 1, "time": 4, "lat": 5}
        assert coarse.chunks(volume)["lon"] == x // 2


def test_a_released_array_reads_on(run) -> None:
    path, whole = run
    lazy = array(path)
    lazy.release()
    lazy.release()
    np.testing.assert_array_equal(lazy[indexing.BasicIndexer((0, 0, 0, 0))], whole[0, 0, 0, 0])
