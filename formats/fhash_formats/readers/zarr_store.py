"""Reader of Zarr stores, folders and ZIPs, through the zarr library."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.cf import number_of_text
from fhash_formats.readers.file_series import (
    Request,
    Stamp,
    condense,
    naming,
    refusing,
)
from fhash_formats.readers.stored_bytes import MAX_HEADER, lattice
from fhash_formats.readers.stored_parts import zarr_parts
from fhash_formats.readers.variables import (
    HEADER,
    Behind,
    Source,
    Variable,
    components,
    file_source,
    placed,
)
from fhash_formats.series import AXES, AXIS_NAMES
from fhash_formats.support.values import PLUMBING

if TYPE_CHECKING:
    import zarr

METADATA = ("zarr.json", ".zarray", ".zgroup")


def metadata_file(path: Path) -> Path | None:
    """The metadata file of a group or array in a folder; None if the folder is neither."""
    return next((path / name for name in METADATA if (path / name).is_file()), None)


def nodes_in_folder(folder: Path) -> Iterator[str]:
    """Paths of all groups and arrays below a group, each once, whatever links lead to it.

    Folders of chunks have no metadata and are not entered.
    """
    waiting, seen = [(folder, "")], set()
    while waiting:
        here, place = waiting.pop()
        state = here.stat()
        if (state.st_dev, state.st_ino) in seen:
            continue
        seen.add((state.st_dev, state.st_ino))
        if place:
            yield place
        if not place or not (here / ".zarray").is_file():
            children = [each for each in sorted(here.iterdir(), reverse=True) if each.is_dir()]
            waiting += [
                (child, f"{place}/{child.name}".lstrip("/"))
                for child in children
                if metadata_file(child) is not None
            ]


def nodes_in_zip(source: str, path: Path) -> tuple[str, list[str]]:
    """Place of the hierarchy in a ZIP, and its groups and arrays from there.

    The place is the top, or the one folder that was zipped.
    """
    with (
        refusing(f"{source} cannot be read as a ZIP, it is cut or damaged"),
        zipfile.ZipFile(path) as file,
    ):
        names = file.namelist()
        for each in file.infolist():
            if each.filename.endswith(METADATA) and each.file_size > MAX_HEADER:
                raise InputError(f"{source}: {each.filename[:80]} has {each.file_size} bytes")
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
            if isinstance(opened, zarr.Array):
                _ = opened.shards or opened.chunks  # refused where their grid is not regular
                arrays[node] = opened
            else:
                groups[node] = dict(opened.attrs)
        except Exception as error:  # codecs, types and JSON raise all kinds
            failed[node] = condense(error)
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


def open_zarr(path: Path, request: Request) -> Source:
    """The arrays of a zarr hierarchy.

    Dimension names (format 3, or xarray's `_ARRAY_DIMENSIONS`) give axes and coordinates.
    Consolidated metadata is ignored: an outdated copy would hide appended steps.
    """
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
            if request.no_external:
                request.require_inside(path, place.parent, *place.parent.rglob("*"))
            return replace(
                open_zarr(place.parent, replace(request, var=place.name)), only=place.name
            )
        return file_source(
            path,
            _with_images(path, _variables(path, arrays, failed), groups),
            groups=groups,
            close=store.close,
            stamp=Stamp.of((metadata_file(path) or path) if path.is_dir() else path),
            folder=path if path.is_dir() else None,
            naming=True,
        )
    except BaseException:
        store.close()
        raise


def _variables(
    root: Path, arrays: Mapping[str, zarr.Array[Any]], failed: Mapping[str, str]
) -> list[Variable]:
    """All arrays as Variables."""
    readable = [
        Variable(
            name=name or root.stem,
            shape=array.shape,
            dtype=np.dtype(array.dtype),
            dimensions=tuple(dimension_names(array)),
            attributes=_attributes(array),
            read=partial(_values, array),
            chunks=array.chunks,
            behind=partial(_behind, root / name if root.is_dir() else None, array),
            handle=array,
        )
        for name, array in arrays.items()
    ]
    return readable + [
        Variable(name=name or root.stem, shape=(), dtype=np.dtype(object), error=error)
        for name, error in failed.items()
    ]


CHANNEL = "channel"
OME_AXES = "tczyx"
"""Axes before version 0.3 of OME-Zarr, which has no names of them."""
OME_NAMES = {"c": CHANNEL, "t": AXIS_NAMES["t"]}
"""Names of dimensions for those of axes."""


def _with_images(
    root: Path, arrays: Sequence[Variable], groups: Mapping[str, Mapping[str, Any]]
) -> list[Variable]:
    """The variables, with one for each image by OME-Zarr (NGFF), or for each of its channels.

    It has the name of the group, "A_1_0" on a plate: its fields are no steps. The arrays of an
    image, which are its levels of detail, and images of labels are read only where they are named.
    """
    known, images = {each.name: each for each in arrays}, []
    for group, attributes in groups.items():
        told = attributes.get("ome")
        told = told if isinstance(told, Mapping) else attributes
        with naming(str(root)):
            entries = told.get("multiscales", ())
            for entry, scales in enumerate(entries):
                name = group.replace("/", "_") or root.stem.removesuffix(".ome")
                if len(entries) > 1:
                    name += f"_{scales.get('name', entry)}"
                for number, each in enumerate(scales["datasets"]):
                    array = known.get(f"{group}/{each['path']}".strip("/"))
                    if array is None or array.error:
                        continue  # a group, as programs of other conventions have it
                    *coords, level = _level(array, scales, each)
                    known[array.name] = replace(level, auxiliary=True)
                    images += coords
                    if number == 0:
                        labels = level.auxiliary or "labels" in group.split("/")
                        whole = replace(level, name=name, auxiliary=labels)
                        images += _channels(whole, told)
    return [*images, *known.values()]


def _level(
    array: Variable, scales: Mapping[str, Any], dataset: Mapping[str, Any]
) -> list[Variable]:
    """The positions of a level of detail, and the level.

    scales: an entry of `multiscales`, and dataset: that of the level in it.
    """
    listed = scales.get("axes") or OME_AXES
    given = [each if isinstance(each, Mapping) else {"name": each} for each in listed]
    axes = [str(each["name"]) for each in given]
    if len(axes) != len(array.shape) or len(set(axes)) < len(axes):
        raise InputError(f"{array} has the axes {', '.join(axes)}")
    step, first = np.ones(len(axes)), np.zeros(len(axes))
    for place in (dataset, scales):
        for each in place.get("coordinateTransformations", ()):
            kind = each["type"]
            values = np.array(each.get(kind, ()), np.float64)
            if kind in ("scale", "translation") and values.shape == step.shape:
                step = step * values if kind == "scale" else step
                first = first * values if kind == "scale" else first + values
            elif kind != "identity":
                raise InputError(f"{array} has a transformation {str(each)[:60]}")
    coords = {
        axis: lattice(axis, first[n], step[n], array.shape[n], units=str(given[n].get("unit", "")))
        for n, axis in enumerate(axes)
        if axis in AXES
    }
    named = replace(array, dimensions=tuple(OME_NAMES.get(axis, axis) for axis in axes))
    return placed([named], coords, f"{HEADER}/{array.name}")


def _channels(image: Variable, told: Mapping[str, Any]) -> list[Variable]:
    """The channels of an image, by the names in the metadata for programs that show it."""
    if CHANNEL not in image.dimensions:
        return [image]
    channels = told.get("omero", {}).get("channels", ())
    labels = [str(each.get("label", "")).replace("/", "_") for each in channels]
    return components(image, image.dimensions.index(CHANNEL), labels, interleaved=False)


def _behind(folder: Path | None, array: zarr.Array[Any]) -> Behind:
    """Stored parts of an array, and the state of its folder.

    In a folder the array's metadata shows a change of shape at once; a changed chunk shows when all
    files are checked at the end.
    """
    parts = zarr_parts(array)
    if folder is None:
        return Behind(parts=parts)
    stamp = Stamp.of(metadata_file(folder) or folder)
    return Behind(parts=parts, stamp=stamp, folder=folder)
