"""VTKHDF files (.vtkhdf) that hold ImageData: one step, or a series with its times.

Source: "VTKHDF file format", docs.vtk.org, versions 1.0 to 2.x. Point data are (z, y, x), with a
leading dimension of steps where there is a group Steps, and a trailing one of components for
vectors. `Steps/PointDataOffsets` says which entry belongs to a step: steps may share one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.failures import Stamp, naming
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.grid import (
    axis_steps,
    component_by_number,
    component_variables,
    lattice,
)
from fhash_formats.readers.common.hdf5_tree import require_filters
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.roles import assign_axes
from fhash_formats.readers.common.stored_parts import Hdf5Sources
from fhash_formats.readers.common.variables import Variable, choose
from fhash_formats.readers.hdf5 import is_hdf5
from fhash_formats.readers.vtk_xml import GHOSTS, PLACES, SPACE
from fhash_formats.series import AXES, AXIS_NAMES, Coordinate, NotStored
from fhash_formats.support.attributes import PLUMBING, json_attributes, text_of

SUFFIXES = (".vtkhdf",)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Array:
    """One dataset of the grid: the group that it is in, and whether it has a dimension of steps."""

    place: str
    dataset: Any
    steps: bool


def matches(head: bytes, path: Path) -> bool:
    """Whether this is an HDF5 file with a group VTKHDF, whatever its suffix."""
    import h5py

    if not is_hdf5(head):
        return False
    if path.suffix.lower() in SUFFIXES:
        return True
    try:
        with h5py.File(path, "r") as file:
            return "VTKHDF" in file
    except (OSError, RuntimeError, KeyError):
        return False  # the reader of HDF5 says what is wrong


def open_vtkhdf(path: Path, request: Request) -> FileSeries:
    """Open the series in a VTKHDF file of the type ImageData.

    Raises InputError for other types, turned grids, and sizes that do not fit together.
    """
    import h5py

    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        file = h5py.File(path, "r")
    try:
        with naming(source):
            return _series(source, path, stamp, file, request)
    except BaseException:
        file.close()
        raise


def _series(source: str, path: Path, stamp: Stamp, file: Any, request: Request) -> FileSeries:
    import h5py

    root = file.get("VTKHDF")
    kind = text_of(root.attrs.get("Type", b"")) if isinstance(root, h5py.Group) else "none"
    if kind != "ImageData":
        raise InputError(f"it holds VTKHDF data of the type {kind or '?'}; ImageData can be read")
    extent = _numbers(root, "WholeExtent", 6).astype(np.int64).reshape(3, 2)[::-1]
    times = _times(root)
    variables = list(_variables(root, extent, times))
    var = component_by_number(request.var, variables)
    variable = choose(source, variables, var, booleans=request.booleans)
    array, component = variable.handle
    require_filters(source, variable.name, array.dataset)
    with Hdf5Sources(source) as behind:
        parts = behind.parts(variable.name, array.dataset)
    own = (AXES if array.steps else SPACE)[: len(variable.shape)]
    axes = assign_axes(source, variable.shape, list(own), list(own), request.axes)
    entries = _entries(root, array, variable.name, times)
    vector = array.dataset.ndim > len(variable.shape)
    chunks = array.dataset.chunks
    never = None
    if parts is not None:
        shares = parts.along(0 if array.steps else None, {})
        shares = 1 - (shares if entries is None else shares[entries])
        never = NotStored(shares=shares, fill=parts.fill.item()) if shares.any() else None

    def fetch(ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        space = ranges[-3:]
        picked = (*space, component) if vector else space
        if entries is None:
            return np.asarray(array.dataset[picked])
        steps = entries[ranges[0]]
        first = int(steps[0])
        if np.array_equal(steps, np.arange(first, first + len(steps))):
            return np.asarray(array.dataset[(slice(first, first + len(steps)), *picked)])
        return np.stack([array.dataset[(int(step), *picked)] for step in steps])

    return FileSeries(
        source=source,
        name=variable.name.rpartition("/")[2],
        shape=variable.shape,
        dtype=variable.dtype,
        axes=axes,
        fetch=fetch,
        stamp=stamp,
        coords=_coordinates(root, extent, array, times) if axes == own else {},
        attributes=json_attributes(array.dataset.attrs, without=PLUMBING),
        chunks=None if chunks is None else chunks[: len(variable.shape)],
        close=file.close,
        beside=list(behind.files),
        not_stored=never,
    )


def _times(root: Any) -> npt.NDArray[np.float64] | None:
    """Times of the steps; None for a file without a group of steps."""
    steps = root.get("Steps")
    if steps is None:
        return None
    times = np.asarray(steps["Values"][()], dtype=np.float64)
    count = int(np.asarray(steps.attrs.get("NSteps", times.size)).ravel()[0])
    if times.shape != (count,) or count < 1:
        raise InputError(f"it promises {count} steps and has the times of {times.size}")
    return times


def _shape(extent: npt.NDArray[np.int64], place: str) -> tuple[int, int, int]:
    points = extent[:, 1] - extent[:, 0] + 1
    z, y, x = points if place == "PointData" else np.maximum(points - 1, 1)
    return int(z), int(y), int(x)


def _variables(
    root: Any, extent: npt.NDArray[np.int64], times: npt.NDArray[np.float64] | None
) -> Iterator[Variable]:
    """Arrays of points and cells; the place precedes a name that both have."""
    import h5py

    found = [
        (place, name, root[place][name])
        for place in PLACES
        if isinstance(root.get(place), h5py.Group)
        for name in root[place]
    ]
    names = [name for _, name, _ in found]
    for place, name, dataset in found:
        if not isinstance(dataset, h5py.Dataset):
            continue
        space = _shape(extent, place)
        leading = 0 if times is None else 1
        shape: tuple[int, ...] = dataset.shape or ()
        error = ""
        if shape[leading : leading + 3] != space or len(shape) - leading not in (3, 4):
            error = f"a shape {shape} that does not fit the grid (z, y, x) = {space}"
        components = 1 if error or len(shape) - leading == 3 else shape[-1]
        full = space if times is None else (len(times), *space)
        yield from component_variables(
            name if names.count(name) == 1 else f"{place}/{name}",
            components,
            full,
            dataset.dtype,
            _Array(place=place, dataset=dataset, steps=times is not None),
            auxiliary=name in GHOSTS,
            error=error,
        )


def _entries(
    root: Any, array: _Array, name: str, times: npt.NDArray[np.float64] | None
) -> npt.NDArray[np.int64] | None:
    """The entry of the dataset that belongs to each step; None without steps."""
    if times is None:
        return None
    own = array.dataset.name.rpartition("/")[2]
    offsets = root["Steps"].get(f"{array.place}Offsets/{own}")
    entries = np.arange(len(times)) if offsets is None else np.asarray(offsets[()], np.int64)
    if entries.shape != times.shape or entries.min() < 0 or entries.max() >= len(array.dataset):
        raise InputError(f"the offsets of {name} do not fit its {len(array.dataset)} entries")
    return entries


def _coordinates(
    root: Any,
    extent: npt.NDArray[np.int64],
    array: _Array,
    times: npt.NDArray[np.float64] | None,
) -> dict[str, Coordinate]:
    origin, spacing = _numbers(root, "Origin", 3), _numbers(root, "Spacing", 3)
    direction = _numbers(root, "Direction", 9) if "Direction" in root.attrs else np.eye(3).ravel()
    spacing = spacing * axis_steps(direction.reshape(3, 3))
    coords = {}
    for axis, (first, last), count in zip(SPACE, extent, _shape(extent, array.place), strict=True):
        number = "xyz".index(axis)
        start = first + (0.5 if array.place == "CellData" and last > first else 0.0)
        coords[axis] = lattice(axis, origin[number], spacing[number], count, first=start)
    stored = root["Steps/Values"] if times is not None else root.get("FieldData/TimeValue")
    if times is None and stored is not None and stored.size == 1:
        times = np.asarray(stored[()], dtype=np.float64).ravel()
    if times is not None:
        extra = json_attributes(stored.attrs)
        kept = {key: value for key, value in extra.items() if key in ("units", "calendar")}
        coords["t"] = Coordinate(name=AXIS_NAMES["t"], values=times, attributes=kept)
    return coords


def _numbers(root: Any, name: str, count: int) -> npt.NDArray[np.float64]:
    values = np.asarray(root.attrs.get(name, ()), dtype=np.float64).ravel()
    if values.size != count or not np.isfinite(values).all():
        raise InputError(f"the attribute {name} has not {count} numbers")
    return values
