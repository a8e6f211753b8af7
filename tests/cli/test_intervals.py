"""Indices, slices and intervals as a user of numpy writes them, and the reason of a refusal."""

from __future__ import annotations

import click
import numpy as np
import pytest

from fhash_cli.intervals import IntervalsType, SliceType, parse_slice, written

WHOLE = (None, None)
LATTICE = np.arange(4 * 5 * 6).reshape(4, 5, 6)


@pytest.mark.parametrize(
    "text", ["0", "4", "-1", "-3", "2:5", ":", "::2", "1::3", ":-2", "-4:-1", " 1 : 4 "]
)
def test_slice_means_what_it_means_in_python(text: str) -> None:
    numbers = list(range(7))
    picked = eval(f"numbers[{text}]")
    assert numbers[parse_slice(text)] == (picked if isinstance(picked, list) else [picked])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is empty"),
        ("a", "a is no number"),
        ("1.5", "1.5 is between two"),
        ("1:2:3:4", "more than three parts"),
        ("::0", "the step 0, and steps go upwards"),
        ("::-1", "the step -1, and steps go upwards"),
        ("1,2", "1,2 is no number"),
    ],
)
def test_slice_of_another_form_says_why_and_the_form(text: str, reason: str) -> None:
    with pytest.raises(click.BadParameter, match="half-open range A:B") as refused:
        SliceType().convert(text, None, None)
    assert reason in refused.value.message


@pytest.mark.parametrize(
    "text", ["1,2,3", "0,-1", "2", "1:3", "1:3,2", ":,:,-2:", "...,3", "1,...,2:4", "...", "-2:,1:"]
)
def test_a_region_of_indices_is_that_of_numpy_with_every_axis_kept(text: str) -> None:
    spans = IntervalsType(int).convert(text, None, None)
    picked = LATTICE[tuple(slice(*span) for span in spans)]
    assert picked.ndim == 3
    assert picked.ravel().tolist() == np.ravel(eval(f"LATTICE[{text}]")).tolist()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.5:1e3, :2 ,-1:", ((0.5, 1000.0), (None, 2.0), (-1.0, None))),
        ("0.5:1", ((0.5, 1.0), WHOLE, WHOLE)),
        ("...,2:2", (WHOLE, WHOLE, (2.0, 2.0))),
    ],
)
def test_a_box_of_positions(text: str, expected: tuple[object, ...]) -> None:
    assert IntervalsType(float).convert(text, None, None) == expected


@pytest.mark.parametrize(
    ("number", "text", "reason"),
    [
        (int, "", "an interval is empty"),
        (int, "1:2,,3:4", "an interval is empty"),
        (int, "1:2,3:4,5:6,7:8", "4 intervals, and a region has 3 axes"),
        (int, "...,1,...", "stands there twice"),
        (int, "::2,:,:", "has a step, which a region has not"),
        (int, "0.5:1,:,:", "0.5 is between two"),
        (int, "a:b,:,:", "a is no number"),
        (int, "1:2:3:4", "more than three parts"),
        (float, "1,2,3", "'1' is one position, and an interval has two ends"),
        (float, "1:2:3", "more than two ends"),
        (float, "3:1,:,:", "'3:1' ends before it begins"),
        (float, "nan:1", "'nan' is no position"),
        (float, "a:1", "'a' is no position"),
    ],
)
def test_intervals_of_another_form_say_why_and_the_form(
    number: type[int] | type[float], text: str, reason: str
) -> None:
    with pytest.raises(click.BadParameter, match="write z0:z1,y0:y1,x0:x1") as refused:
        IntervalsType(number).convert(text, None, None)
    assert reason in refused.value.message


@pytest.mark.parametrize("text", ["5", "-3", "-1", "2:4", ":", "2:", ":-1"])
def test_a_range_is_written_as_it_was_given(text: str) -> None:
    chosen = parse_slice(text)
    assert written(chosen.start, chosen.stop) == text
