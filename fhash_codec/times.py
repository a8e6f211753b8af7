"""Times as people write and read them: dates where the series has a calendar, else numbers.

`time_of` takes what `--time` takes, and the dates of Python, numpy and cftime; `time_range` takes a
range of times; `time_text` gives what pictures and tables show.
"""

from __future__ import annotations

import datetime
import itertools
import math
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import Coordinate
from fhash_formats.support.dates import CALENDARS, DATE, SECOND, Clock, clock, instants
from fhash_formats.support.values import is_number

DIGITS = (6, 17)
"""Fewest and most digits of a number."""


class CalendarDate(Protocol):
    """A date of the package cftime, which knows its calendar."""

    calendar: str
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    microsecond: int


Time = float | str | datetime.date | np.datetime64 | CalendarDate
"""Numbers in the units of a coordinate, and dates; `datetime.datetime` is a `datetime.date`."""


def time_of(coordinate: Coordinate, time: Time, source: str) -> float:
    """The time that a number or a date stands for, in the units of the coordinate.

    A date is text as 2001-02-10T06:00, or only a part of it. A day, hour or month that holds
    exactly one step stands for that step, any other for its beginning. A date within the rounding
    of a step is that step. Dates of Python and numpy are taken as they read, in the calendar of
    the coordinate; those with a time zone are turned into UTC.

    Args:
        coordinate: times of the steps.
        time: a number, or a date: text, `datetime`, `date`, numpy's `datetime64`, or a date of
            cftime, whose calendar must be that of the coordinate.
        source: name of the file, for messages.

    Raises InputError for what is neither, and RegionError for a time outside the steps.
    """
    found = clock(coordinate.attributes)
    text = _readable(time, found, source)
    try:
        number = float(text)
    except ValueError:
        if found is None:
            units = coordinate.attributes.get("units")
            raise InputError(
                f"{source}: time '{text}' is no number, and the times are no dates"
                f" ({f'their units are {units!r}' if units else 'they have no units'});"
                f" give a number {_range(coordinate)}"
            ) from None
        try:
            number = _of_date(coordinate, found, str(text))
        except InputError as error:
            raise InputError(
                f"{source}: time {error}; the series is {_range(coordinate)}"
            ) from error
    if not coordinate.values.min() <= number <= coordinate.values.max():
        raise RegionError(f"{source}: time {text} is outside the series, {_range(coordinate)}")
    return number


def times_of(coordinate: Coordinate, times: Any, source: str) -> npt.NDArray[np.float64]:
    """The times (any shape) that an array of numbers or of dates stands for, as `time_of` does.

    Numbers are not compared with the steps.
    """
    given = np.asarray(times)
    if given.dtype.kind in "iuf":
        return given.astype(np.float64)
    if given.dtype.kind not in "OMUS":
        raise InputError(f"{source}: {given.dtype} is no type of times; give numbers or dates")
    flat: list[Any] = [given[place] for place in np.ndindex(given.shape)]
    single = [time_of(coordinate, time, source) for time in flat]
    return np.array(single, np.float64).reshape(given.shape)


def _readable(time: Time, found: Clock | None, source: str) -> str | float:
    """A time as a number or as text: the fields of a date, as far as it has them."""
    if isinstance(time, np.datetime64):
        yearly = np.datetime_data(time.dtype)[0] == "Y"
        return str(time.astype("datetime64[M]") if yearly else time)
    if isinstance(time, datetime.datetime) and time.tzinfo is not None:
        time = time.astimezone(datetime.UTC).replace(tzinfo=None)
    if isinstance(time, datetime.date):
        return time.isoformat()
    if isinstance(time, bytes):
        return time.decode(errors="replace")
    calendar = getattr(time, "calendar", None)
    if calendar is None:
        if isinstance(time, str):
            return time
        try:
            return float(time)  # type: ignore[arg-type]
        except TypeError:
            raise InputError(f"{source}: {time!r} is no time; give a number or a date") from None
    usual = CALENDARS.get(str(calendar).lower())
    if found is not None and usual != found.calendar:
        raise InputError(
            f"{source}: time {time} is of the calendar {calendar}, the series of {found.calendar}"
        )
    year = time.year  # type: ignore[union-attr]
    if year < 1 and not getattr(time, "has_year_zero", True):
        year += 1
    clock_time = f"{time.hour}:{time.minute:02}:{time.second:02}.{time.microsecond:06}"  # type: ignore[union-attr]
    return f"{year}-{time.month}-{time.day}T{clock_time}"  # type: ignore[union-attr]


def time_range(coordinate: Coordinate, text: str, source: str) -> tuple[float, float, float | None]:
    """The first time, the last time and the time between two pictures of FIRST:LAST[:EVERY].

    An end is what `time_of` takes, or nothing for that of the series. Colons within dates are told
    from those between them: of several readings that one is taken whose dates have minutes with
    their hours, and which has ends that are written alike.

    Args:
        coordinate: times of the steps.
        text: the range; EVERY is a number above 0, in the units of the coordinate, or left out.
        source: name of the file, for messages.

    Raises ValueError for text that is no range, InputError for an end that is no time, and
    RegionError for one outside the steps.
    """
    first, last, every = min(_readings(text), key=_oddness, default=(None, None, None))
    if first is None or last is None:
        raise ValueError(text)
    values = coordinate.values
    ends = [
        time_of(coordinate, end, source) if end else float(values[place])
        for end, place in ((first, 0), (last, -1))
    ]
    return ends[0], ends[1], None if every is None else float(every)


def _readings(text: str) -> list[tuple[str, str, str | None]]:
    """Every way to read FIRST:LAST[:EVERY], with ends that look like times."""
    parts = [part.strip() for part in text.split(":")]
    found: list[tuple[str, str, str | None]] = []
    for middle, stop in itertools.combinations(range(1, len(parts) + 1), 2):
        first, last = ":".join(parts[:middle]), ":".join(parts[middle:stop])
        if stop < len(parts) - 1 or not (_is_end(first) and _is_end(last)):
            continue
        every = parts[stop] if stop < len(parts) else None
        if every is None or (is_number(every) and float(every) > 0):
            found.append((first, last, every))
    return found


def _oddness(reading: tuple[str, str, str | None]) -> tuple[int, bool]:
    """Hours without minutes, and whether the two ends are not written alike."""
    dates = [end for end in reading[:2] if end and not is_number(end)]
    matches = [match for end in dates if (match := DATE.fullmatch(end))]
    bare = sum(match["hour"] is not None and match["minute"] is None for match in matches)
    return bare, len({date.count(":") for date in dates}) > 1


def _is_end(text: str) -> bool:
    """Whether a text is empty, a number or in the form of a date."""
    return not text or is_number(text) or DATE.fullmatch(text) is not None


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


def is_static(coordinate: Coordinate) -> bool:
    """Whether a series is one volume without a time: its only step is at 0, in no units."""
    return (
        len(coordinate.values) == 1
        and coordinate.values[0] == 0
        and not coordinate.attributes.get("units")
    )


def number_text(coordinate: Coordinate, time: float) -> str:
    """A time as a number, with as many digits as tell neighbouring steps apart, at least 6."""
    gap = _gap(coordinate)
    largest = float(np.max(np.abs(coordinate.values)))
    digits = DIGITS[0]
    if gap and largest and math.isfinite(largest):
        # A quotient of the two may be beyond the floats; the difference of logarithms never is.
        decades = math.log10(largest) - math.log10(gap)
        digits = min(max(digits, math.ceil(decades) + 1), DIGITS[1])
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
