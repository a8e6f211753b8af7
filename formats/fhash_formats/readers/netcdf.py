"""NetCDF files, read by the CF conventions with xarray.

Packing is undone, fill values become NaN, times stay numbers. NetCDF4 is HDF5 and goes through
h5netcdf, NetCDF3 ("classic") through common/netcdf3.py. Times are not decoded: float64 hours near
347921 tell steps apart, calendars of models need no date, and `units` and `calendar` stay beside
the numbers.
`valid_range` never hides a value, since it is wrong in files that are in use.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fhash_formats.readers.common import step_groups
from fhash_formats.readers.common.cf_packing import Packing
from fhash_formats.readers.common.failures import Stamp, refusing
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.layout import (
    Dimension,
    Layout,
    Read,
    arrange,
    shared_roles,
    with_roles,
)
from fhash_formats.readers.common.listing import Listed, listing
from fhash_formats.readers.common.netcdf_store import (
    CLASSIC,
    check_filters,
    close_groups,
    declared,
    default_fill,
    exactly_filled,
    magic_of,
    open_groups,
    quietly,
)
from fhash_formats.readers.common.netcdf_surroundings import netcdf_metadata
from fhash_formats.readers.common.positions import Column, beside, coordinate, usable
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.roles import role_of_coordinate, role_of_name
from fhash_formats.readers.common.stored_parts import hdf5_parts, not_stored
from fhash_formats.readers.common.times import (
    MAX_LETTERS,
    only_counts,
    real_time,
    written_times,
)
from fhash_formats.readers.common.variables import Variable, choose, plain_name, series_like
from fhash_formats.readers.hdf5 import is_hdf5
from fhash_formats.series import AXES, Coordinate
from fhash_formats.source_metadata import shown_name
from fhash_formats.support.attributes import STORED, json_attributes, text_of

if TYPE_CHECKING:
    import xarray as xr

SUFFIXES = (".nc", ".nc4", ".netcdf", ".cdf")
MADE_UP = "phony_dim_"
"""Prefix of the names that xarray makes up for dimensions without one."""


def matches(head: bytes, path: Path) -> bool:
    """Whether this is NetCDF: classic, or an HDF5 file that claims to be NetCDF.

    It claims so by its suffix, by `_NCProperties` or by CF `Conventions`.
    """
    return head[:4] in CLASSIC or (
        is_hdf5(head) and (_says_netcdf(path) or path.suffix.lower() in SUFFIXES)
    )


def _says_netcdf(path: Path) -> bool:
    """Whether an HDF5 file claims to be NetCDF; raises InputError if it cannot be opened."""
    import h5py

    with refusing(f"{path} cannot be read as HDF5"), h5py.File(path, "r") as file:
        return "_NCProperties" in file.attrs or text_of(
            file.attrs.get("Conventions", "")
        ).strip().upper().startswith("CF-")


def open_netcdf(path: Path, request: Request) -> FileSeries:
    """Open the series in a NetCDF file: the only suitable variable of any group, or a named one."""
    source, stamp = str(path), Stamp.of(path)
    head = magic_of(path)
    with quietly(), refusing(f"{source} cannot be read as NetCDF"):
        groups = open_groups(source, path, head)
        try:
            return _series(source, path, stamp, groups, request)
        except BaseException:
            close_groups(groups)
            raise


class NetcdfFile:
    """The variables of an open NetCDF file, what their dimensions are, and how they are read."""

    def __init__(
        self, source: str, path: Path, groups: Mapping[str, xr.Dataset], request: Request
    ) -> None:
        self.source, self.path, self.groups, self.request = source, path, groups, request
        found = [
            Variable(
                name=f"{group}/{name}".lstrip("/"),
                shape=array.shape,
                dtype=array.dtype,
                auxiliary=name in dataset.coords,
                handle=(group, name),
                units=str(array.attrs.get("units", "")),
            )
            for group, dataset in groups.items()
            for name, array in ((str(name), array) for name, array in dataset.variables.items())
        ]
        self.variables = step_groups.join(found, self._attributes)

    def array(self, variable: Variable) -> xr.Variable:
        """The stored array of a variable; of the first step where it has one array a step."""
        group, name = variable.handle
        return self.groups[group].variables[name]

    def scope(self, variable: Variable) -> list[xr.Dataset]:
        """The group of a variable and those around it."""
        return [
            self.groups[place] for place in _upwards(variable.handle[0]) if place in self.groups
        ]

    def dimensions(self, variable: Variable) -> list[Dimension]:
        """The dimensions of a variable, with what the file says about each."""
        return with_roles(self._stated(variable), self._roles)

    @cached_property
    def _roles(self) -> dict[str, str]:
        return shared_roles(map(self._stated, series_like(self.variables)))

    def _stated(self, variable: Variable) -> list[Dimension]:
        scope = self.scope(variable)
        found = []
        for name, length in zip(*_named_lengths(self.array(variable)), strict=True):
            column = _labels(name, length, scope)
            made_up = name.startswith(MADE_UP)
            found.append(
                Dimension(
                    name=None if made_up else name,
                    length=length,
                    role=_role(name, scope),
                    column=column,
                )
            )
        if variable.members:
            return [Dimension(name="step", length=len(variable.members), role="t"), *found]
        return found

    def packing(self, variable: Variable) -> Packing | None:
        """The packing of the values, None where the user wants them as stored."""
        return None if self.request.raw_values else declared(self.source, self.array(variable))

    def reading(self, variable: Variable) -> Read:
        """The function that reads the values of a variable."""
        if variable.members:
            step_groups.require_one_type(self.source, variable, self.packing)
            return step_groups.reading([self.reading(member) for member in variable.members])
        check_filters(self.source, self.path, variable.name)
        array = self.array(variable)
        exact = None
        if not self.request.raw_values:
            exact = exactly_filled(self.source, self.path, variable.name, array.encoding)

        def read(ranges: tuple[slice, ...]) -> Any:
            with quietly():
                values = array[ranges].to_numpy()
                return values if exact is None else exact(values, ranges)

        return read

    def coordinates(self, variable: Variable, layout: Layout) -> dict[str, Coordinate]:
        """Coordinates of the axes, of what was selected, and of scalars that lie beside."""
        group, name = variable.handle
        names = [str(dimension) for dimension in self.array(variable).dims]
        if variable.members:
            names.insert(0, MADE_UP + "step")
        kept = [name for place, name in enumerate(names) if place not in layout.picked]
        coords = layout.coordinates(self.source, {}) | _coordinates(
            self.source,
            layout.axes,
            kept,
            layout.shape,
            self.scope(variable),
            self.groups[group][name],
            self.request.axes is not None,
        )
        if variable.members and "t" in layout.axes and 0 not in layout.picked:
            coords["t"] = step_groups.times(variable.members, self._attributes, self._scalar)
            step_groups.require_positions(
                self.source,
                variable,
                layout,
                coords,
                lambda group: _columns(self.groups[f"/{group}"]),
            )
        return coords

    def _attributes(self, path: str) -> Mapping[str, Any]:
        group, _, name = path.rpartition("/")
        if f"/{path}" in self.groups:
            return self.groups[f"/{path}"].attrs
        return self.groups[f"/{group}"].variables[name].attrs

    def _scalar(self, path: str) -> tuple[float, str] | None:
        group, _, name = path.rpartition("/")
        dataset = self.groups.get(f"/{group}")
        array = None if dataset is None else dataset.variables.get(name)
        if array is None or array.size != 1 or array.dtype.kind not in "iuf":
            return None
        return float(array.to_numpy().reshape(-1)[0]), str(array.attrs.get("units", ""))


def _named_lengths(array: xr.Variable) -> tuple[list[str], tuple[int, ...]]:
    return [str(name) for name in array.dims], array.shape


def _labels(dimension: str, length: int, scope: Sequence[xr.Dataset]) -> Column | None:
    """The column along a dimension: its namesake, also of texts, else numbers along it."""
    if dimension.startswith(MADE_UP):
        return None
    for dataset in scope:
        array = dataset.variables.get(dimension)
        if array is not None and array.shape == (length,):
            numeric = array.dtype.kind in "iuf"
            return Column(
                name=dimension,
                length=length,
                read=array.to_numpy,
                attributes=array.attrs,
                numeric=numeric,
            )
    for name, array in _along(dimension, scope):
        return Column(name=name, length=length, read=array.to_numpy, attributes=array.attrs)
    return None


def _series(
    source: str, path: Path, stamp: Stamp, groups: Mapping[str, xr.Dataset], request: Request
) -> FileSeries:
    found = NetcdfFile(source, path, groups, request)
    variable = choose(
        source,
        found.variables,
        request.var,
        booleans=request.booleans,
        selected=len(request.select),
    )
    layout = arrange(source, variable.name, found.dimensions(variable), request)
    array = found.array(variable)
    packed = declared(source, array)
    without = STORED
    if request.raw_values:
        stored = open_groups(source, path, magic_of(path), raw=True)
        opened = [groups, stored]
        found = NetcdfFile(source, path, stored, request)
        array = found.array(variable)
        # counts have not the unit of the values
        without |= {"units"} if packed is not None and packed.scaled else frozenset()
        packed = None
    else:
        opened = [groups]

    def close() -> None:
        for each in opened:
            close_groups(each)

    try:
        members = [each.name for each in variable.members or (variable,)]
        parts, beside = hdf5_parts(source, path, members)
        chunks = array.encoding.get("chunksizes")
        # without names, dimensions have those of the axes
        names = {each.name or axis for each, axis in zip(layout.kept, layout.axes, strict=True)}
        series = FileSeries(
            source=source,
            name=plain_name(shown_name(variable.name, names)),
            shape=layout.shape,
            dtype=array.dtype,
            axes=layout.axes,
            fetch=layout.fetch(found.reading(variable)),
            stamp=stamp,
            coords=NetcdfFile(source, path, groups, request).coordinates(variable, layout),
            attributes=json_attributes(array.attrs, without=without) | layout.attributes(),
            chunks=layout.chunks(chunks and (*((1,) if variable.members else ()), *chunks)),
            close=close,
            packing=packed,
            beside=beside,
            not_stored=not_stored(parts, layout, joined=bool(variable.members)),
            default_fill=None if request.raw_values else default_fill(array, packed),
        )
    except BaseException:
        close()
        raise
    if not variable.members and not any(str(name).startswith(MADE_UP) for name in array.dims):
        scope = _upwards(variable.handle[0])
        series.metadata = netcdf_metadata(
            path,
            variable.handle,
            scope,
            layout,
            request,
            series.coords,
            packed,
            without if request.raw_values else (),
        )
    return series


def list_netcdf(path: Path, request: Request) -> list[Listed]:
    """The variables of a NetCDF file."""
    source = str(path)
    with quietly(), refusing(f"{source} cannot be read as NetCDF"):
        groups = open_groups(source, path, magic_of(path))
        try:
            found = NetcdfFile(source, path, groups, replace(request, raw_values=False))
            return listing(source, found.variables, found.dimensions, request, found.packing)
        finally:
            close_groups(groups)


def _upwards(group: str) -> list[str]:
    """Path of a group and of the groups around it, the root last.

    NetCDF4 groups inherit dimensions and coordinates from those around them.
    """
    parts = [part for part in group.split("/") if part]
    return ["/" + "/".join(parts[:count]) for count in range(len(parts), -1, -1)]


def _along(dimension: str, scope: Sequence[xr.Dataset]) -> Iterator[tuple[str, xr.Variable]]:
    """Number variables along one dimension alone: its namesake, then coordinates, then the rest.

    A made-up dimension has none: xarray shares those by length, and a length has no meaning.
    """
    if dimension.startswith(MADE_UP):
        return
    for rank in ("named", "coordinate", "other"):
        for dataset in scope:
            for key, array in dataset.variables.items():
                kind = (
                    "named"
                    if key == dimension
                    else "coordinate"
                    if key in dataset.coords
                    else "other"
                )
                if kind == rank and array.dims == (dimension,) and usable(array.dtype):
                    yield str(key), array


def _texts(
    dimension: str, length: int, scope: Sequence[xr.Dataset]
) -> Iterator[tuple[str, Any, Mapping[str, Any]]]:
    """Variables of texts along one dimension, or of letters: name, texts and attributes."""
    for dataset in scope:
        for name, array in dataset.variables.items():
            letters = array.ndim == 2 and array.dtype == "S1" and array.shape[1] <= MAX_LETTERS
            texts = array.ndim == 1 and array.dtype.kind in "SUO"
            if (letters or texts) and array.dims[0] == dimension and len(array) == length:
                found = array.to_numpy()
                rows = [b"".join(row) for row in found.tolist()] if letters else found
                yield str(name), np.asarray(rows), array.attrs


def _role(dimension: str, scope: Sequence[xr.Dataset]) -> str | None:
    for name, array in _along(dimension, scope):
        role = role_of_coordinate(name, array.attrs)
        if role is not None:
            return role
    return role_of_name(dimension)


def _columns(dataset: xr.Dataset) -> dict[str, Column]:
    """Variables of a dataset that may be coordinates, by lower-case name."""
    arrays = [
        (str(key), array)
        for key, array in dataset.variables.items()
        if array.ndim < 2 and usable(array.dtype)
    ]
    return {
        key.lower(): Column(
            name=key, length=array.size, read=array.to_numpy, attributes=array.attrs
        )
        for key, array in arrays
    }


def _coordinates(
    source: str,
    axes: Sequence[str],
    dimensions: Sequence[str],
    shape: Sequence[int],
    scope: Sequence[xr.Dataset],
    values: xr.DataArray,
    certain: bool,
) -> dict[str, Coordinate]:
    """Coordinate of each dimension: its namesake, else one along it whose CF role is its axis.

    Axes that the variable lacks take scalar coordinates. Where the file names no dimension,
    coordinates go by conventional names, as in any HDF5 file.
    """
    if all(dimension.startswith(MADE_UP) for dimension in dimensions):
        return beside(
            source, axes, shape, [_columns(dataset) for dataset in scope], certain=certain
        )
    coords = {}
    for axis, dimension, length in zip(axes, dimensions, shape, strict=True):
        along = [
            Column(name=name, length=length, read=array.to_numpy, attributes=array.attrs)
            for name, array in _along(dimension, scope)
            if array.shape == (length,)
        ]
        named = next((column for column in along if column.name == dimension), None)
        others = [column for column in along if column is not named]
        roles = (each for each in others if role_of_coordinate(each.name, each.attributes) == axis)
        found = real_time(named, others) if axis == "t" else named
        found = found or next(roles, None)
        if axis == "t" and (found is None or only_counts(found)):
            written = written_times(dimension, _texts(dimension, length, scope))
            if written is not None:
                coords[axis] = written
                continue
        if found is not None:
            coords[axis] = coordinate(source, found.name, found.read(), found.attributes)
    for key, scalar in values.coords.items():
        role = role_of_coordinate(str(key), scalar.attrs)
        if (
            scalar.ndim == 0
            and usable(scalar.dtype)
            and role in AXES
            and role not in axes
            and role not in coords
        ):
            coords[role] = coordinate(source, str(key), scalar.to_numpy(), scalar.attrs)
    return coords
