"""Small files of every format that hold one series, for the tests of the readers."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import zarr

from fhash_formats.readers.registry import open_series

VALUES = np.random.default_rng(0).normal(size=(4, 3, 5, 6)).astype(np.float32)
"""The series, (t, z, y, x)."""


def frames(path: Path, **options: Any) -> np.ndarray:
    """All frames of a file, stacked; shape and type are what the series said before."""
    with open_series(path, **options) as series:
        stacked = np.stack(list(series.frames()))
        assert stacked.shape == series.shape
        assert stacked.dtype == series.dtype
        assert series.dtype.isnative
        return stacked


def assert_frames(path: Path, expected: np.ndarray, **options: Any) -> None:
    """Check every frame of a file: its values, its type, and that it is C-contiguous."""
    with open_series(path, **options) as series:
        assert series.shape == expected.shape
        assert series.dtype == expected.dtype.newbyteorder("=")
        assert series.dtype.isnative
        for step, frame in enumerate(series.frames()):
            assert frame.dtype == series.dtype
            assert frame.flags.c_contiguous
            np.testing.assert_array_equal(frame, expected[step])


def write_hdf5(path: Path, **arrays: Any) -> Path:
    """An HDF5 file of datasets; `__` in a name stands for the slash of a group."""
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name.replace("__", "/")] = array
    return path


def save_netcdf(path: Path, dataset: Any, **options: Any) -> Path:
    """A NetCDF-4 file of an xarray dataset."""
    dataset.to_netcdf(path, engine="h5netcdf", **options)
    return path


def create_zarr(
    path: Path, values: np.ndarray, *, name: str | None = None, zarr_format: int = 3, **options: Any
) -> Any:
    """A zarr array at a path, or in the group there if it has a name."""
    if name:
        group: Any = zarr.open_group(path, mode="a", zarr_format=zarr_format)
        array = group.create_array(name, shape=values.shape, dtype=values.dtype, **options)
    else:
        array = zarr.create_array(
            path, shape=values.shape, dtype=values.dtype, zarr_format=zarr_format, **options
        )
    array[...] = values
    return array


def zipped(folder: Path, path: Path, *, inside: str = "") -> Path:
    """A ZIP of a folder's files, their names preceded by `inside`."""
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, inside + str(file.relative_to(folder)))
    return path
