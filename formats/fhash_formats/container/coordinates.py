"""Positions along an axis, described in the header: by a rule or as a short list.

An array of their own would cost more bytes. The rule gives position i as start + i * step: one
product and one sum in float64, each rounded, then rounded to `dtype`. Cell centres and other
positions that were computed in another order differ from the rule by a few units in the last place,
which `ulps` lists, and a last position that follows no rule by many. A rule is used only where it
gives every bit of the positions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.record import Record
from fhash_formats.series import AXIS_NAMES, Coordinate

MAX_LISTED = 1024
"""Positions that are written as a list, also one of `ulps`; a reader takes any number.

An array of their own takes 400 to 500 bytes more than the list, until digits outweigh that.
"""
MAX_ULPS = 99
"""Units in the last place by which a position but the last may differ from a written rule."""
ULPS_LIMIT = 2**52 - 1
"""Largest such difference that a reader takes."""
MAX_RULED = 1 << 20
"""Positions that a header describes; the limit keeps a few bytes from asking for much memory."""
TYPES = ("float64", "float32")
"""Number types that positions are rounded to; the first is the default."""

_DIGITS = (*range(1, 16), 17)
"""Numbers of significant decimal digits that guesses of a step are rounded to."""

Floats = npt.NDArray[np.float64]


def describe_coordinates(
    coords: Mapping[str, Coordinate], dimensions: Sequence[str] = tuple(AXIS_NAMES.values())
) -> dict[str, Any]:
    """The header's `coordinates`, without those that need an array of their own.

    Args:
        coords: a coordinate for each of "t", "z", "y" and "x".
        dimensions: names of these axes in the header, which those of coordinates are by default.
    """
    described = {}
    for (axis, stored), dimension in zip(AXIS_NAMES.items(), dimensions, strict=True):
        coordinate = coords[axis]
        description = describe_positions(coordinate.values)
        if description is not None:
            name = {} if coordinate.name == dimension else {"name": coordinate.name}
            attributes = (
                {"attributes": dict(coordinate.attributes)} if coordinate.attributes else {}
            )
            described[stored] = {**description, **name, **attributes}
    return described


def described_coordinate(description: Mapping[str, Any], dimension: str, length: int) -> Coordinate:
    """The coordinate that a description stands for, once `check_positions` has passed it.

    Args:
        description: the axis' object in the header.
        dimension: name of the axis in the header.
        length: number of positions.
    """
    values = positions(description, length)
    return Coordinate(
        name=description.get("name", dimension),
        values=values,
        attributes=description.get("attributes", {}),
    )


def describe_positions(values: Floats) -> dict[str, Any] | None:
    """The header's description of positions, float64 (n,); None where only an array will do.

    `positions` turns the description into the same positions, bit by bit.
    """
    if not np.isfinite(values).all() or values.size > MAX_RULED:
        return None
    with np.errstate(over="ignore"):
        narrow = np.array_equal(values, values.astype(np.float32))
    kinds = TYPES if narrow else TYPES[:1]
    for kind, most in product(kinds, (0, 1)):
        for start, step in _candidates(values, kind):
            rule = _moved_rule(values, start, step, kind)
            if rule is not None and len(rule.get("ulps", ())) <= most:
                return rule
    if values.size > MAX_LISTED:
        return None
    nearly = _nearly_ruled(values, kinds)
    if nearly is not None:
        return nearly
    short = (
        {"values": [_shortest(value, "float32") for value in values], "dtype": "float32"}
        if narrow
        else {}
    )
    return (
        short
        if narrow and positions(short, values.size).tobytes() == values.tobytes()
        else {"values": values.tolist()}
    )


def positions(description: Mapping[str, Any], length: int) -> Floats:
    """The positions that a description stands for, float64 (length,).

    The description is one that `check_positions` has passed.
    """
    # A position beyond its type becomes an infinity; arrays of positions may hold infinities too.
    with np.errstate(over="ignore", invalid="ignore"):
        if "values" in description:
            values = np.array(description["values"], dtype=np.float64)
        else:
            values = np.arange(length, dtype=np.float64) * float(description.get("step", 1))
            values += float(description.get("start", 0))
        rounded = values.astype(description.get("dtype", "float64"))
        if "ulps" in description:
            ulps = np.array(description["ulps"], dtype=np.int64)
            rounded[-ulps.size :] = _moved(rounded[-ulps.size :], ulps)
        return rounded.astype(np.float64)


def check_positions(record: Record, length: int) -> None:
    """Raise DamagedFileError, naming the key, unless `record` describes `length` positions."""
    for key in ("start", "step"):
        if record.has(key):
            record.number(key)
    if record.has("dtype"):
        record.choice("dtype", TYPES)
    if record.has("values"):
        record.numbers("values", length)
    if record.has("ulps"):
        ulps = record.get("ulps")
        count = len(ulps) if isinstance(ulps, list) else 0
        record.need(1 <= count <= length, "ulps", f"1 to {length} whole numbers")
        record.integers("ulps", count, -ULPS_LIMIT, ULPS_LIMIT)
        record.need(not record.has("values"), "ulps", "a rule, and no values")
    if record.has("name"):
        record.text("name")
    if record.has("attributes"):
        record.record("attributes")


def _nearly_ruled(values: Floats, kinds: Sequence[str]) -> dict[str, Any] | None:
    """A rule and how far each position is from it, in units in the last place; None without one.

    Of several rules the one from which the fewest positions differ is taken.
    """
    if values.size < 3:
        return None
    best: dict[str, Any] | None = None
    for kind in kinds:
        first, last = _shortest(values[0], kind), _shortest(values[-1], kind)
        with np.errstate(over="ignore", invalid="ignore"):
            step = (last - first) / (values.size - 1)
            steps = [float(f"{step:.{digits - 1}e}") for digits in _DIGITS if np.isfinite(step)]
        for guess in dict.fromkeys([*steps, step]):
            rule = _moved_rule(values, first, guess, kind) if np.isfinite(guess) else None
            if rule is not None and (best is None or _differing(rule) < _differing(best)):
                best = rule
    return best


def _moved_rule(values: Floats, start: float, step: float, kind: str) -> dict[str, Any] | None:
    """A rule and how far positions are from it, in units in the last place; None if too far."""
    rule: dict[str, Any] = {}
    if start != 0 or np.signbit(start):
        rule["start"] = _plain(start)
    if step != 1:
        rule["step"] = _plain(step)
    if kind != TYPES[0]:
        rule["dtype"] = kind
    ulps = _ordered(values.astype(kind)) - _ordered(positions(rule, values.size).astype(kind))
    if np.abs(ulps[:-1]).max(initial=0) > MAX_ULPS or abs(ulps[-1]) > ULPS_LIMIT:
        return None
    if ulps.any():
        rule["ulps"] = ulps[np.flatnonzero(ulps)[0] :].tolist()
    return rule if positions(rule, values.size).tobytes() == values.tobytes() else None


def _differing(rule: Mapping[str, Any]) -> int:
    """Number of positions that differ from a rule."""
    return int(np.count_nonzero(rule.get("ulps", ())))


def _ordered(values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Whole numbers in the order of floats: neighbouring floats have neighbouring numbers."""
    whole = np.dtype(f"i{values.dtype.itemsize}")
    bits = values.view(whole).astype(np.int64)
    return np.where(bits < 0, int(np.iinfo(whole).min) - bits, bits)


def _moved(values: npt.NDArray[Any], ulps: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
    """Floats moved by so many floats of their type towards larger ones, no farther than infinity.

    0 and -0 count as one float, and what is moved onto it is 0.
    """
    whole = np.dtype(f"i{values.dtype.itemsize}")
    end = int(_ordered(np.array([np.inf], dtype=values.dtype))[0])
    there = np.clip(_ordered(values) + ulps, -end, end)
    bits = np.where(there < 0, int(np.iinfo(whole).min) - there, there).astype(whole)
    return np.where(ulps == 0, values, bits.view(values.dtype))


def _candidates(values: Floats, kind: str) -> Iterator[tuple[float, float]]:
    """Yield starts and steps that the source may have used, those of few digits first."""
    starts = list(dict.fromkeys((_shortest(values[0], kind), float(values[0]))))
    if values.size == 1:
        yield from ((start, 1.0) for start in starts)
        return
    first, last = _shortest(values[0], kind), _shortest(values[-1], kind)
    # Differences overflow at the ends of float64; guesses that are not finite are dropped below.
    with np.errstate(over="ignore", invalid="ignore"):
        guesses = [
            float(values[1] - values[0]),
            float((values[-1] - values[0]) / (values.size - 1)),
            (last - first) / (values.size - 1),
        ]
        # Each position bounds the step: it was rounded by at most half of its spacing. A further
        # guess is the middle of the steps that all positions allow for, with the last and
        # without it, since the last may not follow the rule.
        numbers = np.arange(1, values.size)
        spacing = np.spacing(values[1:].astype(kind)).astype(np.float64)
        low, high = (
            (values[1:] + sign * 0.5 * np.abs(spacing) - first) / numbers for sign in (-1, 1)
        )
        for end in {max(1, values.size - 2), values.size - 1}:
            guesses.append(float(low[:end].max() / 2 + high[:end].min() / 2))
    guesses = [guess for guess in guesses if np.isfinite(guess)]
    rounded = [float(f"{guess:.{digits - 1}e}") for digits in _DIGITS for guess in guesses]
    for step in dict.fromkeys([*rounded, *guesses]):
        # Most guesses fail at the second position, so that the whole rule need not be tried.
        for start in starts:
            with np.errstate(over="ignore"):
                second = np.dtype(kind).type(np.float64(start) + np.float64(step))
            if second == values[1] or values.size == 2:
                yield start, step


def _shortest(value: np.floating[Any] | float, kind: str) -> float:
    """The number with the fewest digits that `kind` rounds to the same value."""
    return float(str(np.dtype(kind).type(value)))


def _plain(value: float) -> float | int:
    """The number, as an int where it is whole: '.0' would cost two bytes of JSON."""
    negative_zero = value == 0 and np.signbit(value)
    is_whole = abs(value) < 2**53 and value == int(value) and not negative_zero
    return int(value) if is_whole else float(value)
