"""Times as people write and read them: dates where the series has a calendar, else numbers.

`time_of` takes what `--time` takes; `time_text` gives what pictures and tables show.
"""

from __future__ import annotations

import math

import numpy as np

from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import Coordinate
from fhash_formats.support.dates import SECOND, Clock, clock, instants

DIGITS = (6, 17)
"""Fewest and most digits of a number."""


def time_of(coordinate: Coordinate, text: str | float, source: str) -> float:
    """The time that a number or a date stands for, in the units of the coordinate.

    A date is 2001-02-10T06:00, or only a part of it. A day, hour or month that holds exactly one
    step stands for that step, any other for its beginning. A date within the rounding of a step is
    that step.

    Args:
        coordinate: times of the steps.
        text: a number, or a date in the calendar of the coordinate.
        source: name of the file, for messages.

    Raises InputError for text that is neither, and RegionError for a time outside the steps.
    """
    found = clock(coordinate.attributes)
    try:
        time = float(text)
    except ValueError:
        if found is None:
            units = coordinate.attributes.get("units")
            raise InputError(
                f"{source}: time '{text}' is no number, and the times are no dates"
                f" ({f'their units are {units!r}' if units else 'they have no units'});"
                f" give a number {_range(coordinate)}"
            ) from None
        try:
            time = _of_date(coordinate, found, str(text))
        except InputError as error:
            raise InputError(
                f"{source}: time {error}; the series is {_range(coordinate)}"
            ) from error
    if not coordinate.values.min() <= time <= coordinate.values.max():
        raise RegionError(f"{source}: time {text} is outside the series, {_range(coordinate)}")
    return time


def time_text(coordinate: Coordinate, time: float) -> str:
    """A time as a date, or as a number with its units, with what tells the steps apart.

    Args:
        coordinate: times of the steps.
        time: of a step, or between two of them.
    """
    found = clock(coordinate.attributes)
    if found is not None and math.isfinite(time):
        return found.text(time, _gap(coordinate))
    units = str(coordinate.attributes.get("units", ""))
    return f"{number_text(coordinate, time)} {'' if units == '1' else units}".rstrip()


def number_text(coordinate: Coordinate, time: float) -> str:
    """A time as a number, with as many digits as tell neighbouring steps apart, at least 6."""
    gap = _gap(coordinate)
    largest = float(np.max(np.abs(coordinate.values)))
    digits = DIGITS[0]
    if gap and math.isfinite(largest):
        digits = min(max(digits, math.ceil(math.log10(largest / gap)) + 1), DIGITS[1])
    return f"{time:.{digits}g}"


def is_dated(coordinate: Coordinate) -> bool:
    """Whether the times are dates of a calendar."""
    return clock(coordinate.attributes) is not None and bool(np.isfinite(coordinate.values).all())


def _of_date(coordinate: Coordinate, found: Clock, text: str) -> float:
    first, after = instants(text, found.calendar)
    values = coordinate.values[np.isfinite(coordinate.values)]
    start = found.value(first)
    gap = _gap(coordinate)
    blur = (
        2 * math.ulp(start)
        if gap is None
        else max(2 * math.ulp(start), min(gap / 10_000, SECOND / found.unit))
    )
    near = values[np.abs(values - start) <= blur] if values.size else values
    if near.size:
        return float(near[np.argmin(np.abs(near - start))])
    within = values[(values >= start - blur) & (values < found.value(after) - blur)]
    return float(within[0]) if within.size == 1 and after > first else start


def _gap(coordinate: Coordinate) -> float | None:
    """The smallest distance of different neighbouring times; None without one."""
    with np.errstate(invalid="ignore", over="ignore"):
        gaps = np.abs(np.diff(coordinate.values))
    gaps = gaps[np.isfinite(gaps) & (gaps > 0)]
    return float(gaps.min()) if gaps.size else None


def _range(coordinate: Coordinate) -> str:
    """The first and the last time, as numbers and as dates."""
    low, high = float(coordinate.values.min()), float(coordinate.values.max())
    numbers = " to ".join(number_text(coordinate, time) for time in (low, high))
    if not is_dated(coordinate):
        return numbers
    dates = " to ".join(time_text(coordinate, time) for time in (low, high))
    return f"{dates} ({numbers} {coordinate.attributes.get('units', '')})"
