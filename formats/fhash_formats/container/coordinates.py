"""Positions along an axis in the header, where an array of their own would cost more: by a rule, or as a short list.

The rule is start + i * step for position i: one product and one sum in float64, each rounded, then rounded to `dtype`; `last`, where it
is there, stands for the last position. It is used only where it gives every bit of the positions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.record import Record
from fhash_formats.series import AXIS_NAMES, Coordinate

MAX_LISTED = 64
"""Most positions that are written as a list; a reader takes any number."""
MAX_RULED = 1 << 20
"""Most positions in the header, so that a few bytes do not ask for much memory."""
TYPES = ("float64", "float32")

_DIGITS = (*range(1, 16), 17)

Floats = npt.NDArray[np.float64]


def describe_coordinates(coords: Mapping[str, Coordinate]) -> dict[str, Any]:
    """The header's `coordinates` for coordinates by axis ("t", "z", "y", "x"), without those that need an array of their own."""
    described = {}
    for axis, stored in AXIS_NAMES.items():
        coordinate = coords[axis]
        description = describe_positions(coordinate.values)
        if description is not None:
            name = {} if coordinate.name == stored else {"name": coordinate.name}
            attributes = (
                {"attributes": dict(coordinate.attributes)} if coordinate.attributes else {}
            )
            described[stored] = {**description, **name, **attributes}
    return described


def described_coordinate(description: Mapping[str, Any], stored: str, length: int) -> Coordinate:
    """The coordinate of `length` positions that a checked description stands for; `stored`: its name in the container."""
    values = positions(description, length)
    return Coordinate(
        name=description.get("name", stored),
        values=values,
        attributes=description.get("attributes", {}),
    )


def describe_positions(values: Floats) -> dict[str, Any] | None:
    """What the header says of positions float64 (n,), from which `positions` makes them bit by bit; None where only an array will do."""
    if not np.isfinite(values).all() or values.size > MAX_RULED:
        return None
    with np.errstate(over="ignore"):
        narrow = np.array_equal(values, values.astype(np.float32))
    for kind, exact_end in product(TYPES if narrow else TYPES[:1], (True, False)):
        for start, step in _candidates(values, kind):
            rule = _rule(start, step, None if exact_end else _shortest(values[-1], kind), kind)
            if _same(positions(rule, values.size), values):
                return rule
    if values.size > MAX_LISTED:
        return None
    short = (
        {"values": [_shortest(value, "float32") for value in values], "dtype": "float32"}
        if narrow
        else {}
    )
    return (
        short
        if narrow and _same(positions(short, values.size), values)
        else {"values": values.tolist()}
    )


def positions(description: Mapping[str, Any], length: int) -> Floats:
    """The positions that a checked description stands for, float64 (length,)."""
    # A position beyond its type becomes an infinity, which an array may hold as well.
    with np.errstate(over="ignore", invalid="ignore"):
        if "values" in description:
            values = np.array(description["values"], dtype=np.float64)
        else:
            values = np.arange(length, dtype=np.float64) * float(description.get("step", 1))
            values += float(description.get("start", 0))
            if "last" in description:
                values[-1] = float(description["last"])
        return values.astype(description.get("dtype", "float64")).astype(np.float64)


def check_positions(record: Record, length: int) -> None:
    """Whether the header describes `length` positions; raises DamagedFileError naming the key."""
    for key in ("start", "step", "last"):
        if record.has(key):
            record.number(key)
    if record.has("dtype"):
        record.choice("dtype", TYPES)
    if record.has("values"):
        record.numbers("values", length)
    if record.has("name"):
        record.text("name")
    if record.has("attributes"):
        record.record("attributes")


def _same(a: Floats, b: Floats) -> bool:
    """Whether all bits are equal: -0 is not 0."""
    return a.tobytes() == b.tobytes()


def _rule(start: float, step: float, last: float | None, kind: str) -> dict[str, Any]:
    """A rule without what is usual."""
    rule: dict[str, Any] = {}
    if start != 0 or np.signbit(start):
        rule["start"] = _plain(start)
    if step != 1:
        rule["step"] = _plain(step)
    if last is not None:
        rule["last"] = _plain(last)
    return rule if kind == "float64" else {**rule, "dtype": kind}


def _candidates(values: Floats, kind: str) -> Iterator[tuple[float, float]]:
    """Starts and steps that may be those of the source, the shortest in digits first."""
    starts = list(dict.fromkeys((_shortest(values[0], kind), float(values[0]))))
    if values.size == 1:
        yield from ((start, 1.0) for start in starts)
        return
    first, last = _shortest(values[0], kind), _shortest(values[-1], kind)
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # at the ends of float64; what is no number is no guess
        guesses = [
            float(values[1] - values[0]),
            float((values[-1] - values[0]) / (values.size - 1)),
            (last - first) / (values.size - 1),
        ]
        # The middle of the steps that every position allows for, each within half of its spacing; the last may be no part of the rule.
        numbers, spacing = (
            np.arange(1, values.size),
            np.spacing(values[1:].astype(kind)).astype(np.float64),
        )
        low, high = (
            (values[1:] + sign * 0.5 * np.abs(spacing) - first) / numbers for sign in (-1, 1)
        )
        for end in {max(1, values.size - 2), values.size - 1}:
            guesses.append(float(low[:end].max() / 2 + high[:end].min() / 2))
    guesses = [guess for guess in guesses if np.isfinite(guess)]
    rounded = [float(f"{guess:.{digits - 1}e}") for digits in _DIGITS for guess in guesses]
    for step in dict.fromkeys([*rounded, *guesses]):
        # Most guesses fail at the second position; they are not tried on all.
        for start in starts:
            with np.errstate(over="ignore"):
                second = np.dtype(kind).type(np.float64(start) + np.float64(step))
            if second == values[1] or values.size == 2:
                yield start, step


def _shortest(value: np.floating[Any] | float, kind: str) -> float:
    """The number with the fewest digits that `kind` rounds to the same value."""
    return float(str(np.dtype(kind).type(value)))


def _plain(value: float) -> float | int:
    """Whole numbers without '.0', which costs two bytes."""
    whole = abs(value) < 2**53 and value == int(value) and not (value == 0 and np.signbit(value))
    return int(value) if whole else float(value)
