"""Reader of Zarr stores, folders and ZIPs, through the zarr library."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf import (
    SCALING,
    Column,
    Packing,
    beside,
    number_of_text,
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
    FolderStamp,
    Request,
    Stamp,
    StoredFiles,
    StoredValues,
    condense,
    refusing,
)
from fhash_formats.readers.common.layout import (
    Dimension,
    Layout,
    Read,
)
from fhash_formats.readers.common.listing import Listed, listing
from fhash_formats.readers.common.stored_parts import not_stored, warn_of_column, zarr_parts
from fhash_formats.readers.common.surroundings import (
    Arranged,
    Stored,
    Wanted,
    metadata_of,
    named_dimensions,
)
from fhash_formats.readers.common.variables import (
    MIN_DIMENSIONS,
    FileOfArrays,
    Variable,
    expand,
    field_reading,
    parent,
    plain_name,
)
from fhash_formats.readers.hdf5 import sibling
from fhash_formats.series import Coordinate, SourceMetadata, shown_name
from fhash_formats.support.values import PACKING, PLUMBING, STORED, json_attributes

if TYPE_CHECKING:
    import zarr

METADATA = ("zarr.json", ".zarray", ".zgroup")


def metadata_file(path: Path) -> Path | None:
    """The metadata file of a group or array in a folder; None if the folder is neither."""
    return next((path / name for name in METADATA if (path / name).is_file()), None)


def nodes_in_folder(folder: Path, place: str = "") -> Iterator[str]:
    """Paths of all groups and arrays below a group.

    Folders of chunks have no metadata and are not entered.
    """
    for child in sorted(folder.iterdir()):
        if child.is_dir() and metadata_file(child) is not None:
            yield f"{place}{child.name}"
            if not (child / ".zarray").is_file():
                yield from nodes_in_folder(child, f"{place}{child.name}/")


def nodes_in_zip(source: str, path: Path) -> tuple[str, list[str]]:
    """Place of the hierarchy in a ZIP, and its groups and arrays from there.

    The place is the top, or the one folder that was zipped.
    """
    with refusing(f"{source} cannot be read as a ZIP"), zipfile.ZipFile(path) as file:
        names = file.namelist()
    nodes = sorted(
        {name.rpartition("/")[0] for name in names if name.rpartition("/")[2] in METADATA}
    )
    tops = {name.split("/", 1)[0] for name in names}
    inside = "" if "" in nodes else next(iter(tops)) if len(tops) == 1 else None
    if inside is None or inside not in nodes:
        raise InputError(
            f"{source} is a ZIP that holds no zarr hierarchy ({', '.join(METADATA)} at its top)"
        )
    return inside, [node.removeprefix(inside).lstrip("/") for node in nodes]


def open_arrays(
    store: Any, inside: str, nodes: Iterable[str]
) -> tuple[dict[str, zarr.Array[Any]], dict[str, Mapping[str, Any]], dict[str, str]]:
    """Arrays by path, the attributes of groups, and the errors of those that cannot be opened.

    An array with an unknown codec does not bar the others.
    """
    import zarr

    arrays: dict[str, zarr.Array[Any]] = {}
    groups: dict[str, Mapping[str, Any]] = {}
    failed: dict[str, str] = {}
    for node in nodes:
        try:
            opened = zarr.open(store=store, path=f"{inside}/{node}".strip("/"), mode="r")
        except Exception as error:  # codecs, types and JSON raise all kinds
            failed[node] = condense(error)
            continue
        if isinstance(opened, zarr.Array):
            arrays[node] = opened
        else:
            groups[node] = dict(opened.attrs)
    return arrays, groups, failed


FILL = "_FillValue"


def dimension_names(array: zarr.Array[Any]) -> list[str | None]:
    """Name of each dimension, None for one without a name.

    Format 3 has a field for them, xarray an attribute in format 2.
    """
    names: Any = array.attrs.get("_ARRAY_DIMENSIONS") or getattr(
        array.metadata, "dimension_names", None
    )
    if not isinstance(names, list | tuple) or len(names) != array.ndim:
        return [None] * array.ndim
    return [str(name) if name is not None else None for name in names]


def _metadata(
    found: ZarrTree, path: str, arranged: Arranged, without: Collection[str]
) -> SourceMetadata | None:
    """Metadata of the array at a path: all that belongs to it.

    None where dimensions have no names, and nothing but positions lies beside the array.

    without: attributes that do not hold for the values.
    """
    group, _, name = path.rpartition("/")
    layout, coords = arranged.layout, arranged.coords
    with refusing(f"{found.source} cannot be read as zarr"):
        if not name:
            return None
        variables = {
            each.rpartition("/")[2]: stored
            for place in dict.fromkeys(["", group])  # those of the nearest place count
            for each, stored in _stored_in(found.arrays, place)
        }
        taken = {each.name.rpartition("/")[2]: None for each in coords.values()}
        if None in dimension_names(found.arrays[path]):
            if not any(
                each not in (name, *taken) and len(stored.shape) < MIN_DIMENSIONS
                for each, stored in variables.items()
            ):
                return None
            own = tuple(named_dimensions(layout, coords))
            variables[name] = replace(variables[name], dimensions=own)
            for each in taken.keys() & variables.keys():  # positions have their own dimension
                if variables[each].shape in [(length,) for length in layout.shape]:
                    variables[each] = replace(variables[each], dimensions=(each,))
        wanted = Wanted(
            source=found.source, name=name, used=[*taken], without=without, path=found.root
        )
        return metadata_of(wanted, variables, found.groups.get(group, {}), arranged)


def _stored_in(arrays: Mapping[str, zarr.Array[Any]], group: str) -> Sequence[tuple[str, Stored]]:
    """The arrays of a group; a dimension without a name has one of its own."""
    found = []
    for path, array in arrays.items():
        place, _, own = path.rpartition("/")
        if place != group:
            continue
        stored = Stored(
            dimensions=tuple(
                f"{own}_dim_{number}" if name is None else name
                for number, name in enumerate(dimension_names(array))
            ),
            shape=array.shape,
            dtype=np.dtype(array.dtype),
            attributes=_attributes(array),
            read=partial(_values, array),
        )
        found.append((path, stored))
    return found


def _attributes(array: zarr.Array[Any]) -> dict[str, Any]:
    """The attributes of an array, with the fill value in the type of the array."""
    found = {key: value for key, value in dict(array.attrs).items() if key not in PLUMBING}
    fill: Any = found.pop(FILL, None)
    if array.metadata.zarr_format == 2 and "_ARRAY_DIMENSIONS" in array.attrs:
        fill = array.fill_value if fill is None else fill
    dtype = np.dtype(array.dtype)
    if isinstance(fill, str) and dtype.kind == "f":
        number = number_of_text(fill)
        fill = fill if number is None else number
    if fill is not None:
        try:
            found[FILL] = dtype.type(fill) if dtype.kind in "iuf" else fill
        except (ValueError, OverflowError, TypeError):
            found[FILL] = fill
    return found


def _values(array: zarr.Array[Any], places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
    values = np.asarray(array[places])
    return values.astype(object) if values.dtype.kind in "TU" else values


ZIP = b"PK\x03\x04"


def matches(head: bytes, path: Path) -> bool:
    """Whether this is a folder with zarr metadata, or a ZIP."""
    return metadata_file(path) is not None if path.is_dir() else head.startswith(ZIP)


def open_zarr(path: Path, request: Request) -> FileSeries:
    """Open the series in a zarr hierarchy: the only suitable array, or the one named.

    Dimension names (format 3, or xarray's `_ARRAY_DIMENSIONS`) give axes and coordinates. Packing
    is undone (cf.py). Consolidated metadata is ignored: an outdated copy would hide
    appended steps.
    """
    store, found = open_tree(path, request)
    try:
        with refusing(f"{path} cannot be read as zarr"):
            return series_in(found.root, store, found)
    except BaseException:
        store.close()
        raise


def list_zarr(path: Path, request: Request) -> list[Listed]:
    """The variables of a zarr hierarchy."""
    store, found = open_tree(path, replace(request, raw_values=False))
    try:
        with refusing(f"{path} cannot be read as zarr"):
            return listing(found.source, found.variables, found.dimensions, request, found.packing)
    finally:
        store.close()


def open_tree(path: Path, request: Request) -> tuple[Any, ZarrTree]:
    """The store at a path, open, and what is in it. Raises InputError."""
    from zarr.storage import LocalStore, ZipStore

    source = str(path)
    if path.is_dir():
        if metadata_file(path) is None:
            raise InputError(f"{source} holds no zarr metadata ({', '.join(METADATA)})")
        inside, nodes = "", ["", *nodes_in_folder(path)]
        store: LocalStore | ZipStore = LocalStore(path, read_only=True)
    else:
        inside, nodes = nodes_in_zip(source, path)
        store = ZipStore(path, mode="r")
    try:
        with warnings.catch_warnings(), refusing(f"{source} cannot be read as zarr"):
            # zarr warns of codecs and types that are not in the specification
            warnings.simplefilter("ignore")
            arrays, groups, failed = open_arrays(store, inside, nodes)
            if "" in failed:
                raise InputError(f"{source} cannot be read as zarr: {failed['']}")
            # "." and ".." have a name and a folder around them too
            place = path if path.name.strip(".") else path.resolve()
            alone = "" in arrays and path.is_dir() and request.var is None
            if alone and metadata_file(place.parent) is not None:
                # an array of a group, named by its folder: its coordinates are beside it
                store.close()
                return open_tree(place.parent, replace(request, var=place.name))
            return store, ZarrTree(path, arrays, groups, failed, request)
    except BaseException:
        store.close()
        raise


class ZarrTree(FileOfArrays):
    """The arrays of an open hierarchy."""

    def __init__(
        self,
        root: Path,
        arrays: Mapping[str, zarr.Array[Any]],
        groups: Mapping[str, Mapping[str, Any]],
        failed: Mapping[str, str],
        request: Request,
    ) -> None:
        self.root, self.arrays, self.groups = root, arrays, groups
        super().__init__(str(root), request, expand(_variables(root, arrays, failed)))

    def _stated(self, variable: Variable) -> list[Dimension]:
        path, array = variable.handle
        columns = self._near_columns(path)
        stored = zip(dimension_names(array), array.shape, strict=True)
        return [
            *(_dimension(columns, name, length) for name, length in stored),
            *(Dimension(name=None, length=length) for length in variable.shape[array.ndim :]),
        ]

    def values(self, variable: Variable) -> _Values:
        """The values of a variable's array; of the first step where it has several."""
        return _Values(self.source, variable.handle[1], raw=self.request.raw_values)

    def packing(self, variable: Variable) -> Packing | None:
        """The packing of the values, None where the user wants them as stored."""
        return None if variable.field else self.values(variable).packing

    def _reading(self, variable: Variable) -> Read:
        values = self.values(variable)
        return field_reading(values.read, variable, values.array.ndim)

    def _positions(self, variable: Variable, layout: Layout) -> dict[str, Coordinate]:
        """Coordinates of the axes: those along a dimension by its name, else by their own name."""
        columns = self._near_columns(variable.handle[0])
        lower = [{name.lower(): column for name, column in place.items()} for place in columns]
        certain = self.request.axes is not None or all(
            dimension.role is not None for dimension in layout.kept
        )
        named = [
            (axis, dimension)
            for axis, dimension in zip(layout.axes, layout.kept, strict=True)
            if dimension.name is not None
        ]
        coords = beside(
            self.source,
            layout.axes,
            layout.shape,
            lower,
            certain=certain,
            tied=[axis for axis, _ in named],
        )
        found = {axis: _column_of(columns, axis, dimension.name) for axis, dimension in named}
        coords |= layout.coordinates(
            self.source,
            {
                axis: column
                for (axis, dimension), column in zip(named, found.values(), strict=True)
                if column is not None and column.numeric and column.length == dimension.length
            },
        )
        time, dimension = found.get("t"), dict(named).get("t")
        if dimension is not None and (time is None or not time.numeric or only_counts(time)):
            places = (parent(variable.handle[0]), "")
            near = (
                (name, array, dimension_names(array))
                for name, array in self.arrays.items()
                if parent(name) in places
            )
            along = str(dimension.name)
            written = written_times(along, texts_along(along, dimension.length, near))
            coords |= {} if written is None else {"t": written}
        return coords

    def _near_columns(self, path: str) -> list[dict[str, Column]]:
        """Columns in the group of an array, then in the root."""
        group = parent(path)
        return [_columns(self.source, self.arrays, place) for place in dict.fromkeys([group, ""])]

    def _columns(self, group: str) -> dict[str, Column]:
        columns = _columns(self.source, self.arrays, group)
        return {name.lower(): column for name, column in columns.items()}

    def _attributes(self, path: str) -> Mapping[str, Any]:
        return dict(self.arrays[path].attrs) if path in self.arrays else self.groups.get(path, {})

    def _scalar(self, path: str) -> tuple[float, str] | None:
        array = self.arrays.get(path)
        if array is None or array.size != 1 or array.dtype.kind not in "iuf":
            return None
        value = float(np.asarray(array[...]).reshape(-1)[0])
        return value, str(array.attrs.get("units", ""))


def _dimension(columns: Sequence[Mapping[str, Column]], name: str | None, length: int) -> Dimension:
    column = _namesake(columns, name)
    role = _hint(name, column)
    if column is None and name:
        along = [one for place in columns for one in place.values() if one.along == name]
        column = along[0] if along else None
    fitting = column if column is not None and column.length == length else None
    return Dimension(name=name, length=length, role=role, column=fitting)


def series_in(root: Path, store: Any, found: ZarrTree) -> FileSeries:
    """The series of the wanted variable of an open hierarchy, which closes its store."""
    request = found.request
    variable = found.choose(request.var)
    layout = found.arrange(variable)
    path, array = variable.handle
    packed = found.packing(variable)
    scaled = request.raw_values and SCALING & set(array.attrs)
    # the whole hierarchy where the steps are spread over it
    folder = root if variable.members else root / path
    chunks = (*((1,) if variable.members else ()), *array.chunks)
    trailing = variable.shape[len(chunks) :]
    # counts have not the unit of the values
    without = STORED | ({"units"} if scaled else frozenset())
    # without names, dimensions have those of the axes
    names = {each.name or axis for each, axis in zip(layout.kept, layout.axes, strict=True)}
    series = FileSeries(
        files=StoredFiles(
            source=found.source,
            # In a folder the array's metadata shows a change of shape at once; a changed chunk
            # shows when all files are checked at the end.
            stamp=Stamp.of((metadata_file(root / path) or root) if root.is_dir() else root),
            folder=FolderStamp.of(folder) if root.is_dir() else None,
            close=store.close,
        ),
        name=plain_name(shown_name(variable.name, names)),
        values=StoredValues(
            shape=layout.shape,
            dtype=variable.dtype if packed is None else packed.dtype,
            axes=layout.axes,
            fetch=layout.fetch(found.reading(variable)),
            chunks=layout.chunks((*chunks, *trailing)),
            packing=packed,
            not_stored=not_stored(
                [zarr_parts(member.handle[1]) for member in variable.members or (variable,)],
                layout,
                joined=bool(variable.members),
            ),
        ),
        coords=found.coordinates(variable, layout),
        attributes=json_attributes(dict(array.attrs), without=without) | layout.attributes(),
    )
    if not variable.members and not variable.field:
        arranged = Arranged(layout=layout, request=request, packed=packed, coords=series.coords)
        unfit = without if request.raw_values else ()
        series.metadata = partial(_metadata, found, path, arranged, unfit)
    return series


def _variables(
    root: Path, arrays: Mapping[str, zarr.Array[Any]], failed: Mapping[str, str]
) -> list[Variable]:
    """All arrays as Variables; the bounds of others are auxiliary."""
    bounds = {
        sibling(name, str(array.attrs["bounds"]))
        for name, array in arrays.items()
        if "bounds" in array.attrs
    }
    readable = [
        Variable(
            name=name or root.stem,
            shape=array.shape,
            dtype=array.dtype,
            auxiliary=name in bounds,
            handle=(name, array),
            units=str(array.attrs.get("units", "")),
        )
        for name, array in arrays.items()
    ]
    return readable + [
        Variable(name=name or root.stem, shape=(), dtype=np.dtype(object), error=error)
        for name, error in failed.items()
    ]


def _namesake(columns: Sequence[Mapping[str, Column]], name: str | None) -> Column | None:
    """The column with the name of a dimension, from the nearest place."""
    if not name:
        return None
    return next((place[name] for place in columns if name in place), None)


def _hint(name: str | None, column: Column | None) -> str | None:
    """The axis that a dimension's name or its coordinate's attributes say, or None."""
    if not name:
        return None
    return role_of_coordinate(name, column.attributes) if column else role_of_name(name)


def _column_of(
    columns: Sequence[Mapping[str, Column]], axis: str, dimension: str | None
) -> Column | None:
    """The column of positions along a dimension; of time, one that does not only count steps."""
    namesake = _namesake(columns, dimension)
    if axis == "t" and dimension is not None:
        along = [each for place in columns for each in place.values() if each.along == dimension]
        time = real_time(namesake, [each for each in along if each is not namesake])
        if time is not None:
            return time
    return namesake or _along(columns, axis, dimension)


def _along(
    columns: Sequence[Mapping[str, Column]], axis: str, dimension: str | None
) -> Column | None:
    """Array along one dimension that is a coordinate of the axis by its own name or attributes.

    Its name differs from that of the dimension.
    """
    along = [
        column
        for place in columns
        for column in place.values()
        if dimension is not None and column.along == dimension
    ]
    return next(
        (
            column
            for column in along
            if role_of_coordinate(column.name.rpartition("/")[2], column.attributes) == axis
        ),
        None,
    )


def _columns(source: str, arrays: Mapping[str, zarr.Array[Any]], group: str) -> dict[str, Column]:
    """Arrays directly in a group that may be coordinates, by name."""
    columns = {}
    for path, array in arrays.items():
        place, _, name = path.rpartition("/")
        numeric = usable(array.dtype)
        if path and place == group and array.ndim < 2 and (numeric or array.dtype.kind in "SUTO"):
            along = dimension_names(array)[0] if array.ndim else None
            attributes = json_attributes(dict(array.attrs), without=PLUMBING | PACKING)
            columns[name] = Column(
                name=path,
                length=array.size,
                along=along,
                read=_Values(source, array).whole,
                attributes=attributes,
                numeric=numeric,
            )
    return columns


class _Values:
    """Physical values of a zarr array, and their type; the stored ones if they are `raw`."""

    def __init__(self, source: str, array: zarr.Array[Any], *, raw: bool = False) -> None:
        self.array = array
        # xarray keeps `_FillValue` as the fill value of zarr's own in format 2, where other writers
        # use that for chunks never written
        cf_fill = (
            array.fill_value
            if array.metadata.zarr_format == 2 and "_ARRAY_DIMENSIONS" in array.attrs
            else None
        )
        self.packing = (
            packing(source, array.dtype, dict(array.attrs), cf_fill)
            if array.dtype.kind in "iuf" and not raw
            else None
        )
        self.dtype = self.packing.dtype if self.packing else array.dtype

    def read(self, ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Values in ranges of the array's dimensions."""
        stored = np.asarray(self.array[ranges])
        return self.packing.unpack(stored) if self.packing else stored

    def whole(self) -> npt.NDArray[Any]:
        """All values of a coordinate."""
        parts = zarr_parts(self.array)
        if parts is not None and parts.fill == parts.fill:
            warn_of_column(self.array.name, parts)
        return self.read(())
