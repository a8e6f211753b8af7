"""Dates: the calendars against cftime and datetime, texts that are short and exact, bad dates."""

from __future__ import annotations

import itertools
import random
import re
from fractions import Fraction

import cftime
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fhash_formats.errors import InputError
from fhash_formats.support.dates import (
    CALENDARS,
    DAY,
    Clock,
    clock,
    date_of_day,
    date_text,
    day_number,
    days_of_month,
    in_days,
    instants,
    of_texts,
)

USUAL = sorted(set(CALENDARS.values()))


def counting(units: str, calendar: str | None = None) -> Clock:
    found = clock({"units": units} | ({} if calendar is None else {"calendar": calendar}))
    assert found is not None
    return found


@pytest.mark.parametrize("calendar", USUAL)
def test_day_numbers_are_a_bijection(calendar: str) -> None:
    before = day_number(-401, 1, 1, calendar)
    for number in range(before, before + 900_000, 353):
        assert day_number(*date_of_day(number, calendar), calendar) == number
    for year in (-4, 0, 1500, 1582, 1583, 1900, 2000, 2001):
        first, after = (day_number(year + ahead, 1, 1, calendar) for ahead in (0, 1))
        dates = [date_of_day(number, calendar) for number in range(first, after)]
        assert dates == sorted(set(dates))
        assert all(date[0] == year for date in dates)


@pytest.mark.parametrize("calendar", USUAL)
def test_dates_of_cftime(calendar: str) -> None:
    cftime = pytest.importorskip("cftime")
    choose = random.Random(0)
    epochs = ("1-1-1", "1582-10-15", "1900-01-01 12:30", "2000-02-28", "1970-01-01T00:00:00Z")
    for unit, epoch in itertools.product(("days", "hours", "seconds"), epochs):
        units = f"{unit} since {epoch}"
        own = counting(units, calendar)
        for _ in range(12):
            hours = choose.randrange(0, 6 * 700_000) * 6
            value = hours * {"days": 1 / 24, "hours": 1, "seconds": 3600}[unit]
            date = cftime.num2date(value, units, calendar)
            text = f"{date.year:04}-{date.month:02}-{date.day:02}"
            text += f"T{date.hour:02}:{date.minute:02}" if date.hour or date.minute else ""
            assert own.texts([value]) == [text]
            assert own.value(instants(text, calendar)[0]) == value


def test_the_change_of_the_standard_calendar() -> None:
    own = counting("days since 1582-10-04")
    assert own.texts([0, 1]) == ["1582-10-04", "1582-10-15"]
    with pytest.raises(InputError, match="has no 1582-10-05 to 1582-10-14"):
        instants("1582-10-10", "standard")


def test_models_calendars() -> None:
    assert counting("days since 2000-02-28", "noleap").texts([1]) == ["2000-03-01"]
    assert counting("days since 2001-02-28", "366_day").texts([1]) == ["2001-02-29"]
    own = counting("days since 2001-02-28", "360_day")
    assert own.texts([2, 3]) == ["2001-02-30", "2001-03-01"]


@pytest.mark.parametrize(
    ("units", "values", "texts"),
    [
        ("days since 2001-01-01", [40, 41], ["2001-02-10", "2001-02-11"]),
        ("days since 2001-01-01", [40.25], ["2001-02-10T06:00"]),
        ("days since 2001-01-01", [1 / 3, 2 / 3], ["2001-01-01T08:00", "2001-01-01T16:00"]),
        ("s since 2001-01-01", [0.5, 1.5], ["2001-01-01T00:00:00.500", "2001-01-01T00:00:01.500"]),
        (
            "us since 2001-01-01",
            [1, 2],
            ["2001-01-01T00:00:00.000001", "2001-01-01T00:00:00.000002"],
        ),
        ("ns since 2001-01-01", [1], ["2001-01-01T00:00:00.000000001"]),
        ("hours since 1970-01-01 -6:00", [0], ["1970-01-01T06:00"]),
        ("hours since 1970-01-01T00:00:00.000000000", [347921], ["2009-09-09T17:00"]),
        ("days since 2001-01-01", [1e300], ["1e+300"]),
        ("days since 0001-01-01", [-366.0], ["0000-01-01"]),
    ],
)
def test_texts(units: str, values: list[float], texts: list[str]) -> None:
    assert counting(units, "proleptic_gregorian").texts(values) == texts


def test_what_is_left_out_is_less_than_a_share_of_the_steps() -> None:
    # a 10,000th of an hour is 0.36 s, and of a minute 6 ms
    own = counting("seconds since 2001-01-01")
    assert own.text(0.35, 3600.0) == "2001-01-01"
    assert own.text(0.37, 3600.0) == "2001-01-01T00:00:00.370"
    assert own.text(0.0059, 60.0) == "2001-01-01"
    assert own.text(0.0061, 60.0) == "2001-01-01T00:00:00.006"
    # a second at most
    assert own.text(1.01, 1e9) == "2001-01-01T00:00:01"
    assert own.text(0.99, 1e9) == "2001-01-01"


@pytest.mark.parametrize(
    ("units", "calendar"),
    [
        ("s", None),
        ("", None),
        ("months since 2001-01-01", None),
        ("years since 2001-01-01", "noleap"),
        ("days since yesterday", None),
        ("days since 2001-02-30", None),
        ("days since 2001-01-01", "none"),
        ("days since 2001-01-01", "martian"),
    ],
)
def test_units_without_a_date(units: str, calendar: str | None) -> None:
    assert clock({"units": units, "calendar": calendar}) is None
    assert clock({}) is None


def test_a_part_of_a_date_lasts() -> None:
    def length(text: str) -> Fraction:
        first, after = instants(text, "standard")
        return Fraction(after - first, DAY)

    assert length("2001-02") == 28
    assert length("2000-02") == 29
    assert length("2001-12") == 31
    assert length("2001-02-10") == 1
    assert length("2001-02-10T06") == Fraction(1, 24)
    assert length("2001-02-10T06:00") == 0
    assert instants("2001-02-10 06:00:30.5", "standard") == instants(
        "2001-02-10T06:00:30.500Z", "standard"
    )
    assert instants("2001-02-10T06:00+02:00", "standard") == instants(
        "2001-02-10T04:00", "standard"
    )


@pytest.mark.parametrize(
    "text",
    [
        "",
        "soon",
        "2001",
        "2001-13-01",
        "2001-00-01",
        "2001-02-29",
        "2001-02-10T25:00",
        "2001-02-10T06:60",
        "2001-02-10T06:00:61",
        "9999999-01-01",
        "2001-02-10T06:00 or so",
    ],
)
def test_what_is_no_date(text: str) -> None:
    with pytest.raises(InputError, match="is no date"):
        instants(text, "standard")


def test_texts_are_read_back() -> None:
    choose = random.Random(1)
    for calendar in USUAL:
        for grain in (1, 10**3, 10**9, 60 * 10**9, DAY):
            instant = choose.randrange(2_400_000 * DAY // grain) * grain + 1_700_000 * DAY
            assert instants(date_text(instant, calendar), calendar)[0] == instant


@pytest.mark.parametrize("calendar", ["standard", "noleap", "all_leap", "julian", "360_day"])
@pytest.mark.parametrize(("unit", "months"), [("months", 1), ("years", 12)])
def test_months_and_years_are_those_of_the_calendar(calendar: str, unit: str, months: int) -> None:
    attributes = {"units": f"{unit} since 1999-11-30 06:00", "calendar": calendar}
    found = in_days([-13.0, 0.0, 3.0, 14.5], attributes)
    assert found is not None
    days, told = found

    def instant(later: int) -> cftime.datetime:
        year, month = divmod(12 * 1999 + 10 + later, 12)
        last = days_of_month(year, month + 1, calendar)
        return cftime.datetime(year, month + 1, min(30, last), 6, calendar=calendar)

    def counted(later: int) -> float:
        return float(cftime.date2num(instant(later), told["units"], told["calendar"]))

    assert days[:3] == [counted(months * value) for value in (-13, 0, 3)]
    if months == 1:
        assert days[3] == pytest.approx((counted(14) + counted(15)) / 2, rel=1e-15)
    else:
        assert days[3] == counted(12 * 14 + 6)


@given(st.floats(-500, 500), st.integers(1, 28))
def test_months_of_30_days_are_those_of_cftime(value: float, day: int) -> None:
    units = f"months since 1960-01-{day:02}"
    found = in_days([value], {"units": units, "calendar": "360"})
    assert found is not None
    there = cftime.num2date(value, units, "360_day")
    here = cftime.num2date(found[0][0], found[1]["units"], found[1]["calendar"])
    assert abs((here - there).total_seconds()) < 1e-3


@pytest.mark.parametrize(
    "attributes",
    [
        {"units": "months since the start"},
        {"units": "months since 2000-01-01", "calendar": "none"},
        {"units": "months"},
        {"units": "fortnights since 2000-01-01"},
        {"units": "years since 999999-01-01"},
    ],
)
def test_what_names_no_date_is_not_counted_anew(attributes: dict[str, str]) -> None:
    assert in_days([1e7], attributes) is None


@pytest.mark.parametrize(
    ("texts", "values", "units"),
    [
        (["2018-10-15_00:00:00", "2018-10-15_03:00:00"], [0, 3], "hours since 2018-10-15"),
        (["20200101", "20200301"], [0, 60], "days since 2020-01-01"),
        (
            ["2020-01-01T00:00:30Z", "2020-01-01 00:01"],
            [0, 30],
            "seconds since 2020-01-01 00:00:30",
        ),
        (["2020/01/01 06:00", "2020/01/01 06:20"], [0, 20], "minutes since 2020-01-01 06:00"),
    ],
)
def test_written_dates_are_counted(texts: list[str], values: list[float], units: str) -> None:
    found = of_texts(texts, "standard")
    assert found == (values, {"units": units, "calendar": "standard"})
    parsed = cftime.num2date(values, units, "standard")
    assert [each.strftime("%Y%m%d") for each in parsed] == [
        "".join(re.findall(r"\d", text))[:8] for text in texts
    ]


@pytest.mark.parametrize("texts", [["2018-02-30"], ["JJA", "SON"], ["2018-10-15", ""], []])
def test_other_texts_are_no_dates(texts: list[str]) -> None:
    assert of_texts(texts, "standard") is None
