"""Writer of VTK's HDF5 format (.vtkhdf): all steps of an evenly spaced grid in one file.

A single step is VTKHDF 1.0, which ParaView 5.11 reads: point data (z, y, x), and its time as the
field array TimeValue. Several steps are VTKHDF 2.0, which ParaView 5.12 and newer read: point data
(t, z, y, x) and a group Steps with the physical times. The type is ImageData, docs.vtk.org
("VTKHDF file format"). As in .vti, a descending axis is reversed, values and coordinates, and
float16 is stored as float32, exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.writers.common.held_file import held_hdf5
from fhash_formats.writers.common.labels import hdf5_value, safe_name
from fhash_formats.writers.common.region import Region
from fhash_formats.writers.common.spacing import even_spacing
from fhash_formats.writers.common.writer import (
    Frame,
    Put,
    Writer,
    chunk_shape,
    little_endian,
    of_one,
)
from fhash_formats.writers.hdf5 import COMPRESSION
from fhash_formats.writers.vti import SPACE, direction

SINGLE_VERSION = (1, 0)
"""Version of a file of one step."""

SERIES_VERSION = (2, 0)
"""Version of a file of several steps; it is the first with a group Steps."""

SERIES_NEEDS = "ParaView 5.12 or newer, as every .vtkhdf of several steps"
"""Programs that read a file of several steps, for messages."""


def needed_by(paths: Sequence[str], steps: int) -> list[str]:
    """Programs that open outputs of so many steps: at most one text, for a .vtkhdf series."""
    series = steps > 1 and any(path.lower().endswith(".vtkhdf") for path in paths)
    return [SERIES_NEEDS] if series else []


def _outputs(path: Path, region: Region) -> list[Path]:
    if not np.all(np.isfinite(region.coords["t"].values)):
        raise InputError(
            f"{path}: the times are not all finite, and VTK's files need them; use .nc, .h5 or .npy"
        )
    for axis in SPACE:
        if not even_spacing(region.coords[axis].values):
            raise InputError(
                f"{path}: the coordinate {region.coords[axis].name!r} of {axis} is not evenly"
                " spaced, as .vtkhdf needs; use .vtr or .pvd"
            )
    return [path]


@contextmanager
def _open(region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]) -> Iterator[Put]:
    import h5py

    steps = region.shape[0]
    turn = tuple(slice(None, None, direction(region.coords[axis].values)) for axis in SPACE)
    # Links in the order of their creation, as the reader of VTK demands for composite files and
    # takes for all.
    with held_hdf5(temporaries[0], lambda file: h5py.File(file, "w", track_order=True)) as (
        file,
        root,
    ):
        with file.calling():
            values = _create(root, region)

        def put(step: int, frame: Frame) -> None:
            with file.calling():
                values[step if steps > 1 else ...] = frame[turn]

        yield put


def _create(root: Any, region: Region) -> Any:
    """Create the empty dataset in `root`, with everything that describes it."""
    ascending = {
        axis: values[:: direction(values)]
        for axis in SPACE
        for values in [region.coords[axis].values]
    }
    steps, *size = region.shape
    group = root.create_group("VTKHDF", track_order=True)
    group.attrs["Version"] = np.array(SERIES_VERSION if steps > 1 else SINGLE_VERSION, dtype="<i8")
    group.attrs["Type"] = np.bytes_("ImageData")
    group.attrs["WholeExtent"] = np.array(
        [bound for length in reversed(size) for bound in (0, length - 1)], dtype="<i8"
    )
    group.attrs["Origin"] = np.array([ascending[axis][0] for axis in "xyz"], dtype="<f8")
    group.attrs["Spacing"] = np.array(
        [even_spacing(ascending[axis]) for axis in "xyz"], dtype="<f8"
    )
    group.attrs["Direction"] = np.eye(3, dtype="<f8").ravel()
    name = safe_name(region.name)
    points = group.create_group("PointData", track_order=True)
    points.attrs["Scalars"] = np.bytes_(name.encode())
    values = points.create_dataset(
        name,
        shape=region.shape if steps > 1 else region.shape[1:],
        dtype=little_endian(region.dtype),
        chunks=chunk_shape(region) if steps > 1 else chunk_shape(region)[1:],
        **COMPRESSION,
    )
    if region.units:
        values.attrs["units"] = region.units.replace("\0", "")
    times = region.coords["t"].values.astype("<f8")
    if steps == 1:
        holder = group.create_group("FieldData", track_order=True)
        _describe(holder.create_dataset("TimeValue", data=times), region)
        return values
    series = group.create_group("Steps", track_order=True)
    series.attrs["NSteps"] = np.int64(steps)
    _describe(series.create_dataset("Values", data=times), region)
    offsets = series.create_group("PointDataOffsets", track_order=True)
    offsets.create_dataset(name, data=np.arange(steps, dtype="<i8"))
    return values


def _describe(times: Any, region: Region) -> None:
    """Give a dataset of times the units and the calendar of the region's."""
    for key in ("units", "calendar"):
        if key in region.coords["t"].attributes:
            times.attrs[key] = hdf5_value(str(region.coords["t"].attributes[key]))


VTKHDF = Writer(name="VTKHDF", suffixes=(".vtkhdf",), outputs=_outputs, open=of_one(_open))
