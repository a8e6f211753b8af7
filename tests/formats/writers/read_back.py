"""Values of written files, read without the readers of this project."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import xarray


def vtk_frames(paths: list[Path]) -> np.ndarray:
    """The values of .vti and .vtr files without a descending axis, by their bytes alone."""
    frames = []
    for path in [path for path in paths if path.suffix != ".pvd"]:
        head, _, rest = path.read_bytes().partition(b'<AppendedData encoding="raw">\n_')
        kind = head.partition(b"<PointData")[2].partition(b'type="')[2].partition(b'"')[0].decode()
        extent = np.array(head.partition(b'WholeExtent="')[2].partition(b'"')[0].split(), dtype=int)
        size = int.from_bytes(rest[:8], "little")
        frames.append(
            np.frombuffer(rest[8 : 8 + size], np.dtype(kind.lower()).newbyteorder("<")).reshape(
                extent[[5, 3, 1]] + 1
            )
        )
    return np.stack(frames)


def read_hdf5(paths: list[Path]) -> np.ndarray:
    with h5py.File(paths[0]) as file:
        return np.asarray(file["wind"])


def read_xarray(paths: list[Path]) -> np.ndarray:
    with xarray.open_dataset(
        paths[0], decode_times=False, engine="zarr" if paths[0].suffix == ".zarr" else "h5netcdf"
    ) as data:
        return np.asarray(data["wind"].values)


def read_raw(paths: list[Path]) -> np.ndarray:
    header = dict(line.split(": ", 1) for line in paths[1].read_text().splitlines() if ": " in line)
    dtype = np.dtype(
        {"float": "f4", "double": "f8"}.get(header["type"], header["type"])
    ).newbyteorder("<")
    read = np.fromfile(paths[0].parent / header["data file"], dtype).reshape(
        [int(n) for n in header["sizes"].split()][::-1]
    )
    return read if read.ndim == 4 else read[None]


def read_vtkhdf(paths: list[Path]) -> np.ndarray:
    with h5py.File(paths[0]) as file:
        read = np.asarray(file["VTKHDF/PointData/wind"])
        return read if read.ndim == 4 else read[None]


READ: dict[str, Callable[[list[Path]], np.ndarray]] = {
    ".npy": lambda paths: np.asarray(np.load(paths[0])),
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".nc": read_xarray,
    ".nc4": read_xarray,
    ".zarr": read_xarray,
    ".raw": read_raw,
    ".vti": vtk_frames,
    ".vtr": vtk_frames,
    ".pvd": vtk_frames,
    ".vtkhdf": read_vtkhdf,
}
"""Readers of the values (t, z, y, x) by suffix; each takes the paths that were written."""
