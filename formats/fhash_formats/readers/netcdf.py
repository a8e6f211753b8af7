"""Reader of NetCDF 3 and 4."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from math import prod
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
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
from fhash_formats.series import (
    AXES,
    COORDINATES,
    Coordinate,
    SourceMetadata,
    references,
    shown_name,
)
from fhash_formats.support.values import STORED, decoded_text, json_attributes, text_of

if TYPE_CHECKING:
    import xarray as xr

    Groups = Mapping[str, "xr.Dataset | Group"]

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


class Array:
    """A variable of a file, decoded by the CF conventions: what a reader needs of xarray's.

    Attributes:
        stored: as the file has it.
        dims, shape, dtype: of the values; an array of letters is one of texts.
        attrs, encoding: what the file says of it.
    """

    def __init__(self, source: str, stored: Stored, chunks: Any, *, letters: bool) -> None:
        self.stored, self.attrs = stored, stored.attributes
        self.encoding = {**stored.attributes, "dtype": stored.dtype, "chunksizes": chunks}
        self.dims, self.shape, self.dtype = stored.dimensions, stored.shape, stored.dtype
        self._letters, self._packing = letters, None
        if letters:
            self.dims, self.dtype = self.dims[:-1], np.dtype(f"S{self.shape[-1]}")
            self.shape = self.shape[:-1]
        with suppress(InputError):  # which the variable that is chosen raises, see `declared`
            self._packing = declared(source, self)
        if self._packing is not None:
            self.dtype = self._packing.dtype

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def size(self) -> int:
        return prod(self.shape)

    def __getitem__(self, places: Any) -> npt.NDArray[Any]:
        if self._letters:
            stored = np.ascontiguousarray(self.stored.read((*np.index_exp[places], slice(None))))
            return stored.view(f"S{stored.shape[-1]}")[..., 0]
        values = self.stored.read(np.index_exp[places])
        return values if self._packing is None else self._packing.unpack(values)

    def to_numpy(self) -> npt.NDArray[Any]:
        """All values."""
        return self[...]


@dataclass(frozen=True, kw_only=True)
class Group:
    """A group of a file, as a Dataset of xarray is one; `coords` are names of variables."""

    variables: Mapping[str, Array]
    coords: Sequence[str]
    attrs: Mapping[str, Any]


def _group(
    source: str, variables: Mapping[str, tuple[Stored, Any]], attributes: Mapping[str, Any]
) -> Group:
    """The group of stored variables, each with the shape of its chunks.

    Coordinates are what a dimension is called, and what the attributes of CF name, if all that one
    attribute names is there (xarray's `decode_coords="all"`).
    """
    stored = [each for each, _ in variables.values()]
    coords = {name for each in stored for name in each.dimensions}
    for told in ({COORDINATES: attributes.get(COORDINATES)}, *(each.attributes for each in stored)):
        for key, found in groupby(references(told), itemgetter(0)):
            names = {name for _, name in found}
            if key == COORDINATES or (key != "ancillary_variables" and names <= {*variables}):
                coords |= names
    # a dimension of letters is the last one, has no variable, and nothing else has it
    other = {*variables, *(name for each in stored for name in each.dimensions[:-1])}
    other |= {name for each in stored if each.dtype.kind != "S" for name in each.dimensions}
    arrays = {}
    for name, (each, chunks) in variables.items():
        letters = each.dtype == "S1" and each.dimensions and each.dimensions[-1] not in other
        arrays[name] = Array(source, each, chunks, letters=bool(letters and each.shape[-1]))
    return Group(
        variables=arrays, coords=[name for name in arrays if name in coords], attrs=attributes
    )


def open_groups(source: str, path: Path, head: bytes) -> tuple[dict[str, Group], Callable[[], Any]]:
    """All groups of a file by path, "/" first, and what closes them."""
    if head in CLASSIC:
        from fhash_formats.readers.netcdf3 import read_header

        with refusing(f"{source} cannot be read as classic NetCDF"):
            header = read_header(path)
        arrays = {
            name: (_stored(each, each.attributes), None) for name, each in header.variables.items()
        }
        return {"/": _group(source, arrays, header.attributes)}, lambda: None
    import h5netcdf

    # dimensions without a scale get a made-up name, so that HDF5 files named .nc open too
    file = h5netcdf.File(path, "r", phony_dims="access", decode_vlen_strings=True)
    try:
        return dict(_groups_of(source, "/", file)), file.close
    except BaseException:
        file.close()
        raise


def _groups_of(source: str, name: str, group: Any) -> Iterator[tuple[str, Group]]:
    arrays = {
        key: (_stored(each, _attributes_of(each)), each.chunks)
        for key, each in group.variables.items()
    }
    yield name, _group(source, arrays, _attributes_of(group))
    for key, inner in group.groups.items():
        yield from _groups_of(source, f"{name.rstrip('/')}/{key}", inner)


def _attributes_of(described: Any) -> dict[str, Any]:
    """Attributes in an HDF5 file, with bytes as texts unless they stand for missing values."""
    return {
        key: decoded_text(value)
        if isinstance(value, bytes) and key not in ("_FillValue", "missing_value")
        else value
        for key, value in described.attrs.items()
    }


def _stored(array: Any, attributes: Mapping[str, Any]) -> Stored:
    """A variable of h5netcdf, or a ClassicArray; numbers in native byte order."""
    text = array.dtype.kind == "O" and (array.dtype.metadata or {}).get("vlen") in (str, bytes)
    # without what h5py notes of the stored type, such as enumerations
    dtype = np.dtype(str if text else array.dtype.newbyteorder("=").str)
    if attributes.get("dtype") == "bool":  # as xarray writes booleans
        dtype, attributes = np.dtype(bool), {**attributes}
        del attributes["dtype"]

    def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        values = np.asarray(array[places])
        return values if dtype.kind in "UO" else values.astype(dtype, copy=False)

    return Stored(
        dimensions=tuple(map(str, array.dimensions)),
        shape=array.shape,
        dtype=dtype,
        attributes=attributes,
        read=read,
    )


def declared(source: str, array: xr.Variable | Array) -> Packing | None:
    """The packing of a variable; None for types that cannot be packed."""
    stored = np.dtype(array.encoding.get("dtype", array.dtype))
    return packing(source, stored, array.encoding) if stored.kind in "iuf" else None


def default_fill(array: xr.Variable | Array, packed: Packing | None) -> float | int | None:
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
        opened, close = open_groups(source, path, magic_of(path))
        try:
            scope = [opened[group] for group in groups if group in opened]
            variables = {
                name: array.stored
                for group in reversed(scope)
                for name, array in group.variables.items()
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
            close()


def stored_variable(array: xr.Variable) -> Stored:
    """A variable of xarray of which nothing was decoded."""
    return Stored(
        dimensions=tuple(map(str, array.dims)),
        shape=array.shape,
        dtype=array.dtype,
        attributes=dict(array.attrs),
        read=lambda places: array[places].to_numpy(),
    )


SUFFIXES = (".nc", ".nc4", ".netcdf", ".cdf")
MADE_UP = "phony_dim_"
"""Prefix of the names that h5netcdf makes up for dimensions without one."""


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
    with refusing(f"{source} cannot be read as NetCDF"):
        groups, close = open_groups(source, path, head)
        try:
            files = StoredFiles(source=source, stamp=stamp, close=close)
            return _series(source, path, files, groups, request)
        except BaseException:
            close()
            raise


class NetcdfFile(FileOfArrays):
    """The variables of an open NetCDF file, or of datasets of xarray."""

    def __init__(self, source: str, path: Path, groups: Groups, request: Request) -> None:
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

    def array(self, variable: Variable) -> xr.Variable | Array:
        """The stored array of a variable; of the first step where it has one array a step."""
        group, name = variable.handle
        return self.groups[group].variables[name]

    def scope(self, variable: Variable) -> list[xr.Dataset | Group]:
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
        assert isinstance(array, Array), "a dataset of xarray reads its values itself"
        return array.stored.read if self.request.raw_values else array.__getitem__

    def _positions(self, variable: Variable, layout: Layout) -> dict[str, Coordinate]:
        """Coordinates of the axes, of what was selected, and of scalars that lie beside."""
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


def _labels(dimension: str, length: int, scope: Sequence[xr.Dataset | Group]) -> Column | None:
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
    source: str, path: Path, files: StoredFiles, groups: Groups, request: Request
) -> FileSeries:
    found = NetcdfFile(source, path, groups, request)
    variable = found.choose(request.var)
    layout = found.arrange(variable)
    array = found.array(variable)
    packed, without = declared(source, array), STORED
    dtype = array.dtype
    if request.raw_values and packed is not None:
        # counts have not the unit of the values
        without |= {"units"} if packed.scaled else frozenset()
        packed, dtype = None, array.encoding["dtype"]
    members = [each.name for each in variable.members or (variable,)]
    parts, beside = hdf5_parts(source, path, members)
    chunks = array.encoding.get("chunksizes")
    # without names, dimensions have those of the axes
    names = {each.name or axis for each, axis in zip(layout.kept, layout.axes, strict=True)}
    series = FileSeries(
        files=replace(files, beside=beside),
        name=plain_name(shown_name(variable.name, names)),
        values=StoredValues(
            shape=layout.shape,
            dtype=dtype,
            axes=layout.axes,
            fetch=layout.fetch(found.reading(variable)),
            chunks=layout.chunks(chunks and (*((1,) if variable.members else ()), *chunks)),
            packing=packed,
            not_stored=not_stored(parts, layout, joined=bool(variable.members)),
            default_fill=None if request.raw_values else default_fill(array, packed),
        ),
        coords=found.coordinates(variable, layout),
        attributes=json_attributes(array.attrs, without=without) | layout.attributes(),
    )
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
    with refusing(f"{source} cannot be read as NetCDF"):
        groups, close = open_groups(source, path, magic_of(path))
        try:
            found = NetcdfFile(source, path, groups, replace(request, raw_values=False))
            return listing(source, found.variables, found.dimensions, request, found.packing)
        finally:
            close()


def _upwards(group: str) -> list[str]:
    """Path of a group and of the groups around it, the root last.

    NetCDF4 groups inherit dimensions and coordinates from those around them.
    """
    parts = [part for part in group.split("/") if part]
    return ["/" + "/".join(parts[:count]) for count in range(len(parts), -1, -1)]


def _along(
    dimension: str, scope: Sequence[xr.Dataset | Group]
) -> Iterator[tuple[str, xr.Variable | Array]]:
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


def _role(dimension: str, scope: Sequence[xr.Dataset | Group]) -> str | None:
    for name, array in _along(dimension, scope):
        role = role_of_coordinate(name, array.attrs)
        if role is not None:
            return role
    return role_of_name(dimension)


def _columns(dataset: xr.Dataset | Group) -> dict[str, Column]:
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
    scope: Sequence[xr.Dataset | Group],
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
    for key in map(str, scope[0].coords):
        scalar = scope[0].variables[key]
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
