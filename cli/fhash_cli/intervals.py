"""Indices, slices and intervals as text, as a user of numpy writes them: `4`, `40:50`, `0:16,:,8`.

A text of another form is refused with the reason that applies to it.
"""

from __future__ import annotations

import math
from typing import Any

import click

from fhash_formats.support.numbers import is_number

AXES = 3
"""Axes of a region: z, y and x."""


class NumberType(click.ParamType[int | float]):
    """A number; whole numbers stay exact beyond the precision of floats."""

    name = "V"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | float:
        """The number."""
        for number in (int, float):
            try:
                return number(value)
            except ValueError:
                continue
        self.fail(f"{value!r} is not a number", param, ctx)


class SliceType(click.ParamType[slice]):
    """Indices as in Python, `A:B:S` with any part left out, or a single one; a step is positive."""

    name = "A:B:S"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> slice:
        """The slice that a text stands for; `-1` is `slice(-1, None)`, the last."""
        if isinstance(value, slice):
            return value
        try:
            return parse_slice(str(value))
        except ValueError as error:
            self.fail(
                f"'{value}' {error}; write an index or a half-open range A:B or A:B:S,"
                " such as 4, 40:50, 10: or ::2",
                param,
                ctx,
            )


class IntervalsType(click.ParamType[tuple[Any, ...]]):
    """Intervals along z, y and x, of indices or (`number=float`) of positions.

    An end that is left out stands for the end of the domain. Axes that are left out at the end, or
    in place of `...`, are taken whole. A single index stands for its interval of length 1.
    """

    def __init__(self, number: type[int] | type[float]) -> None:
        self.number = number
        self.name = "z0:z1,y0:y1,x0:x1"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Any, ...]:
        """((z0, z1), (y0, y1), (x0, x1)), None for an end left out."""
        if isinstance(value, tuple):
            return value
        try:
            return self._intervals(str(value))
        except ValueError as error:
            example = "0:16,:,8:24" if self.number is int else "0:0.5,:,1.5:2"
            self.fail(f"'{value}': {error}; write z0:z1,y0:y1,x0:x1 as in {example}", param, ctx)

    def _intervals(self, text: str) -> tuple[Any, ...]:
        """The intervals along all axes; raises ValueError with the reason."""
        parts = [part.strip() for part in text.split(",")]
        if parts.count("...") > 1:
            raise ValueError("'...' stands there twice")
        given = len(parts) - parts.count("...")
        if given > AXES:
            raise ValueError(f"{given} intervals, and a region has {AXES} axes (z, y, x)")
        place = parts.index("...") if "..." in parts else len(parts)
        whole = [":"] * (AXES - given)
        return tuple(map(self._interval, [*parts[:place], *whole, *parts[place + 1 :]]))

    def _interval(self, part: str) -> tuple[Any, Any]:
        """One interval; raises ValueError with the reason."""
        if not part:
            raise ValueError("an interval is empty; ':' is a whole axis")
        if self.number is int:
            try:
                chosen = parse_slice(part)
            except ValueError as error:
                raise ValueError(f"'{part}' {error}") from None
            if chosen.step is not None:
                raise ValueError(f"'{part}' has a step, which a region has not (--lod coarsens)")
            return chosen.start, chosen.stop
        ends = part.split(":")
        if len(ends) == 1:
            raise ValueError(f"'{part}' is one position, and an interval has two ends")
        if len(ends) > 2:
            raise ValueError(f"'{part}' has more than two ends")
        low, high = (_position(end) for end in ends)
        if low is not None and high is not None and low > high:
            raise ValueError(f"'{part}' ends before it begins")
        return low, high


def parse_slice(text: str) -> slice:
    """`A:B:S` or one index as a slice; raises ValueError that says in a clause why it is none."""
    words = [part.strip() for part in text.split(":")]
    for word in words:
        if word and not _is_integer(word):
            kind = "is between two" if is_number(word) else "is no number"
            raise ValueError(f"is not made of indices: {word} {kind}")
    if not any(words) and len(words) == 1:
        raise ValueError("is empty")
    parts = [int(word) if word else None for word in words]
    if len(parts) == 1 and parts[0] is not None:
        index = parts[0]
        return slice(index, index + 1 if index != -1 else None)
    if len(parts) > 3:
        raise ValueError("has more than three parts")
    if len(parts) == 3 and parts[2] is not None and parts[2] < 1:
        raise ValueError(f"has the step {parts[2]}, and steps go upwards by 1 or more")
    return slice(*parts)


def written(low: int | None, high: int | None) -> str:
    """A range as a user writes it; a single index for a range of length 1."""
    if low is not None and (high == low + 1 or (low == -1 and high is None)):
        return str(low)
    return f"{'' if low is None else low}:{'' if high is None else high}"


def _position(text: str) -> float | None:
    """An end of an interval of positions; None if it is left out."""
    if not text.strip():
        return None
    if not is_number(text) or math.isnan(float(text)):
        raise ValueError(f"'{text}' is no position")
    return float(text)


def _is_integer(text: str) -> bool:
    return text.lstrip("+-").isdecimal() and text.lstrip("+-").isascii() and len(text) < 20
