"""Zarr of formats 2 and 3, in a folder or a ZIP: an array, or a group with arrays in it."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf_packing import packing
from fhash_formats.readers.common.failures import FolderStamp, Stamp, condense, refusing
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.hdf5_tree import sibling
from fhash_formats.readers.common.positions import Column, beside, coordinate, usable
from fhash_formats.readers.common.real_time import real_time
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.roles import assign_axes, role_of_coordinate, role_of_name
from fhash_formats.readers.common.variables import Variable, choose
from fhash_formats.series import Coordinate
from fhash_formats.support.attributes import PACKING, PLUMBING, json_attributes

if TYPE_CHECKING:
    import zarr

ZIP = b"PK\x03\x04"
METADATA = ("zarr.json", ".zarray", ".zgroup")


def matches(head: bytes, path: Path) -> bool:
    """Whether this is a folder with zarr metadata, or a ZIP."""
    return _metadata(path) is not None if path.is_dir() else head.startswith(ZIP)


def _metadata(path: Path) -> Path | None:
    return next((path / name for name in METADATA if (path / name).is_file()), None)


def open_zarr(path: Path, request: Request) -> FileSeries:
    """Open the series in a zarr hierarchy: the only suitable array, or the one named.

    Dimension names (format 3, or xarray's `_ARRAY_DIMENSIONS`) give axes and coordinates. Packing
    is undone (cf_packing.py). Consolidated metadata is ignored: an outdated copy would hide
    appended steps.
    """
    from zarr.storage import LocalStore, ZipStore

    source = str(path)
    if path.is_dir():
        if _metadata(path) is None:
            raise InputError(f"{source} holds no zarr metadata ({', '.join(METADATA)})")
        inside, nodes = "", ["", *_nodes_in_folder(path)]
        store: LocalStore | ZipStore = LocalStore(path, read_only=True)
    else:
        inside, nodes = _nodes_in_zip(source, path)
        store = ZipStore(path, mode="r")
    try:
        with warnings.catch_warnings(), refusing(f"{source} cannot be read as zarr"):
            warnings.simplefilter(
                "ignore"
            )  # zarr warns of codecs and types that are not in the specification
            arrays, failed = _open_arrays(store, inside, nodes)
            if "" in failed:
                raise InputError(f"{source} cannot be read as zarr: {failed['']}")
            place = (
                path if path.name.strip(".") else path.resolve()
            )  # "." and ".." have a name and a folder around them too
            if (
                "" in arrays
                and path.is_dir()
                and request.var is None
                and _metadata(place.parent) is not None
            ):
                # an array of a group, named by its folder: its coordinates are beside it
                store.close()
                return open_zarr(place.parent, replace(request, var=place.name))
            return _series(path, store, arrays, failed, request)
    except BaseException:
        store.close()
        raise


def _nodes_in_folder(folder: Path, place: str = "") -> Iterator[str]:
    """Paths of all groups and arrays below a group.

    Folders of chunks have no metadata and are not entered.
    """
    for child in sorted(folder.iterdir()):
        if child.is_dir() and _metadata(child) is not None:
            yield f"{place}{child.name}"
            if not (child / ".zarray").is_file():
                yield from _nodes_in_folder(child, f"{place}{child.name}/")


def _nodes_in_zip(source: str, path: Path) -> tuple[str, list[str]]:
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


def _open_arrays(
    store: Any, inside: str, nodes: Iterable[str]
) -> tuple[dict[str, zarr.Array[Any]], dict[str, str]]:
    """Arrays by path, and the errors of those that cannot be opened.

    An array with an unknown codec does not bar the others.
    """
    import zarr

    arrays: dict[str, zarr.Array[Any]] = {}
    failed: dict[str, str] = {}
    for node in nodes:
        try:
            opened = zarr.open(store=store, path=f"{inside}/{node}".strip("/"), mode="r")
        except Exception as error:  # codecs, types and JSON raise all kinds
            failed[node] = condense(error)
            continue
        if isinstance(opened, zarr.Array):
            arrays[node] = opened
    return arrays, failed


def _series(
    root: Path,
    store: Any,
    arrays: Mapping[str, zarr.Array[Any]],
    failed: Mapping[str, str],
    request: Request,
) -> FileSeries:
    source = str(root)
    variable = choose(
        source, _variables(root, arrays, failed), request.var, booleans=request.booleans
    )
    path, array = variable.handle
    axes, coords = _axes_and_coordinates(source, arrays, path, request)
    values = _Values(source, array)
    return FileSeries(
        source=source,
        name=variable.name.rpartition("/")[2],
        shape=array.shape,
        dtype=values.dtype,
        axes=axes,
        fetch=values.read,
        # In a folder the array's metadata shows a change of shape at once; a changed chunk shows
        # when all files are checked at the end.
        stamp=Stamp.of((_metadata(root / path) or root) if root.is_dir() else root),
        folder=FolderStamp.of(root / path) if root.is_dir() else None,
        coords=coords,
        attributes=json_attributes(dict(array.attrs), without=PLUMBING | PACKING),
        chunks=array.chunks,
        close=store.close,
    )


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
        )
        for name, array in arrays.items()
    ]
    return readable + [
        Variable(name=name or root.stem, shape=(), dtype=np.dtype(object), error=error)
        for name, error in failed.items()
    ]


def _axes_and_coordinates(
    source: str, arrays: Mapping[str, zarr.Array[Any]], path: str, request: Request
) -> tuple[tuple[str, ...], dict[str, Coordinate]]:
    """The axis of each dimension of the array at `path`, and its coordinates by axis."""
    array = arrays[path]
    names = dimension_names(array)
    group = path.rpartition("/")[0]
    columns = [_columns(source, arrays, place) for place in dict.fromkeys([group, ""])]
    namesakes = [_namesake(columns, name) for name in names]
    hints = [_hint(name, column) for name, column in zip(names, namesakes, strict=True)]
    axes = assign_axes(source, array.shape, hints, names, request.axes)
    lower = [{name.lower(): column for name, column in place.items()} for place in columns]
    certain = request.axes is not None or all(hint is not None for hint in hints)
    tied = [axis for axis, name in zip(axes, names, strict=True) if name is not None]
    coords: dict[str, Coordinate] = beside(
        source, axes, array.shape, lower, certain=certain, tied=tied
    )
    for axis, length, name, namesake in zip(axes, array.shape, names, namesakes, strict=True):
        column = namesake or _along(columns, axis, name)
        if axis == "t" and name is not None:
            along = [each for place in columns for each in place.values() if each.along == name]
            column = real_time(namesake, [each for each in along if each is not namesake]) or column
        if column is not None and column.length == length:
            coords[axis] = coordinate(source, column.name, column.read(), column.attributes)
    return axes, coords


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
        if path and place == group and array.ndim < 2 and usable(array.dtype):
            along = dimension_names(array)[0] if array.ndim else None
            attributes = json_attributes(dict(array.attrs), without=PLUMBING | PACKING)
            columns[name] = Column(
                name=path,
                length=array.size,
                along=along,
                read=_Values(source, array).whole,
                attributes=attributes,
            )
    return columns


class _Values:
    """Physical values of a zarr array, and their type."""

    def __init__(self, source: str, array: zarr.Array[Any]) -> None:
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
            if array.dtype.kind in "iuf"
            else None
        )
        self.dtype = self.packing.dtype if self.packing else array.dtype

    def read(self, ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Values in ranges of the array's dimensions."""
        stored = np.asarray(self.array[ranges])
        return self.packing.unpack(stored) if self.packing else stored

    def whole(self) -> npt.NDArray[Any]:
        """All values."""
        return self.read(())
