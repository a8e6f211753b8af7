"""Dimensions that are axes, that are selected, and that are asked about."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf import Column
from fhash_formats.readers.common.file_series import Request
from fhash_formats.readers.common.layout import Dimension, arrange, shared_roles


def dims(text: str) -> list[Dimension]:
    """Dimensions such as "member=5 time=4:t 8"; a letter after a colon is what the file says."""
    found = []
    for word in text.split():
        rest, _, role = word.partition(":")
        name, _, length = rest.rpartition("=")
        found.append(Dimension(name=name or None, length=int(length), role=role or None))
    return found


def axes(text: str, *select: tuple[str, str], given: str | None = None) -> str:
    """Axis of each dimension as a letter, "." for one that is selected."""
    request = Request(select=select, axes=tuple(given) if given is not None else None)
    layout = arrange("a", "v", dims(text), request)
    letters = iter(layout.axes)
    return "".join(
        "." if place in layout.picked else next(letters) for place in range(len(layout.dimensions))
    )


@pytest.mark.parametrize(
    ("text", "select", "expected"),
    [
        ("4 11 12 13", [], "tzyx"),
        ("11 12 13", [], "zyx"),
        ("member=5 time=4:t lev=3:z lat=8:y lon=9:x", [("member", "1")], ".tzyx"),
        ("time=4:t number=5 lat=8:y lon=9:x", [("number", "0")], "t.yx"),
        ("time=4:t foo=5 lat=8:y lon=9:x", [], "tzyx"),
        ("member=1 time=4:t lat=8:y lon=9:x", [], ".tyx"),
        ("run=1 time=4:t lev=3:z lat=8:y lon=9:x", [], ".tzyx"),
        ("4 11 12 13 3", [("4", "2")], "tzyx."),
        ("4 11 12 13 3", [("dim0", "-1"), ("dim4", "2")], ".zyx."),
        ("4 11 12", [("dim0", "2")], ".yx"),
        ("time=4:t lev=3:z lat=8:y lon=9:x", [("lev", "0")], "t.yx"),
        ("init=2:t lead=4:t lev=3:z lat=8:y lon=9:x", [("init", "0")], ".tzyx"),
        ("x=9:x y=9:y z=9:z time=20", [], "xyzt"),
    ],
)
def test_axes_and_selections(text: str, select: Sequence[tuple[str, str]], expected: str) -> None:
    assert axes(text, *select) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("member=5 time=4:t lev=3:z lat=8:y lon=9:x", "--select member=0 .member has 5"),
        ("time=4:t member=5 lat=8:y lon=9:x", "--select member=0"),
        ("time=4:t lev=3:z lat=8:y lon=9:x foo=2", "--select foo=0"),
        ("init=2:t lead=4:t lev=3:z lat=8:y lon=9:x", "--select init=0"),
        ("5 4 11 12 13", "--select dim0=0"),
        ("4 11 12 13 3", "--select dim4=0"),
        ("2 4 11 12 13 3", "--select dim5=0 --select dim0=0"),
        ("1 4 11 12 13", "--select dim0=0"),
    ],
)
def test_further_dimensions_must_be_selected(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        axes(text)


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("16 24 24 3", ["--axes t,z,y,x", "--select dim3=0"]),
        ("24 24 3", ["--axes z,y,x", "--select dim2=0"]),
        ("z=16:z y=24:y x=24:x c=3", ["--axes z,y,x,t", "--select c=0"]),
        ("time=4:t y=24:y x=24:x c=3", ["--axes t,y,x,z", "--select c=0"]),
    ],
)
def test_both_readings_of_a_short_last_dimension(text: str, options: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        axes(text)
    for option in options:
        assert option in str(caught.value)
        word, _, value = option.partition(" ")
        if word == "--axes":
            assert axes(text, given=value.replace(",", "")) == value.replace(",", "")
        else:
            name, _, index = value.partition("=")
            assert axes(text, (name, index)).endswith(".")


def test_positions_along_the_last_dimension_answer_the_question() -> None:
    *others, last = dims("16 24 24 3")
    column = Column(name="x", length=3, read=lambda: np.arange(3.0), attributes={})
    known = Dimension(name=None, length=last.length, column=column)
    assert arrange("a", "v", [*others, known], Request()).axes == ("t", "z", "y", "x")


def test_who_selects_time_is_still_asked_about_components() -> None:
    with pytest.raises(InputError, match="--select dim4=0"):
        axes("5 16 24 24 3", ("dim0", "1"))
    assert axes("5 16 24 24 3", ("dim0", "1"), ("dim4", "1")) == ".zyx."


@pytest.mark.parametrize(
    ("text", "select", "words"),
    [
        ("4 5 6", [("dim3", "0")], "no dimension 'dim3'; its dimensions are dim0=4"),
        ("4 5 6", [("member", "0")], "no dimension 'member'"),
        ("4 5 6", [("dim0", "4")], r"outside the indices 0\.\.3"),
        ("4 5 6", [("dim0", "-5")], r"outside the indices 0\.\.3"),
        ("4 5 6", [("dim0", "a")], r"no index 0\.\.3"),
        ("4 5 6", [("dim0", "1"), ("-3", "1")], "a second time"),
        ("4 5 6", [("dim0", "1"), ("dim1", "1")], "at least 2 are needed"),
    ],
)
def test_selections_that_do_not_fit(
    text: str, select: Sequence[tuple[str, str]], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        axes(text, *select)


def test_a_selection_fetches_only_what_is_selected() -> None:
    values = np.arange(2 * 3 * 4 * 5 * 6).reshape(2, 3, 4, 5, 6)
    layout = arrange("a", "v", dims("2 3 4 5 6"), Request(select=(("dim1", "1"), ("dim4", "5"))))
    asked = []

    def read(ranges: tuple[slice, ...]) -> np.ndarray:
        asked.append(ranges)
        return values[ranges]

    got = layout.fetch(read)((slice(0, 1), slice(0, 4), slice(0, 5)))
    np.testing.assert_array_equal(got, values[:1, 1, :, :, 5])
    assert asked == [(slice(0, 1), slice(1, 2), slice(0, 4), slice(0, 5), slice(5, 6))]
    assert layout.chunks((1, 2, 3, 4, 5)) == (1, 3, 4)
    assert layout.attributes() == {"selection": "dim1=1, dim4=5"}


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        (["run=7 level=5:z lat=20:y lon=24:x", "run=7 lat=20:y lon=24:x"], {"run": "t"}),
        (["run=7 lat=20:y lon=24:x"], {}),
        (["a=7 b=5 lat=20:y lon=24:x", "b=5 lat=20:y lon=24:x"], {"a": "t", "b": "z"}),
        (["a=7 b=5 c=20 d=24", "b=5 a=7 d=24 c=20"], {"a": "t", "b": "z", "c": "y", "d": "x"}),
        (["member=4 run=7 lat=20:y lon=24:x"], {}),
        (["one=1 run=7 level=5:z lat=20:y lon=24:x"], {"run": "t"}),
        (["run=9 a=20 b=24 c=3"], {}),  # the last may be components
        (["a=9:z run=20:z b=24 c=30"], {}),
    ],
)
def test_a_dimension_has_one_role_in_a_file(arrays: list[str], expected: dict[str, str]) -> None:
    assert shared_roles(map(dims, arrays)) == expected
