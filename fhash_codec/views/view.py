"""Zarr view: a container as a hierarchy of keys and bytes."""

from __future__ import annotations

import hashlib
import json
from collections import ChainMap, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from fhash_codec.dataset import open as open_file
from fhash_codec.views.arrays import (
    Level,
    ViewArray,
    arrays_beside,
    chunk_index,
    chunk_key,
    level_count,
    multiscale,
    naming_attributes,
    positions_along,
    shown_axes,
)
from fhash_codec.views.arrays import (
    Region as Part,
)
from fhash_codec.volume import Volume
from fhash_formats.series import AXES
from fhash_formats.support.values import json_attributes
from fhash_formats.writers.common import (
    DROPPED,
    Region,
    coordinate_attributes,
    safe_name,
    variable_attributes,
)

MOST_BYTES = 2 << 20
"""Bytes of a chunk, at most."""
FEW_BYTES = 256 << 10
"""Bytes up to which tiles are joined to one chunk."""

Shape4 = tuple[int, int, int, int]


def view_chunks(shape: Sequence[int], tile: Sequence[int], itemsize: int) -> Shape4:
    """The shape of chunks (t, z, y, x) of a view.

    A large tile is cut to fewer steps first, since most clients show one step at a time, then to
    blocks whose sides are alike, since slices along any axis are asked for. Small tiles are joined
    in space. Chunks begin where tiles do, if the feature bounding box begins at vertex 0 and a tile
    has sides that can be divided.

    Args:
        shape: vertices (t, z, y, x) of the array.
        tile: vertices (t, z, y, x) that are decoded together.
        itemsize: bytes of a value.
    """
    t, *space = (min(length, along) for length, along in zip(shape, tile, strict=True))
    single = [along >= length for length, along in zip(shape, tile, strict=True)]
    frame = itemsize * prod(space)
    steps = max(1, min(t, MOST_BYTES // frame))
    parts = -(-t // steps)
    t = -(-t // parts) if single[0] else max(n for n in range(1, steps + 1) if t % n == 0)
    while itemsize * prod(space) > MOST_BYTES and max(space) > 1:
        axis = space.index(max(space))
        space[axis] = _half(space[axis], whole=single[1 + axis])
    return _joined([t, *space], shape, itemsize)


def _half(length: int, *, whole: bool) -> int:
    """A half or a third of a side; the larger half where that does not divide it.

    whole: whether one tile is as long as the axis, so that no chunk can reach into another tile.
    """
    divisor = next((n for n in (2, 3) if length % n == 0), None)
    return -(-length // 2) if whole or divisor is None else length // divisor


def _joined(chunk: list[int], shape: Sequence[int], itemsize: int) -> Shape4:
    """The chunk with its sides doubled while it is small: the shortest in space first, t last."""
    while True:
        longer = [min(2 * side, length) for side, length in zip(chunk, shape, strict=True)]
        fitting = [
            axis
            for axis, side in enumerate(chunk)
            if side < longer[axis] and itemsize * prod(chunk) // side * longer[axis] <= FEW_BYTES
        ]
        if not fitting:
            t, z, y, x = chunk
            return t, z, y, x
        axis = min(fitting, key=lambda axis: (axis == 0, chunk[axis]))
        chunk[axis] = longer[axis]


DOCUMENT = "zarr.json"
"""Last part of the key of a metadata document."""
LEVELS = "lod"
"""Name of the group that holds the levels of detail."""
POSITIONS_CHUNK = 1 << 17
"""Positions of a coordinate in one chunk."""


def opened_view(path: str | Path, **options: Any) -> tuple[Any, ZarrView]:
    """A file, opened by `fhash_codec.open` with its options, and the view of it."""
    opened: Any = open_file(path, **options)
    try:
        return opened, ZarrView(opened if isinstance(opened, Mapping) else {opened.name: opened})
    except BaseException:
        opened.close()
        raise


class ZarrView:
    """A Zarr v3 hierarchy of the decoded values of volumes. Safe for several threads.

    Nothing is decoded before a chunk is asked for. The volumes belong to the caller.

    Attributes:
        volumes: the volumes by name.
        names: name of the array of each volume, by the volume's name.
        arrays: the arrays by path, such as "density", "time" and "lod/1/density".
        tag: hexadecimal text that differs where any bytes of the hierarchy may.
        hint: what a client is told that asks for an unknown key.
    """

    hint = "no such key; open {url} as Zarr v3"

    def __init__(self, volumes: Mapping[str, Volume]) -> None:
        self.volumes = volumes
        self.arrays: dict[str, ViewArray] = {}
        self.names: dict[str, str] = {}
        # Of each group: its arrays by name, and the lengths of its dimensions.
        self._inside: defaultdict[str, dict[str, ViewArray]] = defaultdict(dict)
        self._lengths: defaultdict[str, dict[str, int]] = defaultdict(dict)
        self._shared: defaultdict[Any, list[str]] = defaultdict(list)
        self._counts: dict[tuple[str, str], int] = {}
        groups: dict[str, dict[str, Any]] = {"": _global_attributes(volumes), LEVELS: {}}
        scales = []
        used = {"": {LEVELS, DOCUMENT}}
        for key, volume in volumes.items():
            self.names[key] = safe_name(volume.name or key, used[""])
        self._shown = {LEVELS, DOCUMENT, *self.names.values()}
        for key, volume in volumes.items():
            name = self.names[key]
            levels = [Level(volume, lod) for lod in range(level_count(volume))]
            for level, group in [(levels[0], ""), *((e, f"{LEVELS}/{e.lod}") for e in levels)]:
                groups.setdefault(group, {})
                taken = used.setdefault(group, {DOCUMENT, *self.names.values()})
                dimensions = self._add_coordinates(group, volume, level, taken)
                beside = self._add_beside(group, volume, level, dimensions)
                self._put(group, name, _values(volume, level, dimensions, beside))
            paths = {f"{level.lod}/{name}": level for level in levels}
            axes = dict(zip(self._axes(volume), self.arrays[name].dimension_names, strict=True))
            if len(axes.keys() - {"t"}) > 1:
                scales.append(multiscale(name, volume.coords, axes, paths))
        if scales:
            groups[LEVELS]["ome"] = {"version": "0.5", "multiscales": scales}
        self._documents = self._write_documents(groups)
        self.tag = self._fingerprint()

    # -- what is there --

    def get(self, key: str) -> bytes | None:
        """The bytes of a key, decoded where they are values; None where there is no such key.

        Raises DamagedFileError where a tile is damaged, and InputError once a volume is closed.
        """
        document = self._documents.get(key)
        if document is not None:
            return document
        found = self._chunk(key)
        return None if found is None else found[0].chunk(found[1])

    def size(self, key: str) -> int | None:
        """The number of bytes of a key, without decoding any; None where there is no such key."""
        document = self._documents.get(key)
        if document is not None:
            return len(document)
        found = self._chunk(key)
        return None if found is None else found[0].chunk_bytes

    def is_document(self, key: str) -> bool:
        """Whether a key is a metadata document, whose bytes are at hand."""
        return key in self._documents

    def tag_of(self, key: str) -> str:
        """Text that differs where the bytes of a key may: that of the hierarchy."""
        return self.tag

    def kind(self, key: str) -> str:
        """The media type of a key."""
        return "application/json" if self.is_document(key) else "application/octet-stream"

    def pieces(self, key: str, first: int, end: int) -> Iterator[memoryview]:
        """Yield the bytes of a key that there is, from `first` to before `end`, as `get` does."""
        data = self.get(key)
        assert data is not None, "a key that has a size has bytes"
        yield memoryview(data)[first:end]

    def listing(self, prefix: str = "") -> Iterator[str]:
        """Yield every key that begins with a prefix: the documents, then chunk after chunk."""
        yield from (key for key in self._documents if key.startswith(prefix))
        for path, array in self.arrays.items():
            place = f"{path}/c"
            if place.startswith(prefix) or prefix.startswith(place):
                keys = (f"{path}/{chunk_key(index)}" for index in array.indices())
                yield from (key for key in keys if key.startswith(prefix))

    def children(self, path: str) -> Iterator[str]:
        """Yield the names right below a path, each once: documents, arrays, groups, `c`."""
        below = f"{path}/" if path else ""
        names = {
            key[len(below) :].partition("/")[0] for key in self._documents if key.startswith(below)
        }
        yield from sorted(names)
        if path in self.arrays:
            yield "c"
        elif not names:
            seen = set()
            for key in self.listing(below):
                name = key[len(below) :].partition("/")[0]
                if name not in seen:
                    seen.add(name)
                    yield name

    def _chunk(self, key: str) -> tuple[ViewArray, tuple[int, ...]] | None:
        """The array and the index of a chunk's key; None for other keys and absent chunks."""
        path, _, end = key.rpartition("/c/")
        array, index = self.arrays.get(path), chunk_index(end)
        if key.endswith("/c"):  # the only chunk of an array without axes
            array, index = self.arrays.get(key.removesuffix("/c")), ()
        if array is None or index is None or not array.has(index):
            return None
        return array, index

    # -- how it is made --

    @staticmethod
    def _axes(volume: Volume) -> tuple[str, ...]:
        """The axes of a volume that are shown, of "t", "z", "y" and "x"."""
        return tuple(AXES[number] for number in shown_axes(volume))

    def _add_coordinates(
        self, group: str, volume: Volume, level: Level, used: set[str]
    ) -> dict[str, str]:
        """Add the coordinates of a level to its group; return the names of its axes by axis.

        Volumes share a coordinate that has the same name, positions and attributes.
        """
        names: dict[str, str] = {}
        for number in shown_axes(volume):
            axis = AXES[number]
            coordinate = volume.coords[axis]
            values = positions_along(volume, axis)
            values = values[level.vertices(number - 1)] if number else values
            attributes = coordinate_attributes(axis, coordinate)
            wanted = safe_name(coordinate.name or axis)
            digest = hashlib.sha256(np.ascontiguousarray(values).tobytes()).digest()
            told = json.dumps(attributes, sort_keys=True)
            shared = self._shared[group, wanted, values.dtype.str, digest, told]
            name = next((one for one in shared if one not in names.values()), None)
            if name is None:
                name = self._free(group, wanted, used)
                shared.append(name)
                self._put(group, name, _positions(name, values, attributes))
            names[axis] = name
        return names

    def _free(self, group: str, wanted: str, used: set[str]) -> str:
        """A name that is not used in a group yet: the wanted one, or with a number."""
        count = self._counts.get((group, wanted), 1)
        name = wanted if count == 1 else f"{wanted}_{count}"
        while name in used or name in self._inside[group]:
            count += 1
            name = f"{wanted}_{count}"
        self._counts[group, wanted] = count
        used.add(name)
        return name

    def _put(self, group: str, name: str, array: ViewArray) -> None:
        """Put an array into a group."""
        self.arrays[_join(group, name)] = self._inside[group][name] = array
        self._lengths[group].update(zip(array.dimension_names, array.shape, strict=True))

    def _add_beside(
        self, group: str, volume: Volume, level: Level, dimensions: Mapping[str, str]
    ) -> dict[str, Any]:
        """Add the arrays beside the values; return the attributes by which the values name them."""
        if volume.metadata is None:
            return {}
        inside, shown = self._inside[group], self._shown
        lengths = ChainMap({}, self._lengths[group])
        there = set()
        for name, array in list(arrays_beside(volume, level, dimensions, lengths)):
            if name in inside:
                if inside[name].is_same(array):
                    there.add(name)
            elif name not in shown:
                self._put(group, name, array)
                there.add(name)
        for dimension, axis in volume.metadata.dimensions.items():
            source = volume.metadata.named(dimension)
            if source is not None and axis in dimensions:
                array = inside[dimensions[axis]]
                named = naming_attributes(source.attributes, there)
                attributes = {**array.attributes, **named}
                self._put(group, dimensions[axis], replace(array, attributes=attributes))
        return naming_attributes(volume.metadata.variable_attributes, there)

    def _write_documents(self, groups: Mapping[str, dict[str, Any]]) -> dict[str, bytes]:
        """All metadata documents by key; those of groups hold all metadata below them."""
        nodes: dict[str, dict[str, Any]] = {
            path: {"zarr_format": 3, "node_type": "group", "attributes": attributes}
            for path, attributes in groups.items()
        }
        nodes |= {path: array.document() for path, array in self.arrays.items()}
        # zarr-python loses nodes of a group that do not stand together.
        nodes = {path: nodes[path] for path in sorted(nodes, key=_depth_and_group)}
        documents = {}
        for path, node in nodes.items():
            if path in groups:
                below = f"{path}/" if path else ""
                inside = {
                    other[len(below) :]: nodes[other]
                    for other in nodes
                    if other != path and other.startswith(below)
                }
                consolidated = {"kind": "inline", "must_understand": False, "metadata": inside}
                node = {**node, "consolidated_metadata": consolidated}
            text = json.dumps(node, separators=(",", ":"), allow_nan=False)
            documents[_join(path, DOCUMENT)] = text.encode("utf-8")
        return documents

    def _fingerprint(self) -> str:
        """A digest of the files and of all metadata."""
        digests = [volume.container.digest for volume in self.volumes.values()]
        seed = "\n".join((*digests, "")).encode("ascii") + self._documents[DOCUMENT]
        return hashlib.sha256(seed).hexdigest()[:32]


def _global_attributes(volumes: Mapping[str, Volume]) -> dict[str, Any]:
    """Attributes of the whole file: a mapping's own, and those of all sources."""
    own = getattr(volumes, "attributes", None) or {}
    metadata = [volume.metadata for volume in volumes.values()]
    sources = [
        {} if each is None else json_attributes(each.attributes, without=DROPPED)
        for each in metadata
    ]
    common = {
        name: value
        for name, value in (sources[0] if sources else {}).items()
        if all(name in each and each[name] == value for each in sources)
    }
    return {**common, **json_attributes(own, without=DROPPED)}


def _values(
    volume: Volume, level: Level, dimensions: Mapping[str, str], named: Mapping[str, Any]
) -> ViewArray:
    """The array of a level of a volume, without the axes that were made up.

    named: attributes that name arrays beside it.
    """
    region = Region(
        name=volume.name or "values",
        dtype=volume.dtype,
        shape=volume.shape,
        coords=volume.coords,
        units=volume.units,
        attributes=volume.attrs,
    )
    shown = shown_axes(volume)
    chunk = view_chunks(level.shape, level.tile, level.dtype.itemsize)

    def whole(part: Part) -> Part:
        """The region (t, z, y, x) of a region of the axes that are shown."""
        along = dict(zip(shown, part, strict=True))
        return tuple(along.get(number, slice(0, 1)) for number in range(len(AXES)))

    # Integers have a fill value also where no vertex lacks a value: it marks nothing then.
    marks = volume.fill is not None and volume.value_type.has_gaps and volume.fill == volume.fill
    missing = {}
    if marks:
        # xarray takes `_FillValue` of floats as bits in base64, which no other library does.
        missing = {"_FillValue" if volume.dtype.kind in "iu" else "missing_value": volume.fill}
    return ViewArray(
        shape=tuple(level.shape[number] for number in shown),
        chunk_shape=tuple(chunk[number] for number in shown),
        dtype=level.dtype,
        dimension_names=tuple(dimensions.values()),
        attributes={**variable_attributes(region), **named, **missing},
        fill=volume.fill,
        read=lambda part: level.read(whole(part)).reshape([e.stop - e.start for e in part]),
        holds=lambda part: level.holds(whole(part)),
    )


def _positions(name: str, values: Any, attributes: Mapping[str, Any]) -> ViewArray:
    """The array of the positions along an axis."""
    return ViewArray(
        shape=values.shape,
        chunk_shape=(min(values.size, POSITIONS_CHUNK),),
        dtype=values.dtype,
        dimension_names=(name,),
        attributes=attributes,
        fill=None,
        read=lambda region: values[region],
        holds=lambda region: True,
    )


def _depth_and_group(path: str) -> tuple[int, str]:
    """Number of groups above a node, and the path of the one that it is in."""
    return path.count("/"), path.rpartition("/")[0]


def _join(group: str, name: str) -> str:
    """The path of a node in a group; "" is the root."""
    return f"{group}/{name}" if group else name
