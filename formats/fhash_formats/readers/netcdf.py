"""Reader of NetCDF 3 and 4."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.readers.common.cf import (
    Column,
    Packing,
    beside,
    coordinate,
    only_counts,
    packing,
    real_time,
    role_of_coordinate,
    role_of_name,
    texts_along,
    usable,
    written_times,
)
from fhash_formats.readers.common.file_series import (
    FileSeries,
    Request,
    Stamp,
    StoredFiles,
    StoredValues,
    refusing,
)
from fhash_formats.readers.common.layout import (
    Dimension,
    Layout,
    Read,
)
from fhash_formats.readers.common.listing import Listed, listing
from fhash_formats.readers.common.stored_parts import hdf5_parts, not_stored
from fhash_formats.readers.common.surroundings import Arranged, Stored, Wanted, metadata_of
from fhash_formats.readers.common.variables import (
    FileOfArrays,
    Variable,
    plain_name,
)
from fhash_formats.readers.hdf5 import is_hdf5, require_filters
from fhash_formats.series import AXES, Coordinate, SourceMetadata, shown_name
from fhash_formats.support.arrays import Values
from fhash_formats.support.values import STORED, is_wide_integer, json_attributes, text_of

if TYPE_CHECKING:
    import xarray as xr

Exact = Callable[[Values, tuple[slice, ...]], Values]

DEFAULT_FILLS = {
    "i2": -32767,
    "u2": 65535,
    "i4": -2147483647,
    "u4": 4294967295,
    "i8": -9223372036854775806,
    "u8": 18446744073709551614,
    "f4": 9.969209968386869e36,
    "f8": 9.969209968386869e36,
}
"""NC_FILL_SHORT and so on of netcdf.h; bytes have none that counts."""

CLASSIC = (b"CDF\x01", b"CDF\x02", b"CDF\x05")
"""First bytes of classic files."""


def magic_of(path: Path) -> bytes:
    """The first four bytes of a file."""
    with path.open("rb") as file:
        return file.read(4)


@contextmanager
def quietly() -> Iterator[None]:
    """Silence xarray's warnings about a file (several fill values, bounds that are missing).

    None of them changes the values that are read.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def open_groups(
    source: str, path: Path, head: bytes, *, raw: bool = False, decoded: bool = True
) -> Mapping[str, xr.Dataset]:
    """Datasets of all groups by path, "/" first.

    raw: leave values packed. decoded: whether attributes that name variables are taken out, and
    these made coordinates; if not, everything is as it is stored.
    """
    import xarray as xr

    options: dict[str, Any] = {
        "decode_times": False,
        "decode_timedelta": False,
        "decode_coords": "all",
        "cache": False,
        "chunks": None,
        "mask_and_scale": not raw,
    }
    if not decoded:
        options |= {"decode_coords": False, "concat_characters": False, "mask_and_scale": False}
    if head in CLASSIC:
        from fhash_formats.readers.netcdf3 import ClassicStore

        with refusing(f"{source} cannot be read as classic NetCDF"):
            return {"/": xr.open_dataset(ClassicStore(path), engine="store", **options)}
    # dimensions without a scale get a made-up name, so that HDF5 files named .nc open too
    return xr.open_groups(path, engine="h5netcdf", phony_dims="access", **options)


def close_groups(groups: Mapping[str, xr.Dataset]) -> None:
    """Close the datasets of all groups."""
    with quietly():
        for dataset in groups.values():
            dataset.close()


def declared(source: str, array: xr.Variable) -> Packing | None:
    """The packing of a variable that xarray unpacks; None for types that cannot be packed."""
    stored = np.dtype(array.encoding.get("dtype", array.dtype))
    return packing(source, stored, array.encoding) if stored.kind in "iuf" else None


def default_fill(array: xr.Variable, packed: Packing | None) -> float | int | None:
    """The number that NetCDF puts where nobody wrote, as it is read.

    None for bytes, and where the variable declares a fill value of its own.
    """
    if packed is None or {"_FillValue", "missing_value"} & {*array.encoding, *array.attrs}:
        return None
    stored = DEFAULT_FILLS.get(packed.stored.str[1:])
    if stored is None:
        return None
    value: float | int = packed.unpack(np.array([stored], packed.stored))[0].item()
    return value


def exactly_filled(source: str, path: Path, name: str, encoding: Mapping[str, Any]) -> Exact | None:
    """A test that tells a fill value from its neighbours; None where float64 suffices.

    xarray compares as float64, in which many 64-bit integers beyond 2^53 are equal.
    """
    stored = np.dtype(encoding.get("dtype", np.float32))
    if not is_wide_integer(stored):
        return None
    plain = {
        key: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for key, value in encoding.items()
    }
    packed = packing(source, stored, plain)
    if all(abs(int(fill)) < 1 << 53 for fill in packed.fills):
        return None

    def exact(values: Values, ranges: tuple[slice, ...]) -> Values:
        if not np.isnan(values).any():
            return values
        return packed.unpack(_stored(path, name, ranges))

    return exact


def _stored(path: Path, name: str, ranges: tuple[slice, ...]) -> Values:
    if magic_of(path) in CLASSIC:
        from fhash_formats.readers.netcdf3 import read_header

        return read_header(path).variables[name].read(ranges)
    import h5py

    with h5py.File(path, "r") as file:
        return np.asarray(file[name][ranges])


def check_filters(source: str, path: Path, name: str) -> None:
    """Raise an error that says what is missing, if a variable cannot be decompressed here."""
    import h5py

    if not h5py.is_hdf5(path):
        return
    with h5py.File(path, "r") as file:
        dataset = file.get(name)
        if isinstance(dataset, h5py.Dataset):
            require_filters(source, name, dataset)


def _metadata(
    path: Path,
    handle: tuple[str, str],
    groups: Collection[str],
    arranged: Arranged,
    without: Collection[str],
) -> SourceMetadata:
    """Metadata of a variable: all that belongs to it.

    handle: group and name of the variable. groups: its own group and those around it, the nearest
        first. without: attributes that do not hold for the values.
    """
    source = str(path)
    with refusing(f"{source} cannot be read as NetCDF"):
        with quietly():
            opened = open_groups(source, path, magic_of(path), decoded=False)
        try:
            scope = [opened[group] for group in groups if group in opened]
            variables = {
                str(name): stored_variable(array)
                for dataset in reversed(scope)
                for name, array in dataset.variables.items()
            }
            wanted = Wanted(
                source=source,
                name=handle[1],
                used=[each.name for each in arranged.coords.values()],
                without=without,
                path=path,
            )
            return metadata_of(wanted, variables, scope[0].attrs, arranged)
        finally:
            close_groups(opened)


def stored_variable(array: xr.Variable) -> Stored:
    """A variable of a dataset of which nothing was decoded."""
    return Stored(
        dimensions=tuple(map(str, array.dims)),
        shape=array.shape,
        dtype=array.dtype,
        attributes=dict(array.attrs),
        read=partial(_values, array),
    )


def _values(array: xr.Variable, places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
    with quietly():
        values: npt.NDArray[Any] = array[places].to_numpy()
    # without what xarray notes of the stored type, such as enumerations
    return values if values.dtype.kind == "O" else np.asarray(values, dtype=values.dtype.str)


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


class NetcdfFile(FileOfArrays):
    """The variables of an open NetCDF file."""

    def __init__(
        self, source: str, path: Path, groups: Mapping[str, xr.Dataset], request: Request
    ) -> None:
        self.path, self.groups = path, groups
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
        super().__init__(source, request, found)

    def array(self, variable: Variable) -> xr.Variable:
        """The stored array of a variable; of the first step where it has one array a step."""
        group, name = variable.handle
        return self.groups[group].variables[name]

    def scope(self, variable: Variable) -> list[xr.Dataset]:
        """The group of a variable and those around it."""
        return [
            self.groups[place] for place in _upwards(variable.handle[0]) if place in self.groups
        ]

    def _stated(self, variable: Variable) -> list[Dimension]:
        scope, array = self.scope(variable), self.array(variable)
        return [
            Dimension(
                name=None if name.startswith(MADE_UP) else name,
                length=length,
                role=_role(name, scope),
                column=_labels(name, length, scope),
            )
            for name, length in zip(map(str, array.dims), array.shape, strict=True)
        ]

    def packing(self, variable: Variable) -> Packing | None:
        """The packing of the values, None where the user wants them as stored."""
        return None if self.request.raw_values else declared(self.source, self.array(variable))

    def _reading(self, variable: Variable) -> Read:
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

    def _positions(self, variable: Variable, layout: Layout) -> dict[str, Coordinate]:
        """Coordinates of the axes, of what was selected, and of scalars that lie beside."""
        group, name = variable.handle
        names = [str(dimension) for dimension in self.array(variable).dims]
        if variable.members:
            names.insert(0, MADE_UP + "step")
        kept = [name for place, name in enumerate(names) if place not in layout.picked]
        return layout.coordinates(self.source, {}) | _coordinates(
            self.source,
            layout.axes,
            kept,
            layout.shape,
            self.scope(variable),
            self.groups[group][name],
            self.request.axes is not None,
        )

    def _columns(self, group: str) -> Mapping[str, Column]:
        return _columns(self.groups[f"/{group}"])

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
    variable = found.choose(request.var)
    layout = found.arrange(variable)
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
            files=StoredFiles(source=source, stamp=stamp, close=close, beside=beside),
            name=plain_name(shown_name(variable.name, names)),
            values=StoredValues(
                shape=layout.shape,
                dtype=array.dtype,
                axes=layout.axes,
                fetch=layout.fetch(found.reading(variable)),
                chunks=layout.chunks(chunks and (*((1,) if variable.members else ()), *chunks)),
                packing=packed,
                not_stored=not_stored(parts, layout, joined=bool(variable.members)),
                default_fill=None if request.raw_values else default_fill(array, packed),
            ),
            coords=NetcdfFile(source, path, groups, request).coordinates(variable, layout),
            attributes=json_attributes(array.attrs, without=without) | layout.attributes(),
        )
    except BaseException:
        close()
        raise
    if not variable.members and not any(str(name).startswith(MADE_UP) for name in array.dims):
        series.metadata = partial(
            _metadata,
            path,
            variable.handle,
            _upwards(variable.handle[0]),
            Arranged(layout=layout, request=request, packed=packed, coords=series.coords),
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
            arrays = (
                (str(name), array, array.dims)
                for dataset in scope
                for name, array in dataset.variables.items()
            )
            written = written_times(dimension, texts_along(dimension, length, arrays))
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
