"""Attributes as JSON values, and text that files can hold."""

from __future__ import annotations

import itertools
import json
import math
import random
import re
from fractions import Fraction
from typing import Any

import cftime
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fhash_formats.container import record as strict_json
from fhash_formats.errors import DamagedFileError, InputError
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
from fhash_formats.support.values import (
    DTYPES,
    MAX_DEPTH,
    PACKING,
    PLUMBING,
    UnknownValueError,
    as_array,
    attribute_json,
    attribute_value,
    inline_array,
    inline_values,
    is_number,
    is_wide_integer,
    json_attributes,
    plain_json,
    plain_text,
    stored_type,
    text_of,
    type_of_name,
    typed_attribute,
)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("m s-1", "m s-1"),
        (b"caf\xc3\xa9", "caf\u00e9"),
        (b"\xff", "\u00ff"),
        (None, None),
        (True, True),
        (np.bool_(True), True),
        (np.int16(-3), -3),
        (np.float64(0.5), 0.5),
        (np.float32(0.5), 0.5),
        (math.inf, "Infinity"),
        (np.float32(-np.inf), "-Infinity"),
        (math.nan, "NaN"),
        (np.arange(3), [0, 1, 2]),
        (np.array([[1.0, np.nan]]), [[1.0, "NaN"]]),
        (np.array([b"a", b"b"]), ["a", "b"]),
        (np.datetime64("2000-01-01"), "2000-01-01"),
        ((1, "a"), [1, "a"]),
        ({"a": np.int8(1), 2: [b"x"]}, {"a": 1, "2": ["x"]}),
    ],
)
def test_values_become_json(value: Any, expected: Any) -> None:
    converted = json_attributes({"name": value})
    assert converted == {"name": expected}
    assert json.loads(json.dumps(converted, allow_nan=False)) == converted


@pytest.mark.parametrize("value", [object(), np.zeros(1, "V4"), np.complex64(1), [object()]])
def test_what_json_cannot_hold_is_dropped(value: Any) -> None:
    assert json_attributes({"bad": value, "good": 1}) == {"good": 1}


def test_names_that_only_tie_datasets_together_are_dropped() -> None:
    attributes = {"DIMENSION_LIST": "x", "scale_factor": 2.0, "units": "K"}
    assert json_attributes(attributes) == {"scale_factor": 2.0, "units": "K"}
    assert json_attributes(attributes, without=PLUMBING | PACKING) == {"units": "K"}


def test_text_without_lone_surrogates() -> None:
    assert plain_text("a\udcffb\u00e9") == "a\u00ffb\u00e9"
    assert json_attributes({"a": "\ud800"}) == {"a": "?"}
    assert text_of(b"\xb0C") == "\u00b0C"
    assert (text_of(b"\xc3\xa9"), text_of("x"), text_of(5)) == ("\u00e9", "x", "5")


def test_only_integers_of_64_bits_are_wide() -> None:
    assert {name for name, dtype in DTYPES.items() if is_wide_integer(dtype)} == {
        "int64",
        "uint64",
    }
    assert is_wide_integer(np.dtype(">i8"))


def test_what_float_reads_is_a_number() -> None:
    assert all(map(is_number, ["0", "-1.5", "1e-300", " 2 ", "inf", "nan", "1_000"]))
    assert not any(map(is_number, ["", " ", "x", "1:2", "0x10", "1,5", "2001-02-10", "--1"]))


@pytest.mark.parametrize(
    ("value", "figure", "attribute"),
    [
        (1.5, 1.5, 1.5),
        (np.float32(0.5), 0.5, 0.5),
        (np.longdouble(1.5), 1.5, 1.5),
        (np.array([1, np.nan], "g"), [1.0, None], [1.0, "NaN"]),
        (math.inf, None, "Infinity"),
        (-math.inf, None, "-Infinity"),
        (math.nan, None, "NaN"),
        (10**400, None, "1" + "0" * 400),
        (2**63, 2**63, 2**63),
        (np.uint64(2**64 - 1), 2**64 - 1, 2**64 - 1),
        (np.bool_(True), True, True),
        (True, True, True),
        (None, None, None),
        ("a\udc80\ud800", "a\x80?", "a\x80?"),
        ({"a\udc80": (1, np.int8(2))}, {"a\x80": [1, 2]}, {"a\x80": [1, 2]}),
        ({1: math.nan}, {"1": None}, {"1": "NaN"}),
        (np.ma.masked, None, None),
    ],
)
def test_each_rule(value: Any, figure: Any, attribute: Any) -> None:
    for converted, expected in ((plain_json(value), figure), (attribute_json(value), attribute)):
        assert converted == expected
        assert json.loads(json.dumps(converted, allow_nan=False)) == converted


@pytest.mark.skipif(
    np.finfo(np.longdouble).max <= np.finfo(np.float64).max, reason="long doubles are doubles here"
)
def test_long_doubles_beyond_float64() -> None:
    value = np.longdouble("1e400")
    assert plain_json(value) is None
    assert attribute_json(value) == "1e+400"


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize("value", [object(), 1j, np.complex64(1), {1}, nested(MAX_DEPTH + 1)])
def test_values_of_other_kinds(value: Any) -> None:
    assert json.dumps(plain_json(value), allow_nan=False)
    with pytest.raises(UnknownValueError):
        attribute_json(value)
    assert attribute_json(nested(MAX_DEPTH)) == nested(MAX_DEPTH)


def test_digits_that_python_refuses_to_write() -> None:
    assert plain_json(10**5000) is None
    with pytest.raises(UnknownValueError):
        attribute_json(10**5000)


ARRAYS = [
    np.array([0.1, -0.0, 1e-45, np.nan, np.inf, -np.inf], "f4"),
    np.array([[0.1, 5e-324], [1.7e308, -2.5]]),
    np.array([2**63 - 1, -(2**63)]),
    np.array([2**64 - 1, 0], "u8"),
    np.array([65504, 6e-8], "f2"),
    np.array(-7, "i1"),
    np.array([b"a", b"\xff\x00\xe9"], "S3"),
    np.array([["ü", ""]], dtype=object),
    np.array(["one", "other"]),
    np.array([1.5, 2.5], ">f8"),
]


def through(values: Any) -> Any:
    """JSON values after a document."""
    return strict_json.loads(strict_json.dumps({"v": values}, "test"))["v"]


@pytest.mark.parametrize("values", ARRAYS, ids=lambda values: str(values.dtype))
def test_arrays_come_back_in_every_bit(values: np.ndarray) -> None:
    name = stored_type(values)
    back = inline_array(through(inline_values(values, name)), name, values.shape)
    assert back.shape == values.shape
    if name == "text":
        assert back.tolist() == values.tolist()
    else:
        assert back.tobytes() == values.astype(type_of_name(name)).tobytes()


def test_other_bits_of_nan_are_not_written_as_text() -> None:
    values = np.array([0x7FC00001], "u4").view("f4")
    assert inline_values(values, "float32") is None


@pytest.mark.parametrize(
    "value",
    [
        "text",
        "",
        True,
        7,
        -2.5,
        np.float32(0.1),
        np.int16(-3),
        np.float64("nan"),
        np.array([1, 2]),
        np.array([1.0, 2.0]),
        np.array([1.0, np.nan]),
        np.array([1, 2], "u1"),
        np.array([]),
        ["a", "b"],
        {"nested": [1, None]},
        [1, "mixed"],
        None,
    ],
    ids=repr,
)
def test_attributes_keep_their_type(value: Any) -> None:
    back = attribute_value(through(typed_attribute(value)))
    if isinstance(value, np.ndarray | np.generic):
        assert np.asarray(back).dtype == np.asarray(value).dtype
        assert np.asarray(back).shape == np.asarray(value).shape
    np.testing.assert_equal(back, value)


@pytest.mark.parametrize("value", [1j, np.zeros((2, 2)), "\ud800", np.array([object()])])
def test_values_without_a_form_are_refused(value: Any) -> None:
    with pytest.raises(UnknownValueError):
        typed_attribute(value)


@pytest.mark.parametrize(
    ("listed", "name"),
    [
        ([300], "uint8"),
        ([-1], "uint64"),
        ([1.5], "int32"),
        ([True], "int32"),
        ([1e39], "float32"),
        (["nan"], "float64"),
        ([True], "float64"),
        ([10**400], "float64"),
        (["ab"], "bytes1"),
        (["\u0100"], "bytes1"),
        ([1], "text"),
        ([1, 2], "int32"),
        ("1", "int32"),
        ([1], "complex64"),
        (["a"], "bytes99999"),
        ([1], ["int32"]),
    ],
)
def test_hostile_lists_are_damage(listed: Any, name: Any) -> None:
    with pytest.raises(DamagedFileError):
        inline_array(listed, name, (1,))


@pytest.mark.parametrize("value", [None, [], {}, [1, "a"], {"a": 1, "b": 2}, {"int8": 300}, [[1]]])
def test_hostile_attributes_are_damage(value: Any) -> None:
    json.dumps(value)
    with pytest.raises(DamagedFileError):
        attribute_value(value)


@pytest.mark.parametrize("name", ["int8", "uint64", "int64", "float16", "float32", "float64"])
def test_long_lists_of_numbers_are_taken_as_single_ones_are(name: str) -> None:
    numbers = [0, 1, 127, -1, 2**63, 2**64, 0.1, -0.0, 1e300, 10**300, 10**400, True, "NaN", None]
    for number in numbers:
        try:
            single = attribute_value({name: number})
        except DamagedFileError:
            with pytest.raises(DamagedFileError):
                inline_array([1, number, 1], name, (3,))
        else:
            found = inline_array([1, number, 1], name, (3,))
            assert found[1:2].tobytes() == np.asarray(single).tobytes()
            assert found.dtype == single.dtype


def test_values_of_more_bytes_than_are_allowed_are_refused() -> None:
    assert inline_array(["", "a"], "bytes4", (2,), 8).tolist() == [b"", b"a"]
    with pytest.raises(DamagedFileError, match="too many bytes"):
        inline_array(["", "a"], "bytes4", (2,), 7)


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


class Exchanged:
    """An array that is exchanged by DLPack alone."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __dlpack__(self, **options: Any) -> Any:
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self) -> Any:
        return self.values.__dlpack_device__()


class Elsewhere:
    """An array in the memory of a GPU, as cupy refuses to copy it."""

    shape = (2, 2)

    def __array__(self, *more: Any, **options: Any) -> np.ndarray:
        raise TypeError("Implicit conversion to a NumPy array is not allowed. Use .get()")


NUMBERS = np.array([[1.0, 2.0], [3.0, 4.0]])
COVERED = np.ma.array(NUMBERS, mask=[[False, True], [False, False]], fill_value=-1)
SHOWN = np.array([[1.0, np.nan], [3.0, 4.0]])


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (COVERED, SHOWN),
        (COVERED.harden_mask(), SHOWN),
        (COVERED.astype(">f4"), SHOWN),
        (list(COVERED), SHOWN),
        ([[COVERED, COVERED], [COVERED, COVERED]], np.broadcast_to(SHOWN, (2, 2, 2, 2))),
        ([[1.0, np.ma.masked], [3.0, 4.0]], SHOWN),
        (np.ma.array(NUMBERS), NUMBERS),
        (np.ma.array(NUMBERS.astype(int)), NUMBERS),
        (Exchanged(NUMBERS), NUMBERS),
        (NUMBERS[::-1, ::-1].T, NUMBERS[::-1, ::-1].T),
        (np.ma.masked, np.array(np.nan)),
        ([], np.empty(0)),
        (NUMBERS.tolist(), NUMBERS),
    ],
)
def test_anything_like_an_array(given: Any, expected: np.ndarray) -> None:
    found = as_array(given)
    assert type(found) is np.ndarray
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.ma.array([1, 2], mask=[True, False]), "masked values of type int64, which has no NaN"),
        ([np.ma.array([1, 2], mask=[True, False])], "masked values of type int64"),
        ([1, np.ma.masked], "masked values of type int64"),
        (Elsewhere(), r"it cannot become an array of numpy: Implicit .* Use \.get\(\)"),
        ([np.zeros(2), np.zeros(3)], r"a list of arrays of shapes \(2,\) and \(3,\)"),
    ],
)
def test_what_is_no_array_is_told_in_one_line(given: Any, message: str) -> None:
    with pytest.raises(InputError, match=f"the field: {message}"):
        as_array(given, "the field")
