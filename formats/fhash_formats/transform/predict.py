"""Prediction of values from those before them, in place of a transform."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.support.values import Integers, Mask, Values
from fhash_formats.transform.values import ZSTD_LEVEL, pieces

CLASSES = 16
"""Kinds of passes, each with statistics of its own.

Kind 0 is the last pass, 1 the one before, and so on; the earliest passes share kind CLASSES - 2,
and the first lattice has kind CLASSES - 1.
"""
WEIGHT_UNIT = 4096
"""Weight of a tap that counts in full."""
MAX_WEIGHT = 32767
"""Largest magnitude of a weight."""
MAX_LEVELS = 8
"""Most halvings along an axis."""
MAX_REACH = 2
"""Largest reach of the taps."""

Axes = tuple[int, int, int, int]
"""A number of each axis (t, z, y, x)."""
Tap = tuple[int, int, int, int, int]
"""A vertex that a prediction uses: the lattice, then offsets along t, z, y, x in that lattice.

The lattice is 1 for the vertices of the pass itself and 0 for the lattice known before the pass.
"""


@dataclass(frozen=True, kw_only=True)
class Pass:
    """A pass over a tile.

    Attributes:
        axis: axis along which it doubles the resolution, -1 for the first lattice.
        kind: 0 to CLASSES - 1.
        taps: the vertices that it uses besides those of the base.
    """

    axis: int
    kind: int
    taps: tuple[Tap, ...]


@dataclass(frozen=True, kw_only=True)
class Predictor:
    """Settings with which a tile is coded by prediction.

    Raises InputError for settings that do not fit together.

    Attributes:
        step: distance of neighbouring values, above 0, in units of the values: nearly twice the
            bound on the error.
        origin: value of the integer 0.
        levels: halvings along t, z, y, x, 0 to MAX_LEVELS.
        order: order of the axes within a level.
        reach: 0 to MAX_REACH; a larger reach has more taps.
        weights: weight of each tap of each pass, in 1/WEIGHT_UNIT.
    """

    step: float
    origin: float
    levels: Axes
    order: Axes
    reach: int
    weights: tuple[int, ...]

    def __post_init__(self) -> None:
        for name in ("step", "origin"):
            value = getattr(self, name)
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or not math.isfinite(value)
            ):
                raise InputError(f"predictor: {name} is {value!r:.40}; a finite number is needed")
        if self.step <= 0:
            raise InputError(f"predictor: step is {self.step}; it must be above 0")
        count = tap_count(self.levels, self.order, self.reach)
        if not _are_integers(self.weights, count, -MAX_WEIGHT, MAX_WEIGHT):
            raise InputError(f"predictor: {count} weights within +-{MAX_WEIGHT} are needed")

    @property
    def passes(self) -> tuple[Pass, ...]:
        """The passes, in order."""
        return passes_of(self.levels, self.order, self.reach)


def tap_count(levels: Axes, order: Axes, reach: int) -> int:
    """The number of weights of a predictor; raises InputError for what is no lattice."""
    if not _are_integers(levels, 4, 0, MAX_LEVELS):
        raise InputError(
            f"predictor: levels are {levels!r:.60}; "
            f"four whole numbers from 0 to {MAX_LEVELS} are needed"
        )
    if not _is_order(order):
        raise InputError(f"predictor: order is {order!r:.60}; 0, 1, 2, 3 in some order are needed")
    if type(reach) is not int or not 0 <= reach <= MAX_REACH:
        raise InputError(f"predictor: reach is {reach!r:.40}; 0 to {MAX_REACH} is possible")
    return sum(len(a_pass.taps) for a_pass in passes_of(levels, order, reach))


@lru_cache(maxsize=64)
def passes_of(levels: Axes, order: Axes, reach: int) -> tuple[Pass, ...]:
    """The passes of a predictor: the first lattice, then each level along the axes in order."""
    axes = [axis for level in range(max(levels), 0, -1) for axis in order if levels[axis] >= level]
    first = Pass(axis=-1, kind=CLASSES - 1, taps=_first_taps())
    others = (
        Pass(axis=axis, kind=min(len(axes) - 1 - i, CLASSES - 2), taps=_taps(axis, reach))
        for i, axis in enumerate(axes)
    )
    return (first, *others)


def _at(lattice: int, *moves: tuple[int, int]) -> Tap:
    """The tap of a lattice at these moves, each an axis and an offset along it."""
    offsets = dict(moves)
    t, z, y, x = (offsets.get(axis, 0) for axis in range(4))
    return (lattice, t, z, y, x)


@lru_cache(maxsize=1)
def _first_taps() -> tuple[Tap, ...]:
    """Taps of the first lattice; all its vertices before this one are known."""
    taps = [_at(1, (axis, -1)) for axis in range(4)]
    taps += [_at(1, (a, -1), (b, -1)) for a, b in combinations(range(4), 2)]
    taps += [_at(1, (axis, -2)) for axis in range(4)]
    taps += [_at(1, (a, -1), (b, 1)) for a, b in combinations(range(4), 2)]
    return tuple(taps)


def _taps(axis: int, reach: int) -> tuple[Tap, ...]:
    """Taps of a pass along an axis.

    Vertices 0 and 1 of the known lattice lie beside the vertex. Vertices of the pass itself are
    known if they come before it in C order.
    """
    others = [other for other in range(4) if other != axis]
    taps = [_at(0, (axis, 1)), _at(0, (axis, -1)), _at(0, (axis, 2))]
    taps += [
        _at(0, (axis, near), (other, side))
        for other in others
        for near in (0, 1)
        for side in (-1, 1)
    ]
    taps += [_at(1, (axis, -1)), *(_at(1, (other, -1)) for other in others)]
    if reach > 0:
        taps += [_at(1, (other, -2)) for other in others]
        pairs = [
            *combinations(others, 2),
            *((min(axis, other), max(axis, other)) for other in others),
        ]
        taps += [_at(1, (first, -1), (second, side)) for first, second in pairs for side in (-1, 1)]
    if reach > 1:
        sides = [(near, a, b) for near in (0, 1) for a in (-1, 1) for b in (-1, 1)]
        taps += [
            _at(0, (axis, near), (first, a), (second, b))
            for first, second in combinations(others, 2)
            for near, a, b in sides
        ]
    return tuple(taps)


def _is_order(values: Any) -> bool:
    return _are_integers(values, 4, 0, 3) and sorted(values) == [0, 1, 2, 3]


def _are_integers(values: Any, count: int, low: int, high: int) -> bool:
    """Whether `values` is a tuple of so many ints from `low` to `high`."""
    return (
        isinstance(values, tuple)
        and len(values) == count
        and all(type(value) is int and low <= value <= high for value in values)
    )


MAX_PREDICTED_INTEGER = 1 << 27
"""Largest magnitude of an integer that is coded by prediction."""


def integers_of(values: Values, counted: Mask | None, predictor: Predictor) -> Integers | None:
    """The integers nearest to values, int32; None if one would exceed MAX_PREDICTED_INTEGER.

    Args:
        values: any shape and real type.
        counted: mask of the same shape; the other integers are 0. None counts all.
        predictor: origin and step.
    """
    result = np.empty(values.shape, np.int32)
    flat, out = values.reshape(-1), result.reshape(-1)
    flat_counted = None if counted is None else counted.reshape(-1)
    for piece in pieces(flat.size):
        with np.errstate(all="ignore"):
            # 64-bit whole numbers are subtracted as float64: near the ends of their range an error
            # may exceed the bound, which the encoder checks.
            nearest = np.rint((flat[piece].astype(np.float64) - predictor.origin) / predictor.step)
        if flat_counted is not None:
            nearest = np.where(flat_counted[piece], nearest, 0.0)
        if not np.all(np.abs(nearest) <= MAX_PREDICTED_INTEGER):
            return None
        out[piece] = nearest
    return result


MAX_ORDER = 6
"""Most differences along an axis."""
_CORNERS = 8
"""Longest last axis whose places are planes of their own, such as the corners of cells."""
_HOLES = 1
"""Flag of a tile of differences in which one value stands at places told apart."""
_RESTS = 2
"""Flag of a tile of differences whose numbers are not all whole in their unit."""
_NARROW = 4
"""Flag of a tile of differences of float64 whose values are those of float32."""
_FRONT = struct.Struct("<BdQB")
_FAR = 1e15
"""Magnitude from which a number that comes often stands for none."""
_DECIMALS = 7
"""Powers of ten that are tried as units."""
_SHIFTS = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
"""Shifts (y, x) of a plane that may give the next one, as one corner of cells gives another."""


def _planes(tile: Values) -> Values:
    """The planes (planes, rows, columns) of a tile (t, z, y, x)."""
    t, z, y, x = tile.shape
    if x <= _CORNERS < y:
        return tile.transpose(0, 3, 1, 2).reshape(t * x, z, y)
    return tile.reshape(t * z, y, x)


def _ordered(words: Values) -> Values:
    """Integers in the order of the floats whose bits are `words`, or the other way round."""
    signs: Values = words >> (8 * words.itemsize - 1)
    ordered: Values = words ^ (signs & np.iinfo(words.dtype).max)
    return ordered


def _bytes(planes: Values) -> bytes:
    """Integers with their sign in the lowest bit, the lowest bytes of all first."""
    words = ((planes << 1) ^ (planes >> (8 * planes.itemsize - 1))).astype(f"<i{planes.itemsize}")
    return words.view(np.uint8).reshape(-1, words.itemsize).T.tobytes()


def _rounded(integers: Values, scale: float, kind: np.dtype[Any]) -> Values:
    """The ordered floats of integers in a unit of 1 / scale."""
    with np.errstate(over="ignore"):
        return _ordered((integers.astype(np.float64) / scale).astype(kind).view(integers.dtype))


def encode_differences(tile: Values) -> bytes | None:
    """The body of a tile (t, z, y, x) as differences of neighbours, which keeps every bit.

    FORMAT.md, Differences, says what they are. None for floats of which none is a usual number.
    """
    flags, scale, hole = 0, 0.0, 0
    with np.errstate(over="ignore", invalid="ignore"):
        narrow = tile.astype(np.float32)
        if tile.dtype == np.float64 and narrow.astype(np.float64).tobytes() == tile.tobytes():
            tile, flags = narrow, _NARROW
    kind = tile.dtype
    planes = np.ascontiguousarray(_planes(tile))
    words = planes.view(f"i{kind.itemsize}")
    parts, missing = [words.copy()], np.zeros(planes.shape, bool)
    if kind.kind == "f":
        with np.errstate(invalid="ignore"):
            numbers = planes.astype(np.float64)
            usual = np.abs(numbers) < _FAR
        if not usual.any():
            return None
        if not usual.all():
            bits = words.view(f"u{kind.itemsize}")
            kinds, counts = np.unique(bits[~usual], return_counts=True)
            hole, flags = int(kinds[counts.argmax()]), flags | _HOLES
            missing = bits == hole
        numbers[~usual] = 0
        scale = _scale(numbers, kind)
        parts[0] = np.rint(numbers * scale).astype(words.dtype)
        parts.append(_ordered(words) - _rounded(parts[0], scale, kind))
        parts[1][missing] = 0
        if flags & _HOLES:
            _fill(parts, missing)
    order, differences = _differences(parts[0])
    body = [_bytes(differences)]
    if len(parts) > 1 and parts[1].any():
        body.append(_bytes(parts[1]))
        flags |= _RESTS
    if flags & _HOLES:
        body.append(np.packbits(missing).tobytes())
    from numcodecs.zstd import compress

    return bytes(compress(_FRONT.pack(flags, scale, hole, order) + b"".join(body), ZSTD_LEVEL))


def _scale(numbers: Values, kind: np.dtype[Any]) -> float:
    """The number of units in 1: a power of ten if numbers are decimals, else a power of two."""
    largest = float(np.abs(numbers).max())
    bits = min(53, 8 * kind.itemsize - 1)
    for scale in (10.0**digits for digits in range(_DECIMALS)):
        if largest * scale >= 1 << bits:
            break
        for some in (numbers.reshape(-1)[:256], numbers):
            if ((np.rint(some * scale) / scale).astype(kind) != some).any():
                break
        else:
            return scale
    exponent = max(math.frexp(largest)[1], -900)
    return 2.0 ** (np.finfo(kind).nmant + 1 - exponent)


def _shift(planes: Values, missing: Mask) -> tuple[int, int] | None:
    """The shift of the first of two planes that gives most of the second; None for under half."""
    best: tuple[float, tuple[int, int] | None] = (0.5, None)
    for shift in _SHIFTS:
        known = ~np.roll(missing[0], shift, (0, 1)) & ~missing[1]
        equal = (np.roll(planes[0], shift, (0, 1)) == planes[1])[known]
        share = float(equal.mean()) if equal.size else 0.0
        best = (share, shift) if share > best[0] else best
    return best[1]


def _fill(parts: list[Values], missing: Mask) -> None:
    """Put numbers that cost few bytes where values are missing, in place.

    They come from the planes before and after where those show the same places, and else go on as
    the rows around them do.
    """
    lacking, shifts = missing.copy(), {}

    def copy(source: int, target: int, shift: tuple[int, int]) -> None:
        known = lacking[target] & ~np.roll(lacking[source], shift, (0, 1))
        for part in parts:
            part[target][known] = np.roll(part[source], shift, (0, 1))[known]
        lacking[target][known] = False

    for number in range(len(missing) - 1, 0, -1):
        pair = slice(number - 1, number + 1)
        if shift := _shift(parts[0][pair], missing[pair]):
            shifts[number] = shift
            copy(number, number - 1, (-shift[0], -shift[1]))
    for number in range(len(missing)):
        if number in shifts:
            copy(number - 1, number, shifts[number])
        if lacking[number].any():
            _fill_plane(parts[0][number], ~lacking[number])
            lacking[number] = False


def _fill_plane(plane: Values, known: Mask) -> None:
    """Fill a plane where nothing is known: each row differs from the one before as around there."""
    places, slope = np.arange(plane.shape[1]), np.zeros(plane.shape[1])
    rows = np.flatnonzero(known.any(1))
    for row in range(rows[0] if len(rows) else len(plane), len(plane)):
        if row == rows[0]:
            both, base = known[row], np.zeros_like(plane[row])
        else:
            both, base = known[row] & known[row - 1], plane[row - 1]
        if both.any():
            slope = np.interp(places, places[both], (plane[row] - base)[both])
        plane[row] = np.where(known[row], plane[row], base + np.rint(slope).astype(plane.dtype))
    if len(rows):
        plane[: rows[0]] = plane[rows[0]]


def _differences(planes: Values) -> tuple[int, Values]:
    """The orders along rows and columns, 16 y + x, that take the fewest bits, and differences."""
    some, best = planes[:: 1 + len(planes) // 2], (math.inf, 0)
    for y in range(MAX_ORDER + 1 if planes.shape[1] > 1 else 1):
        along = some
        for x in range(MAX_ORDER + 1):
            bits = float(np.log2(np.abs(along.astype(np.float64)) + 1).sum())
            best = min(best, (bits, 16 * y + x))
            along = _differed(along, 2, 1)
        some = _differed(some, 1, 1)
    return best[1], _differed(_differed(planes, 1, best[1] >> 4), 2, best[1] & 15)


def _differed(planes: Values, axis: int, order: int) -> Values:
    """The differences of an order along an axis; the first value differs from 0."""
    for _ in range(order):
        planes = np.diff(planes, axis=axis, prepend=planes.dtype.type(0))
    return planes
