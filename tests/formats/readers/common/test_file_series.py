"""Files with chunks: a frame is held at a time, and a chunk is decompressed once."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr
from stored_series import VALUES

from fhash_formats import open_series
from fhash_formats.readers.common.file_series import FileSeries

Save = Callable[[Path, np.ndarray, tuple[int, ...]], None]


def write_chunked_hdf5(path: Path, values: np.ndarray, chunks: tuple[int, ...]) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("v", data=values, chunks=chunks, compression="gzip")


def write_chunked_netcdf(path: Path, values: np.ndarray, chunks: tuple[int, ...]) -> None:
    dataset = xr.Dataset({"v": (("time", "lev", "lat", "lon"), values)})
    dataset.to_netcdf(path, engine="h5netcdf", encoding={"v": {"chunksizes": chunks, "zlib": True}})


def write_chunked_zarr(path: Path, values: np.ndarray, chunks: tuple[int, ...]) -> None:
    zarr.create_array(path, shape=values.shape, dtype=values.dtype, chunks=chunks)[...] = values


formats = pytest.mark.parametrize(
    ("suffix", "save"),
    [(".h5", write_chunked_hdf5), (".nc", write_chunked_netcdf), (".zarr", write_chunked_zarr)],
)


@formats
def test_one_frame_is_read_at_a_time(tmp_path: Path, suffix: str, save: Save) -> None:
    values = np.random.default_rng(0).random((40, 16, 32, 32), np.float32)
    save(tmp_path / f"a{suffix}", values, (1, 16, 32, 32))
    with open_series(tmp_path / f"a{suffix}") as series:
        series.read(0)
        tracemalloc.start()
        for step in (3, 30):
            series.read(step)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 6 * values[0].nbytes  # stored, decompressed, and in the order asked for


@formats
@pytest.mark.parametrize(("limit", "held"), [(2**20, 3), (1000, 2), (1, None)])
def test_a_chunk_of_many_steps_is_kept_as_far_as_it_fits(
    tmp_path: Path,
    suffix: str,
    save: Save,
    limit: int,
    held: int | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fhash_formats.readers.common.file_series.SLAB_BYTES", limit)
    values = np.random.default_rng(0).normal(size=(4, 3, 5, 6)).astype(np.float32)
    save(tmp_path / f"a{suffix}", values, (3, 3, 5, 6))
    with open_series(tmp_path / f"a{suffix}") as series:
        assert isinstance(series, FileSeries)
        for step in (1, 0, 3, 2):
            np.testing.assert_array_equal(series.read(step), values[step])
            assert (series._slab is None) == (held is None)
        series.read(1)
        assert series._slab is None or series._slab[1].shape[0] == held


def test_a_chunk_of_many_steps_is_decompressed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=VALUES, chunks=(3, 3, 5, 6), compression="gzip")
    asked = []
    original = h5py.Dataset.__getitem__
    monkeypatch.setattr(
        h5py.Dataset, "__getitem__", lambda self, args: asked.append(args) or original(self, args)
    )
    with open_series(tmp_path / "a.h5") as series:
        asked.clear()
        frames = list(series.frames())
    assert [ranges[0] for ranges in asked] == [slice(0, 3), slice(3, 4)]
    np.testing.assert_array_equal(np.stack(frames), VALUES)


def test_what_is_kept_of_a_chunk_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "fhash_formats.readers.common.file_series.SLAB_BYTES", 2 * VALUES[0].nbytes + 1
    )
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=VALUES, chunks=(4, 3, 5, 6))
    with open_series(tmp_path / "a.h5") as series:
        frame = series.read(1)
        assert series._slab is not None
        assert series._slab[1].shape[0] == 2
        frame[:] = 0  # a frame is the caller's own
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)


def test_time_as_the_fastest_axis_reads_many_steps_at_once(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ascontiguousarray(VALUES.transpose(1, 2, 3, 0)))
    with open_series(tmp_path / "a.npy", axes="z,y,x,t") as series:
        np.testing.assert_array_equal(series.read(2), VALUES[2])
        assert series._slab is not None
        assert series._slab[1].shape == VALUES.shape
