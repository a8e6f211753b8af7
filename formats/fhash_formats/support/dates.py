"""Dates of times that are counted "since" a date, in the calendars of CF, without rounding.

Source: CF 1.11, section 4.4. Days are counted from 0000-03-01 of the proleptic Gregorian calendar,
or from year 0 of the calendars of models; times of a day are whole nanoseconds. Years are numbered
as astronomers do, with a year 0. Times in units of changing length (months, years) are counted anew
in days, as months of their calendar.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any

from fhash_formats.errors import InputError

SECOND = 10**9
"""Nanoseconds of a second."""

DAY = 86_400 * SECOND
"""Nanoseconds of a day."""

UNIT_NAMES = {
    365 * DAY: "common_year common_years",
    7 * DAY: "week weeks",
    DAY: "day days d",
    3600 * SECOND: "hour hours hr hrs h",
    60 * SECOND: "minute minutes min mins",
    SECOND: "second seconds sec secs s",
    10**6: "millisecond milliseconds millisec millisecs msec msecs ms",
    10**3: "microsecond microseconds microsec microsecs us µs",
    1: "nanosecond nanoseconds nsec ns",
}
UNITS = {name: length for length, names in UNIT_NAMES.items() for name in names.split()}
"""Nanoseconds of each unit of time; common years, as cftime has them, are of noleap alone."""

MONTH_UNITS = {"month": 1, "months": 1, "year": 12, "years": 12, "yr": 12, "yrs": 12}
"""Months of each unit of changing length."""

CALENDARS = {
    "standard": "standard",
    "gregorian": "standard",
    "proleptic_gregorian": "proleptic_gregorian",
    "julian": "julian",
    "noleap": "noleap",
    "365_day": "noleap",
    "all_leap": "all_leap",
    "366_day": "all_leap",
    "360_day": "360_day",
    "360": "360_day",
}
"""The usual name of each calendar that has dates."""

MONTHS = (31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31)
"""Days of the months of a common year."""

FIRST_GREGORIAN = 2_299_161
"""Julian day number of 1582-10-15, where the standard calendar changes."""

MARCH_OF_YEAR_0 = 1_721_120
"""Julian day number of 0000-03-01 of the proleptic Gregorian calendar."""

MARCH_OF_YEAR_0_JULIAN = 1_721_118
"""Julian day number of 0000-03-01 of the Julian calendar."""

LARGEST_YEAR = 10**6
"""Years beyond it are no dates."""

SINCE = re.compile(r"\s*(\S+)\s+since\s+(\S|\S.*\S)\s*", re.IGNORECASE)
"""Units of a time that is counted since something; the work is in proportion to the length."""

NUMERIC = re.compile(
    r"\s*(?:\w+\s+as\s+)?(?:%Y(?P<month>%m(?P<day>%d)?)?|(?i:YYYY(?P<mm>MM(?P<dd>DD)?)?))"
    r"(?:\.%?[fF]*)?\s*"
)
"""Units of a time whose digits are those of a date, as GrADS, CDO and ECHAM write them.

Behind the point is a share of the day, the month or the year.
"""

WRITTEN = re.compile(
    r"(\d{4})[-/.]?(\d\d)[-/.]?(\d\d)(?:[-_T ]*(\d\d):?(\d\d)?:?(\d\d(?:\.\d+)?)?)?Z?"
)
"""A date as models write it: 2018-10-15_03:00:00, 20181015, 2018/10/15 03:00."""

DATE = re.compile(
    r"(?P<year>[+-]?\d{1,6})-(?P<month>\d{1,2})(?:-(?P<day>\d{1,2}))?"
    r"(?:(?:[T ]\s*|\s+)(?P<hour>\d{1,2})"
    r"(?::(?P<minute>\d{1,2})(?::(?P<second>\d{1,2})(?:[.,](?P<part>\d{1,9})\d*)?)?)?)?"
    r"\s*(?P<zone>Z|UTC|GMT|[+-]\d{1,2}(?::?\d{2})?)?",
    re.IGNORECASE,
)


@dataclass(frozen=True, kw_only=True)
class Clock:
    """A way to count time: the units "UNIT since DATE" of a coordinate, in its calendar.

    Attributes:
        unit: nanoseconds of the unit.
        epoch: nanoseconds from day 0 of the calendar to the date.
        calendar: usual name of the calendar.
    """

    unit: int
    epoch: int
    calendar: str

    def instant(self, value: float) -> Fraction:
        """Nanoseconds from day 0 of the calendar to a counted time, exactly."""
        return self.epoch + Fraction(value) * self.unit

    def value(self, instant: int | Fraction) -> float:
        """The counted time that is nearest to an instant."""
        return float((Fraction(instant) - self.epoch) / self.unit)

    def texts(self, values: Sequence[float]) -> list[str]:
        """The dates of finite times, in ISO 8601, with what tells different times apart.

        A date is as short as it can be: 2001-02-10, or 2001-02-10T06:00. What it leaves out is at
        most what float64 cannot tell, or a 10,000th of the distance of the times and a second.
        Years of more than six digits are left as numbers.
        """
        ordered = sorted(set(values))
        gaps = [after - before for before, after in pairwise(ordered)]
        return [self.text(value, min(gaps, default=None)) for value in values]

    def text(self, value: float, gap: float | None = None) -> str:
        """The date of one finite time; `gap` is the smallest distance of the times around it."""
        exact = self.instant(value)
        if abs(exact) > LARGEST_YEAR * 366 * DAY:
            return f"{value:.12g}"
        blurred = 2 * Fraction(math.ulp(value)) * self.unit
        share = Fraction(0) if gap is None else Fraction(gap) * self.unit / 10_000
        allowed = max(blurred, min(share, Fraction(SECOND)))
        for grain in (60 * SECOND, SECOND, 10**6, 10**3, 1):
            rounded = round(exact / grain) * grain
            if abs(rounded - exact) <= allowed or grain == 1:
                break
        return date_text(rounded, self.calendar)


def clock(attributes: Mapping[str, Any]) -> Clock | None:
    """The clock of a coordinate with the attributes `units` and `calendar`.

    None where they name no date, as "s", "months since ..." or a calendar that is not known.
    """
    match = re.fullmatch(
        r"\s*([A-Za-zµ_]+)\s+(?:since|after|from|ref)\s+(\S|\S.*\S)\s*",
        str(attributes.get("units", "")),
    )
    calendar = CALENDARS.get(str(attributes.get("calendar") or "standard").strip().lower())
    if match is None or calendar is None:
        return None
    unit = UNITS.get(match[1], UNITS.get(match[1].lower()))
    if unit is None or (unit == 365 * DAY and calendar != "noleap"):
        return None
    try:
        epoch, _ = instants(match[2], calendar)
    except InputError:
        return None
    return Clock(unit=unit, epoch=epoch, calendar=calendar)


def in_days(
    values: Sequence[float], attributes: Mapping[str, Any]
) -> tuple[list[float], dict[str, str]] | None:
    """Finite times in days since their date, and the units and the calendar of these.

    A whole month or year leads to the same day of a later month, or to its last day; a fraction is
    a share of the month in which it lies. Dates that are written as numbers, "day as %Y%m%d.%f",
    are counted since the first of them. None where the units and the calendar name no date.
    """
    units = str(attributes.get("units", ""))
    match = SINCE.fullmatch(units)
    calendar = CALENDARS.get(str(attributes.get("calendar") or "standard").strip().lower())
    known, months = clock(attributes), None if match is None else MONTH_UNITS.get(match[1].lower())
    try:
        if known is not None:
            days = Clock(unit=DAY, epoch=known.epoch, calendar=known.calendar)
            exact = [known.instant(value) for value in values]
        elif match is not None and months is not None and calendar is not None:
            days = Clock(unit=DAY, epoch=instants(match[2], calendar)[0], calendar=calendar)
            exact = [_months_later(days, Fraction(value) * months) for value in values]
        elif (written := NUMERIC.fullmatch(units)) is not None and calendar and values:
            exact = [Fraction(_of_digits(value, written, calendar)) for value in values]
            epoch = int(exact[0]) // DAY * DAY
            days = Clock(unit=DAY, epoch=epoch, calendar=calendar)
        else:
            return None
    except InputError:
        return None
    units = f"days since {date_text(days.epoch, days.calendar).replace('T', ' ')}"
    return [days.value(each) for each in exact], {"units": units, "calendar": days.calendar}


def is_numeric_date(units: str) -> bool:
    """Whether units say that the digits of a time are those of a date; see NUMERIC."""
    return NUMERIC.fullmatch(units) is not None


def _of_digits(value: float, form: re.Match[str], calendar: str) -> int:
    """The instant of a date that is written as a number; InputError for one that is no date.

    It is that of a whole second where float64 cannot tell the two apart.
    """
    digits, share = divmod(Fraction(abs(value)), 1)
    number = int(digits)
    day = month = 1
    if form["day"] or form["dd"]:
        number, day = divmod(number, 100)
    if form["month"] or form["mm"]:
        number, month = divmod(number, 100)
    year = -number if value < 0 else number
    if not 1 <= month <= 12 or not 1 <= day <= days_of_month(year, month, calendar):
        raise InputError(f"{value:.12g} is no date of the calendar {calendar}")
    first = day_number(year, month, day, calendar)
    after = first + 1
    if not (form["day"] or form["dd"]):
        whole = not (form["month"] or form["mm"])
        later = (year + 1, 1) if whole or month == 12 else (year, month + 1)
        after = day_number(*later, 1, calendar)
    instant = round((first + share * (after - first)) * DAY)
    second = round(Fraction(instant, SECOND)) * SECOND
    blurred = 2 * Fraction(math.ulp(value)) * (after - first) * DAY
    return second if abs(second - instant) <= blurred else instant


def _months_later(start: Clock, months: Fraction) -> Fraction:
    """The instant some months after the date of a clock; raises InputError beyond LARGEST_YEAR."""
    if abs(months) > 12 * LARGEST_YEAR:
        raise InputError("years of more than six digits are no dates")
    whole = math.floor(months)
    day, rest = divmod(start.epoch, DAY)
    year, month, number = date_of_day(day, start.calendar)
    ends = []
    for later in (whole, whole + 1):
        then_year, then_month = divmod(12 * year + month - 1 + later, 12)
        last = days_of_month(then_year, then_month + 1, start.calendar)
        at = day_number(then_year, then_month + 1, min(number, last), start.calendar)
        ends.append(at * DAY + rest)
    return ends[0] + (months - whole) * (ends[1] - ends[0])


def of_texts(texts: Sequence[str], calendar: str) -> tuple[list[float], dict[str, str]] | None:
    """Times that are written as dates, counted since the first, with their units and calendar.

    The unit is the longest of day, hour, minute and second that counts all in whole numbers. None
    where some text is no date of the calendar.
    """
    exact = []
    for text in texts:
        match = WRITTEN.fullmatch(text.strip())
        if match is not None:
            year, month, day, *of_day = match.groups()
            hour, minute, second = (part or "00" for part in of_day)
            text = f"{year}-{month}-{day}T{hour}:{minute}:{second}"
        try:
            exact.append(instants(text, calendar)[0])
        except InputError:
            return None
    if not exact:
        return None
    names = ("days", "hours", "minutes", "seconds")[len(exact) == 1 :]  # files of a step an hour
    usable = ((UNITS[name], name) for name in names)
    whole = (pair for pair in usable if not any((each - exact[0]) % pair[0] for each in exact))
    unit, name = next(whole, (SECOND, "seconds"))
    counted = Clock(unit=unit, epoch=exact[0], calendar=calendar)
    units = f"{name} since {date_text(exact[0], calendar).replace('T', ' ')}"
    return [counted.value(each) for each in exact], {"units": units, "calendar": calendar}


def instants(text: str, calendar: str) -> tuple[int, int]:
    """First instant of a date, and that behind it, in nanoseconds from day 0 of the calendar.

    A date with minutes is an instant, and both are equal; a day, a month or an hour lasts. Raises
    InputError for text that is no date of the calendar.
    """
    match = DATE.fullmatch(text.strip())
    if match is None:
        raise InputError(
            f"'{text}' is no date; write it as 2001-02-10, 2001-02-10T06:00 or 2001-02"
        )
    year, month = int(match["year"]), int(match["month"])
    day, hour, minute, second = (
        int(match[name] or default)
        for name, default in (("day", 1), ("hour", 0), ("minute", 0), ("second", 0))
    )
    if (
        not 1 <= month <= 12
        or abs(year) > LARGEST_YEAR
        or not 1 <= day <= days_of_month(year, month, calendar)
        or hour > 24
        or minute > 59
        or second > 59
    ):
        raise InputError(f"'{text}' is no date of the calendar {calendar}")
    parts = int((match["part"] or "0").ljust(9, "0"))
    clock_time = (hour * 3600 + minute * 60 + second) * SECOND + parts
    first = day_number(year, month, day, calendar) * DAY + clock_time - _offset(match["zone"])
    if match["minute"] is not None:
        return first, first
    if match["hour"] is not None:
        return first, first + 3600 * SECOND
    if match["day"] is not None:
        return first, first + DAY
    following = (year + 1, 1) if month == 12 else (year, month + 1)
    return first, day_number(*following, 1, calendar) * DAY - _offset(match["zone"])


def _offset(zone: str | None) -> int:
    """Nanoseconds by which a zone's clock is ahead of UTC."""
    if not zone or zone[0] not in "+-":
        return 0
    hours, minutes = re.fullmatch(r"[+-](\d{1,2}):?(\d{2})?", zone).groups()  # type: ignore[union-attr]
    ahead = (int(hours) * 60 + int(minutes or 0)) * 60 * SECOND
    return ahead if zone[0] == "+" else -ahead


def is_leap(year: int, calendar: str) -> bool:
    """Whether February of a year has 29 days."""
    if calendar in ("noleap", "all_leap"):
        return calendar == "all_leap"
    if calendar == "julian" or (calendar == "standard" and year <= 1582):
        return year % 4 == 0
    return year % 4 == 0 and (year % 100 != 0 or year % 400 == 0)


def days_of_month(year: int, month: int, calendar: str) -> int:
    """Number of the last day of a month."""
    if calendar == "360_day":
        return 30
    return MONTHS[month - 1] + (month == 2 and is_leap(year, calendar))


def day_number(year: int, month: int, day: int, calendar: str) -> int:
    """Days from day 0 of the calendar to a date; the Julian day number in calendars of the world.

    Raises InputError for the days that the standard calendar leaves out in October 1582.
    """
    if calendar == "360_day":
        return (year * 12 + month - 1) * 30 + day - 1
    if calendar in ("noleap", "all_leap"):
        leap = int(calendar == "all_leap")
        return year * (365 + leap) + sum(MONTHS[: month - 1]) + (month > 2) * leap + day - 1
    # Years that begin in March end with their leap day.
    shifted = year - (month < 3)
    of_year = (153 * ((month + 9) % 12) + 2) // 5 + day - 1
    julian = MARCH_OF_YEAR_0_JULIAN + 365 * shifted + shifted // 4 + of_year
    gregorian = MARCH_OF_YEAR_0 + 365 * shifted + shifted // 4 - shifted // 100 + shifted // 400
    gregorian += of_year
    if calendar == "julian" or (calendar == "standard" and julian < FIRST_GREGORIAN):
        return julian
    if calendar == "standard" and gregorian < FIRST_GREGORIAN:
        raise InputError(
            f"{year:04}-{month:02}-{day:02} is no date of the calendar standard, which has no"
            " 1582-10-05 to 1582-10-14"
        )
    return gregorian


def date_of_day(number: int, calendar: str) -> tuple[int, int, int]:
    """Year, month and day of a day number; the inverse of `day_number`."""
    if calendar == "360_day":
        months, day = divmod(number, 30)
        return months // 12, months % 12 + 1, day + 1
    if calendar in ("noleap", "all_leap"):
        year, rest = divmod(number, 366 if calendar == "all_leap" else 365)
        month = 1
        while rest >= days_of_month(year, month, calendar):
            rest -= days_of_month(year, month, calendar)
            month += 1
        return year, month, rest + 1
    if calendar == "julian" or (calendar == "standard" and number < FIRST_GREGORIAN):
        cycle, of_cycle = divmod(number - MARCH_OF_YEAR_0_JULIAN, 1461)
        of_century = min(of_cycle // 365, 3)
        year, of_year = 4 * cycle + of_century, of_cycle - 365 * of_century
    else:
        era, of_era = divmod(number - MARCH_OF_YEAR_0, 146_097)
        in_era = (of_era - of_era // 1460 + of_era // 36_524 - of_era // 146_096) // 365
        year = 400 * era + in_era
        of_year = of_era - (365 * in_era + in_era // 4 - in_era // 100)
    month = (5 * of_year + 2) // 153
    day = of_year - (153 * month + 2) // 5 + 1
    return year + (month > 9), (month + 2) % 12 + 1, day


def date_text(instant: int, calendar: str) -> str:
    """An instant in ISO 8601: the clock time is left out at midnight, seconds where they are 0."""
    day, rest = divmod(instant, DAY)
    year, month, number = date_of_day(day, calendar)
    text = f"{'-' if year < 0 else ''}{abs(year):04}-{month:02}-{number:02}"
    if not rest:
        return text
    minutes, rest = divmod(rest, 60 * SECOND)
    text += f"T{minutes // 60:02}:{minutes % 60:02}"
    if not rest:
        return text
    seconds, parts = divmod(rest, SECOND)
    digits = f"{parts:09}"
    digits = next((digits[:places] for places in (3, 6) if not int(digits[places:])), digits)
    return f"{text}:{seconds:02}" + (f".{digits}" if parts else "")
