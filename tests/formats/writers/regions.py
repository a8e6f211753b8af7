"""A labelled region, and values of written files, read without the readers of this project."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray

from fhash_formats.series import Coordinate
from fhash_formats.writers.common import Region


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


SHAPE = (3, 4, 5, 6)

HOURS = 347921.000277 + np.array([0.0, 1.0, 3.5])
"""Times that float32 cannot hold."""

COORDS = {
    "t": Coordinate(
        name="time",
        values=HOURS,
        attributes={
            "units": "hours since 1970-01-01",
            "calendar": "gregorian",
            "standard_name": "time",
            "bounds": "time_bnds",
        },
    ),
    "z": Coordinate(
        name="height",
        values=np.array([5.0, 21.666664123535156, 45.0, 75.0]),
        attributes={"units": "m", "positive": "up"},
    ),
    "y": Coordinate(
        name="lat",
        values=np.linspace(1, -1, 5),
        attributes={"units": "degrees_north", "axis": "Y", "scale_factor": 0.5},
    ),
    "x": Coordinate(name="lon", values=np.linspace(0.1, 0.7, 6)),
}
"""Uneven, descending and described coordinates."""

ATTRIBUTES = {
    "standard_name": "air_temperature",
    "scale_factor": 0.5,
    "add_offset": 100.0,
    "_FillValue": 3.0,
    "missing_value": -9.0,
    "valid_range": [0, 1],
    "coordinates": "sigma altitude",
    "grid_mapping": "rotated_pole",
    "flags": [1, 2],
}
"""Attributes of the variable; some of them would change the meaning of physical values."""

DATA = np.random.default_rng(3).normal(size=SHAPE).astype("f4")
"""Frames with a missing value and a value that equals the fill value of the attributes."""

DATA[0, 0, 0, :2] = np.nan, 3.0


def labelled_region(**changes: Any) -> Region:
    """A region of SHAPE with COORDS and ATTRIBUTES, or with other fields."""
    made = {
        "name": "theta",
        "units": "K",
        "dtype": np.dtype("f4"),
        "shape": SHAPE,
        "coords": COORDS,
        "attributes": ATTRIBUTES,
    }
    return Region(**{**made, **changes})


def region_of(positions: dict[str, list[float]], **changes: Any) -> Region:
    """A region of the variable wind at these positions, or with other fields."""
    coords = {
        axis: Coordinate(name=axis, values=np.array(values, dtype="f8"))
        for axis, values in positions.items()
    }
    made = {
        "name": "wind",
        "dtype": np.dtype("f4"),
        "shape": tuple(len(coords[axis].values) for axis in "tzyx"),
        "coords": coords,
    }
    return Region(**{**made, **changes})
