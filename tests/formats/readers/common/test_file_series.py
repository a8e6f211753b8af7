"""What holds for every format with chunks: one frame is held at a time, and a chunk of many steps is decompressed once."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr

from fhash_formats import open_series
from fhash_formats.readers.common.file_series import FileSeries

Save = Callable[[Path, np.ndarray, tuple[int, ...]], None]


def save_hdf5(path: Path, values: np.ndarray, chunks: tuple[int, ...]) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("v", data=values, chunks=chunks, compression="gzip")


def save_netcdf(path: Path, values: np.ndarray, chunks: tuple[int, ...]) -> None:
    dataset = xr.Dataset({"v": (("time", "lev", "lat", "lon"), values)})
    dataset.to_netcdf(path, engine="h5netcdf", encoding={"v": {"chunksizes": chunks, "zlib": True}})


def save_zarr(path: Path, values: np.ndarray, chunks: tuple[int, ...]) -> None:
    zarr.create_array(path, shape=values.shape, dtype=values.dtype, chunks=chunks)[...] = values


each = pytest.mark.parametrize(
    ("suffix", "save"), [(".h5", save_hdf5), (".nc", save_netcdf), (".zarr", save_zarr)]
)


@each
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


@each
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
