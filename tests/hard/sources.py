"""One series in every form that can be read, for tests that change it while it is read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

Written = tuple[Path, list[str]]
"""A file or folder that may be changed, and the words with which `fhash encode` reads the series.
"""


def npy(folder: Path, values: np.ndarray) -> Written:
    np.save(folder / "a.npy", values)
    return folder / "a.npy", [str(folder / "a.npy")]


def raw(folder: Path, values: np.ndarray) -> Written:
    path = folder / f"a_{'x'.join(map(str, values.shape[::-1]))}_float32.raw"
    path.write_bytes(values.tobytes())
    return path, [str(path)]


def hdf5(folder: Path, values: np.ndarray) -> Written:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("v", data=values, chunks=(1, *values.shape[1:]), compression="gzip")
    return folder / "a.h5", [str(folder / "a.h5")]


def netcdf(folder: Path, values: np.ndarray) -> Written:
    import xarray

    xarray.Dataset({"v": (("time", "z", "y", "x"), values)}).to_netcdf(
        folder / "a.nc", engine="h5netcdf"
    )
    return folder / "a.nc", [str(folder / "a.nc")]


def netcdf3(folder: Path, values: np.ndarray) -> Written:
    import xarray

    xarray.Dataset({"v": (("time", "z", "y", "x"), values)}).to_netcdf(
        folder / "a3.nc", engine="scipy"
    )
    return folder / "a3.nc", [str(folder / "a3.nc")]


def zarr(folder: Path, values: np.ndarray) -> Written:
    import zarr as library

    array = library.create_array(
        folder / "a.zarr",
        shape=values.shape,
        dtype=values.dtype,
        chunks=(1, *values.shape[1:]),
        overwrite=True,
    )
    array[...] = values
    return folder / "a.zarr", [str(folder / "a.zarr")]


def zipped(folder: Path, values: np.ndarray) -> Written:
    import zarr as library

    with library.storage.ZipStore(folder / "a.zip", mode="w") as store:
        array = library.create_array(
            store, shape=values.shape, dtype=values.dtype, chunks=(1, *values.shape[1:])
        )
        array[...] = values
    return folder / "a.zip", [str(folder / "a.zip")]


def pattern(folder: Path, values: np.ndarray) -> Written:
    for step, frame in enumerate(values):
        np.save(folder / f"step_{step}.npy", frame)
    return folder / "step_1.npy", [str(folder / "step_*.npy")]


def virtual(folder: Path, values: np.ndarray) -> Written:
    import h5py

    with h5py.File(folder / "part.h5", "w") as file:
        file.create_dataset("v", data=values)
    layout = h5py.VirtualLayout(shape=values.shape, dtype=values.dtype)
    layout[:] = h5py.VirtualSource("part.h5", "v", shape=values.shape)
    with h5py.File(folder / "all.h5", "w") as file:
        file.create_virtual_dataset("v", layout)
    return folder / "part.h5", [str(folder / "all.h5")]


def mask(folder: Path, values: np.ndarray) -> Written:
    np.save(folder / "data.npy", values)
    np.save(folder / "mask.npy", values > 2)
    return folder / "mask.npy", [
        str(folder / "data.npy"),
        "--feature",
        f"mask:{folder / 'mask.npy'}",
    ]


FORMS: dict[str, Callable[[Path, np.ndarray], Written]] = {
    "npy": npy,
    "raw": raw,
    "HDF5": hdf5,
    "NetCDF": netcdf,
    "NetCDF 3": netcdf3,
    "Zarr": zarr,
    "Zarr in a ZIP": zipped,
    "a pattern of files": pattern,
    "a virtual dataset": virtual,
    "a mask": mask,
}
"""Functions by form. Each writes the values (t, z, y, x) into a folder, always under the same
name."""
