"""Arrays of dask as series: the frames of the array, each chunk computed once."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from fhash_codec import InputError
from fhash_codec.coreset import lazy
from fhash_codec.coreset.labelled import array_series
from fhash_codec.coreset.lazy import DaskSeries, LazyFrames, is_lazy
from fhash_formats.series import ArraySeries

dask = pytest.importorskip("dask.array")
SHAPE = (7, 2, 3, 4)
VALUES = np.arange(np.prod(SHAPE), dtype=np.float32).reshape(SHAPE)


def counted(chunks, computed: Counter) -> object:
    """A dask array that counts how often each of its steps is computed."""

    def look(block, block_info=None):
        computed.update(range(*block_info[0]["array-location"][0]))
        return block

    return dask.map_blocks(look, dask.from_array(VALUES, chunks=chunks), dtype=VALUES.dtype)


@pytest.mark.parametrize("steps", [1, 3, 7])
def test_each_chunk_is_computed_once(steps) -> None:
    computed: Counter = Counter()
    frames = LazyFrames(counted((steps, 2, 3, 4), computed))
    for step, frame in enumerate(VALUES):
        np.testing.assert_array_equal(frames.read(step), frame)
    assert set(computed.values()) == {1}


def test_a_large_chunk_is_computed_in_slabs(monkeypatch) -> None:
    monkeypatch.setattr(lazy, "SLAB_BYTES", 2 * VALUES[0].nbytes)
    computed: Counter = Counter()
    frames = LazyFrames(counted((5, 2, 3, 4), computed))
    for step in (0, 1, 4, 6, 2, 3):
        np.testing.assert_array_equal(frames.read(step), VALUES[step])
    assert max(computed.values()) == 3  # slabs 0-1, 2-3 and 4 of the first chunk


@pytest.mark.parametrize("dtype", ["f4", ">f8", "i2"])
@pytest.mark.parametrize("axes", [3, 4])
def test_a_series_of_dask_is_that_of_its_values(axes, dtype) -> None:
    values = VALUES.astype(dtype) if axes == 4 else VALUES[0].astype(dtype)
    series = array_series(dask.from_array(values, chunks=2))
    plain = ArraySeries(values)
    assert isinstance(series, DaskSeries)
    for name in ("shape", "dtype", "name", "units", "source", "attributes"):
        assert getattr(series, name) == getattr(plain, name)
    for step in range(plain.shape[0]):
        np.testing.assert_array_equal(series.read(step), plain.read(step))
        assert series.read(step).dtype == plain.read(step).dtype
    with pytest.raises(IndexError):
        series.read(plain.shape[0])


def test_other_arrays_are_not_lazy() -> None:
    assert is_lazy(dask.zeros((2, 2)))
    assert not is_lazy(VALUES)
    assert not is_lazy([1, 2])


def test_lengths_that_are_not_known_are_refused() -> None:
    array = dask.from_array(VALUES, chunks=2)
    unknown = array[array[:, 0, 0, 0] > 30]
    with pytest.raises(InputError, match="compute_chunk_sizes"):
        LazyFrames(unknown)
    with pytest.raises(InputError, match="compute_chunk_sizes"):
        array_series(unknown)
