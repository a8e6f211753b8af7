"""Arrays and groups of a Zarr view: values, levels of detail, multiscales, coordinates."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.volume import Volume
from fhash_formats.series import (
    AXES,
    COORDINATES,
    NAMING,
    Coordinate,
    SourceVariable,
    references,
    without_names,
)
from fhash_formats.support.threads import ForkLock, chunk_region, slab_shape
from fhash_formats.support.values import PLUMBING, json_attributes
from fhash_formats.writers.common import safe_name

EXACT_IN_JSON = 2**53
"""Integers up to this size are the same number in every JSON library, those of browsers too."""

Index = tuple[int, ...]
Region = tuple[slice, ...]

_INDEX = re.compile(r"(?:0|[1-9][0-9]{0,17})(?:/(?:0|[1-9][0-9]{0,17}))*")


@dataclass(frozen=True, kw_only=True)
class ViewArray:
    """An array whose chunks are plain little-endian values, without compression.

    Attributes:
        shape: length of each axis, at least 1.
        chunk_shape: of a chunk; those at the end of an axis are stored in full.
        dtype: an integer or float type, native byte order.
        dimension_names: names of the axes.
        attributes: JSON values.
        fill: the number where there is no value; None for NaN, or 0 of integers.
        read: values of a region, of `dtype`.
        holds: whether a region has any value; without one its chunk is left out, and every Zarr
            library puts `fill` in its place.
    """

    shape: Index
    chunk_shape: Index
    dtype: np.dtype[Any]
    dimension_names: tuple[str, ...]
    attributes: Mapping[str, Any]
    fill: int | float | None
    read: Callable[[Region], npt.NDArray[Any]]
    holds: Callable[[Region], bool]

    @cached_property
    def grid(self) -> Index:
        """Number of chunks along each axis."""
        return tuple(-(-n // c) for n, c in zip(self.shape, self.chunk_shape, strict=True))

    @cached_property
    def chunk_bytes(self) -> int:
        """Bytes of every chunk."""
        return prod(self.chunk_shape) * self.dtype.itemsize

    @cached_property
    def _fill(self) -> int | float:
        """The number where there is no value."""
        if self.fill is not None:
            return self.fill
        return float("nan") if self.dtype.kind == "f" else 0

    @cached_property
    def _leaves_out(self) -> bool:
        """Whether chunks without a value may be left out: their number survives JSON."""
        return self.dtype.kind == "f" or abs(self._fill) <= EXACT_IN_JSON

    def document(self) -> dict[str, Any]:
        """The array's metadata document, `zarr.json`."""
        endian = {"configuration": {"endian": "little"}} if self.dtype.itemsize > 1 else {}
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": self.dtype.name,
            "chunk_grid": {
                "name": "regular",
                "configuration": {"chunk_shape": list(self.chunk_shape)},
            },
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": _json_number(self._fill),
            "codecs": [{"name": "bytes", **endian}],
            "dimension_names": list(self.dimension_names),
            "attributes": dict(self.attributes),
        }

    def is_same(self, other: ViewArray) -> bool:
        """Whether another array has the same values, dimensions and attributes; both are read."""
        if self.document() != other.document():
            return False
        whole = tuple(slice(0, n) for n in self.shape)
        return bool(np.array_equal(self.read(whole), other.read(whole), equal_nan=True))

    def has(self, index: Index) -> bool:
        """Whether there is a chunk; one outside the grid is not, nor one without any value."""
        if len(index) != len(self.grid):
            return False
        if not all(0 <= i < n for i, n in zip(index, self.grid, strict=True)):
            return False
        return not self._leaves_out or self.holds(self._region(index))

    def indices(self) -> Iterator[Index]:
        """Yield the index of every chunk that there is, in C order."""
        return (index for index in product(*map(range, self.grid)) if self.has(index))

    def chunk(self, index: Index) -> bytes:
        """The bytes of a chunk that there is. Raises what reading the volume raises."""
        region = self._region(index)
        values = self.read(region)
        if values.shape != self.chunk_shape:
            full = np.full(self.chunk_shape, self._fill, dtype=self.dtype)
            full[tuple(slice(0, along.stop - along.start) for along in region)] = values
            values = full
        return values.astype(self.dtype.newbyteorder("<"), copy=False).tobytes()

    def _region(self, index: Index) -> Region:
        return chunk_region(index, self.chunk_shape, self.shape)


def chunk_index(text: str) -> Index | None:
    """The index that the end of a chunk's key stands for, such as "0/3/1"; None for other text."""
    return tuple(map(int, text.split("/"))) if _INDEX.fullmatch(text) else None


def chunk_key(index: Index) -> str:
    """The end of the key of a chunk: "c/0/3/1"."""
    return "/".join(("c", *map(str, index)))


def _json_number(number: int | float) -> int | float | str:
    """A fill value as Zarr writes it in JSON, which has no word for NaN and infinities."""
    if number != number:
        return "NaN"
    if number in (float("inf"), float("-inf")):
        return "Infinity" if number > 0 else "-Infinity"
    return number


LOCKS = 64
"""Locks that the tiles of a level share."""
SMALL_SIDE = 16
"""Vertices along the longest side of the feature bounding box that no coarser level follows."""


def level_count(volume: Volume) -> int:
    """The number of levels, level 0 included; 1 for files without levels of detail."""
    if volume.profile != "compact":
        return 1
    halvings = (-(-max(volume.box.shape) // SMALL_SIDE) - 1).bit_length()
    return min(len(volume.tables), 1 + halvings)


class Level:
    """The values (t, z, y, x) of a level. Reading is safe for several threads.

    Attributes:
        lod: level of detail; 0 for the values themselves.
        shape: vertices (t, z, y, x).
        tile: vertices (t, z, y, x) that are decoded together, roughly where lod is not 0.
        first: the vertex (z, y, x) of the domain that the first one of the level is.
        dtype: type of the values, that of the volume.
    """

    def __init__(self, volume: Volume, lod: int) -> None:
        self._volume = volume
        self.lod = lod
        self.stride = 1 << lod
        self.dtype = volume.dtype
        self.first = tuple(low % self.stride for low in volume.box.first)
        steps, *space = volume.shape
        self.shape = (
            steps,
            *(-(-(n - o) // self.stride) for n, o in zip(space, self.first, strict=True)),
        )
        time, *sides = volume.chunks
        self.tile = (time, *(-(-side // self.stride) for side in sides))
        self._box = Box.of(
            ((low - o) // self.stride, (low - o) // self.stride - (low - high) // self.stride)
            for (low, high), o in zip(volume.box, self.first, strict=True)
        )
        self._locks = [ForkLock() for _ in range(LOCKS)]

    def vertices(self, axis: int) -> slice:
        """The vertices of the domain along an axis of (z, y, x) that the level has."""
        return slice(self.first[axis], None, self.stride)

    def holds(self, region: Region) -> bool:
        """Whether a region (t, z, y, x) of the level meets the feature bounding box."""
        return self._common(region) is not None

    def read(self, region: Region) -> npt.NDArray[Any]:
        """The values (t, z, y, x) of a region of the level, of `dtype`.

        They have the volume's fill value, or NaN, where there is no value. Raises DamagedFileError
        for a damaged tile.
        """
        with self._lock(region):
            return self._volume[region] if self.lod == 0 else self._coarse(region)

    def _coarse(self, region: Region) -> npt.NDArray[Any]:
        """The values of a region of a level of detail that is not 0."""
        volume = self._volume
        time, *space = region
        shape = [along.stop - along.start for along in region]
        floats = self.dtype.kind == "f"
        empty = np.nan if floats and volume.fill is None else volume.fill
        result = np.full(shape, empty, dtype=self.dtype)
        common = self._common(region)
        if common is not None:
            place = common.shift(-along.start for along in space).slices()
            spans = Box.of(
                (o + low * self.stride, o + (high - 1) * self.stride + 1)
                for (low, high), o in zip(common, self.first, strict=True)
            )
            for number, step in enumerate(range(time.start, time.stop)):
                values, counted = volume.decoded_lod(step, self.lod, spans)
                np.copyto(result[number][place], values, where=counted, casting="same_kind")
        return result

    def _common(self, region: Region) -> Box | None:
        """The vertices of the level that a region shares with the feature bounding box."""
        return self._box.intersect(Box.of((along.start, along.stop) for along in region[1:]))

    def _lock(self, region: Sequence[slice]) -> ForkLock:
        """The lock of the tile that a region begins in.

        Several chunks of one tile are asked for at once, one step each. The first request decodes
        the tile, and the others wait for it rather than decode it too.
        """
        first = (0, *self._box.first)
        place = tuple(
            (along.start - low) // side
            for along, low, side in zip(region, first, self.tile, strict=True)
        )
        return self._locks[hash(place) % LOCKS]


UNITS = {
    "m": "meter", "metre": "meter", "meter": "meter", "km": "kilometer", "cm": "centimeter",
    "mm": "millimeter", "um": "micrometer", "nm": "nanometer", "s": "second", "sec": "second",
    "second": "second", "ms": "millisecond", "min": "minute", "minute": "minute", "h": "hour",
    "hr": "hour", "hour": "hour", "d": "day", "day": "day", "kilometer": "kilometer",
    "kilometre": "kilometer", "centimeter": "centimeter", "millimeter": "millimeter",
    "micrometer": "micrometer", "micron": "micrometer", "nanometer": "nanometer",
    "millisecond": "millisecond",
}  # fmt: skip
"""Units of positions, in the singular, by the names that the specification has for them."""
TIME_UNITS = frozenset({"second", "millisecond", "minute", "hour", "day"})
"""Units that belong to the axis t alone."""
UNEVEN = 1e-3
"""Part of a step by which positions may differ from an even rule, so that a scale describes them.

Positions that were rounded to float32 differ by less.
"""


def multiscale(
    name: str,
    coords: Mapping[str, Coordinate],
    dimensions: Mapping[str, str],
    levels: Mapping[str, Level],
) -> dict[str, Any]:
    """The entry of a variable in `multiscales`.

    Args:
        name: the variable's.
        coords: positions along each of t, z, y and x.
        dimensions: name in the arrays of each axis that they have, in the order t, z, y, x.
        levels: the levels by the path of their arrays, finest first.
    """
    axes: list[dict[str, Any]] = []
    rules: dict[str, tuple[float, float]] = {}
    for axis, dimension in dimensions.items():
        coordinate = coords[axis]
        rule = _even(coordinate.values)
        unit = None if rule is None else _unit(axis, coordinate)
        axes.append(
            {
                "name": dimension,
                "type": "time" if axis == "t" else "space",
                **({} if unit is None else {"unit": unit}),
            }
        )
        rules[axis] = (0.0, 1.0) if rule is None else rule
    return {
        "name": name,
        "type": "lowpass",
        "metadata": {"description": "every 2^n-th vertex along z, y and x of a low-passed lattice"},
        "axes": axes,
        "datasets": [
            {"path": path, "coordinateTransformations": _transformations(level, rules)}
            for path, level in levels.items()
        ],
    }


def _transformations(
    level: Level, rules: Mapping[str, tuple[float, float]]
) -> list[dict[str, Any]]:
    """Scale and translation from the vertices of a level to positions.

    rules: first position and step along each axis.
    """
    strides = dict(zip(AXES, (1, *[level.stride] * 3), strict=True))
    firsts = dict(zip(AXES, (0, *level.first), strict=True))
    return [
        {"type": "scale", "scale": [step * strides[axis] for axis, (_, step) in rules.items()]},
        {
            "type": "translation",
            "translation": [start + step * firsts[axis] for axis, (start, step) in rules.items()],
        },
    ]


def _even(values: npt.NDArray[np.float64]) -> tuple[float, float] | None:
    """The first position and the step of positions that ascend evenly; None for others."""
    if not np.isfinite(values).all():
        return None
    if values.size == 1:
        return float(values[0]), 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        step = float((values[-1] - values[0]) / (values.size - 1))
        off = np.abs(values - (values[0] + step * np.arange(values.size)))
    even = 0 < step < np.inf and bool(off.max() <= UNEVEN * step)
    return (float(values[0]), step) if even else None


def _unit(axis: str, coordinate: Coordinate) -> str | None:
    """The unit of positions as the specification names it; None where it has no name for it."""
    text = str(coordinate.attributes.get("units", ""))
    word = text.partition(" since ")[0].strip()
    unit = UNITS.get(word) or UNITS.get(word.lower().removesuffix("s"))
    if unit is None or (unit in TIME_UNITS) != (axis == "t"):
        return None
    return unit


CHUNK_BYTES = 1 << 20
"""Bytes of a chunk of such an array."""
FILL = "_FillValue"


def shown_axes(volume: Volume) -> tuple[int, ...]:
    """The numbers of the axes (t, z, y, x) that the source has; all where it does not say.

    An axis that was made up has length 1. One axis stays in any case.
    """
    metadata = volume.metadata
    if metadata is None:
        return tuple(range(len(AXES)))
    known = (
        number
        for number, axis in enumerate(AXES)
        if metadata.along(axis) is not None or volume.shape[number] > 1
    )
    return tuple(known) or (0,)


def arrays_beside(
    volume: Volume, level: Level, dimensions: Mapping[str, str], lengths: MutableMapping[str, int]
) -> Iterator[tuple[str, ViewArray]]:
    """Yield the arrays beside the values of a level, with their names.

    Args:
        volume: the volume.
        level: the level; arrays along its axes are cut to its vertices.
        dimensions: name of the dimension of each axis that is shown, by "t", "z", "y" or "x".
        lengths: of the dimensions of the group by name; those of further dimensions are added.
    """
    metadata = volume.metadata
    if metadata is None:
        return
    if level.lod:
        metadata = metadata.cut(
            {
                axis: list(range(n)[level.vertices(number)])
                for number, (axis, n) in enumerate(zip(AXES[1:], volume.shape[1:], strict=True))
            }
        )
    for variable in metadata.variables:
        if variable.name in metadata.dimensions or safe_name(variable.name) != variable.name:
            continue
        values, names = _squeezed(variable, metadata.dimensions, dimensions)
        if values.dtype.kind not in "iuf" or 0 in values.shape or len(set(names)) < len(names):
            continue
        found = dict(zip(names, values.shape, strict=True))
        if any(lengths.get(name, n) != n for name, n in found.items()):
            continue
        lengths.update(found)
        yield variable.name, _array(values, names, variable.attributes)


def positions_along(volume: Volume, axis: str) -> npt.NDArray[Any]:
    """Positions along an axis "t", "z", "y" or "x", in the source's type where that has them."""
    values = volume.coords[axis].values
    metadata = volume.metadata
    name = None if metadata is None else metadata.along(axis)
    stored = None if metadata is None or name is None else metadata.named(name)
    if stored is None or stored.dimensions != (name,) or stored.values.dtype.kind not in "iuf":
        return values
    native = stored.values.astype(stored.values.dtype.newbyteorder("="))
    same = native.shape == values.shape and native.astype(np.float64).tobytes() == values.tobytes()
    return native if same else values


def naming_attributes(raw: Mapping[str, Any], there: Collection[str]) -> dict[str, Any]:
    """Attributes that name other arrays, as far as these are there.

    raw: all attributes of an array. there: names of the arrays beside the values.
    """
    naming = {
        key: text
        for key, text in raw.items()
        if key in (COORDINATES, *NAMING) and isinstance(text, str)
    }
    absent = {name for _, name in references(naming) if name not in there}
    naming = without_names(naming, absent)
    broken = {key for key, name in references(naming) if name in absent}
    return {key: text for key, text in naming.items() if key not in broken}


def _squeezed(
    variable: SourceVariable, axes: Mapping[str, str], dimensions: Mapping[str, str]
) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    """The values without dimensions that the values of the volume do not have, and their names.

    axes: axis of each dimension of the source. dimensions: name in the group of each axis shown.
    """
    values, names = np.asarray(variable.values), []
    for number, name in reversed(list(enumerate(variable.dimensions))):
        if name not in axes:
            names.append(name)
        elif axes[name] in dimensions:
            names.append(dimensions[axes[name]])
        else:
            values = np.take(values, 0, axis=number)
    return np.asarray(values), tuple(reversed(names))


def _array(
    values: npt.NDArray[Any], names: tuple[str, ...], attributes: Mapping[str, Any]
) -> ViewArray:
    native = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("=")).reshape(
        values.shape
    )
    kept = json_attributes(attributes, without=PLUMBING)
    fill = kept.get(FILL)
    if not isinstance(fill, int) or native.dtype.kind == "f":
        # xarray takes `_FillValue` of floats as bits in base64, which no other library does.
        kept.pop(FILL, None)
        if isinstance(fill, int | float):
            kept.setdefault("missing_value", fill)
    return ViewArray(
        shape=native.shape,
        chunk_shape=slab_shape(native.shape, native.dtype.itemsize, CHUNK_BYTES),
        dtype=native.dtype,
        dimension_names=names,
        attributes=kept,
        fill=None,
        read=lambda region: native[region],
        holds=lambda region: True,
    )
