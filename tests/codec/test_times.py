"""Times as people write them: numbers, dates, parts of dates; and as they are shown."""

from __future__ import annotations

import datetime as dt
from typing import Any

import cftime
import numpy as np
import pytest

from fhash_codec.times import number_text, time_of, time_range, time_text, times_of
from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import Coordinate


def times(values: list[float], units: str = "days since 2001-02-10", **more: str) -> Coordinate:
    return Coordinate(name="time", values=np.array(values), attributes={"units": units, **more})


HALF_DAYS = times([0, 0.5, 1, 1.5, 2])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.75", 0.75),
        (1.5, 1.5),
        ("2001-02-11", 1),
        ("2001-02-11T12:00", 1.5),
        ("2001-02-11 06:00", 1.25),
        ("2001-02-11T18", 1.75),
    ],
)
def test_numbers_and_dates(text: str | float, expected: float) -> None:
    assert time_of(HALF_DAYS, text, "run.fhz") == expected


def test_a_day_with_one_step_is_that_step() -> None:
    noon = times([0.5, 1.5, 2.5])
    assert time_of(noon, "2001-02-11", "run.fhz") == 1.5
    assert time_of(noon, "2001-02-10", "run.fhz") == 0.5
    assert time_of(noon, "2001-02-11T00:00", "run.fhz") == 1
    two = times([0.25, 1.25, 1.75, 2.25])
    assert time_of(two, "2001-02-11", "run.fhz") == 1
    assert time_of(times([4.5, 34.5]), "2001-03", "run.fhz") == 34.5


def test_a_date_within_the_rounding_of_a_step_is_the_step() -> None:
    thirds = times([1 / 3 + 1e-13, 2 / 3, 1 - 1e-13])
    assert time_of(thirds, "2001-02-10T08:00", "run.fhz") == 1 / 3 + 1e-13
    assert time_of(thirds, "2001-02-11", "run.fhz") == 1 - 1e-13


def test_calendars_of_models() -> None:
    march = times([58, 59], "days since 2000-01-01", calendar="noleap")
    assert time_of(march, "2000-03-01", "run.fhz") == 59
    with pytest.raises(InputError, match="'2000-02-29' is no date of the calendar noleap"):
        time_of(march, "2000-02-29", "run.fhz")


def test_texts_tell_steps_apart() -> None:
    assert time_text(HALF_DAYS, 0.5) == "2001-02-10T12:00"
    assert time_text(HALF_DAYS, 1) == "2001-02-11"
    assert time_text(times([0, 1], "s"), 0.25) == "0.25 s"
    assert time_text(times([0, 1], "1"), 0.25) == "0.25"
    late = times([347921.001, 347921.002], "s")
    assert number_text(late, late.values[0]) == "347921.001"
    assert number_text(times([5], "s"), 5) == "5"
    assert number_text(times([1e-300, 1e300], "s"), 1e300) == "1e+300"
    assert number_text(times([0, 1e-300, 1e300], "s"), 1e-300) == "1e-300"
    assert time_text(times([0, float("nan")]), float("nan")) == "nan days since 2001-02-10"


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        (dt.datetime(2001, 2, 11, 6), 1.25),
        (dt.datetime(2001, 2, 11, 6, tzinfo=dt.timezone(dt.timedelta(hours=6))), 1),
        (dt.date(2001, 2, 12), 2),
        (np.datetime64("2001-02-11T12"), 1.5),
        (np.datetime64("2001-02-11T06:00:00.000000000"), 1.25),
        (cftime.datetime(2001, 2, 11, 12, calendar="standard"), 1.5),
        (cftime.datetime(2001, 2, 11, 12, calendar="gregorian"), 1.5),
        (np.float32(0.5), 0.5),
        (b"2001-02-11", 1),
    ],
    ids=str,
)
def test_dates_of_python_numpy_and_cftime(time: Any, expected: float) -> None:
    assert time_of(HALF_DAYS, time, "run.fhz") == expected


@pytest.mark.parametrize("calendar", ["noleap", "360_day", "all_leap", "julian"])
def test_dates_of_cftime_are_of_the_calendar_of_the_series(calendar: str) -> None:
    dates = [cftime.datetime(2001, month, 28, 6, calendar=calendar) for month in (2, 3, 12)]
    units = "hours since 2000-02-01"
    counted = [float(cftime.date2num(date, units, calendar=calendar)) for date in dates]
    coordinate = times(counted, units, calendar=calendar)
    assert [time_of(coordinate, date, "run.fhz") for date in dates] == counted
    other = cftime.datetime(2001, 3, 1, calendar="standard")
    with pytest.raises(InputError, match=f"is of the calendar standard, the series of {calendar}"):
        time_of(coordinate, other, "run.fhz")


@pytest.mark.filterwarnings("ignore:this date/calendar/year zero convention")
def test_years_before_the_first_are_those_of_cftime() -> None:
    date = cftime.datetime(-1, 3, 1, calendar="standard", has_year_zero=False)
    units = "days since 0001-01-01"
    counted = float(cftime.date2num(date, units, calendar="standard"))
    assert time_of(times([counted, 0], units), date, "run.fhz") == counted


@pytest.mark.parametrize(
    ("time", "message"),
    [
        (np.datetime64("NaT"), "'NaT' is no date"),
        (None, "None is no time; give a number or a date"),
        ([1, 2], r"\[1, 2\] is no time"),
    ],
    ids=str,
)
def test_what_is_no_time_is_refused(time: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        time_of(HALF_DAYS, time, "run.fhz")


def test_arrays_of_times_keep_their_shape() -> None:
    dates = np.array([["2001-02-10", "2001-02-11T12"]], "datetime64[s]")
    for given in (dates, dates.astype(object), dates.astype(str), [[0, 1.5]]):
        np.testing.assert_array_equal(times_of(HALF_DAYS, given, "run.fhz"), [[0, 1.5]])
    assert times_of(HALF_DAYS, [], "run.fhz").shape == (0,)
    with pytest.raises(InputError, match="is no type of times"):
        times_of(HALF_DAYS, np.timedelta64(3, "h"), "run.fhz")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0:2", (0, 2, None)),
        (":1.5", (0, 1.5, None)),
        ("1::0.25", (1, 2, 0.25)),
        ("2:0:0.5", (2, 0, 0.5)),
        ("2001-02-10:2001-02-12", (0, 2, None)),
        ("2001-02-10:2001-02-12:0.5", (0, 2, 0.5)),
        ("2001-02-10T06:00:2001-02-11T12:00", (0.25, 1.5, None)),
        ("2001-02-10T06:00:2001-02-11T12:00:24", (0.25, 1.5, 24)),
        ("2001-02-10T06:00:00:2001-02-11T12:00:00", (0.25, 1.5, None)),
        ("2001-02-10T06:00:00:2001-02-11T12:00:00:2", (0.25, 1.5, 2)),
        ("2001-02-10:2001-02-11T12:00", (0, 1.5, None)),
        ("2001-02-10T12:2001-02-11T12", (0.5, 1.5, None)),
        ("2001-02-10T12:00:", (0.5, 2, None)),
        ("0.5:2001-02-11T12:00", (0.5, 1.5, None)),
    ],
)
def test_colons_of_dates_are_told_from_those_of_ranges(
    text: str, expected: tuple[float, float, float | None]
) -> None:
    assert time_range(HALF_DAYS, text, "run.fhz") == expected


@pytest.mark.parametrize("text", ["1", "a:b", "0:1:0", "0:1:-1", "0:1:2:3", "0:1:x"])
def test_what_is_no_range_of_times(text: str) -> None:
    with pytest.raises(ValueError, match="^" + text):
        time_range(HALF_DAYS, text, "run.fhz")


def test_ends_of_a_range_are_checked_as_times_are() -> None:
    with pytest.raises(RegionError, match="outside the series, 2001-02-10 to 2001-02-12"):
        time_range(HALF_DAYS, "2001-02-10:2001-03-01", "run.fhz")
    with pytest.raises(InputError, match="the times are no dates"):
        time_range(times([0, 1], units="s"), "2001-02-10:2001-02-11", "run.fhz")
