"""Times of files: converted without loss, or refused where float64 cannot hold them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.readers.common.times import join_times
from fhash_formats.series import Coordinate


def part(name: str, values: list[float], units: str, **more: str) -> tuple[Path, Coordinate]:
    attributes = {"units": units, **more}
    return Path(name), Coordinate(name="time", values=np.array(values), attributes=attributes)


def test_other_attributes_do_not_matter() -> None:
    parts = [part("a", [0, 1], "s", history="one"), part("b", [2, 3], "s", history="two")]
    joined = join_times("*", parts)
    assert joined.values.tolist() == [0, 1, 2, 3]
    assert joined.attributes == {"units": "s", "history": "one"}


def test_each_time_is_rounded_once() -> None:
    parts = [
        part("a", [0.5], "hours since 1850-01-01"),
        part("b", [1 / 3], "days since 2001-02-10", calendar="standard"),
    ]
    days = 55192  # from 1850-01-01 to 2001-02-10
    assert join_times("*", parts).values.tolist() == [0.5, days * 24 + 8]


@pytest.mark.parametrize(("nanoseconds", "kept"), [(10, False), (10**9, True)])
def test_a_loss_is_refused(nanoseconds: int, kept: bool) -> None:
    parts = [
        part("a", [55192.0], "days since 1850-01-01"),
        part("b", [nanoseconds, 2 * nanoseconds], "nanoseconds since 2001-02-10T01:00"),
    ]
    if kept:
        assert np.diff(join_times("*", parts).values)[1] == pytest.approx(1 / 86400, rel=1e-6)
        return
    with pytest.raises(InputError, match="too close to be counted in the units of a"):
        join_times("*", parts)


def test_times_that_are_not_finite() -> None:
    good, bad = (part("a", [value], "days since 1850-01-01") for value in (0, np.nan))
    other = part("b", [np.nan], "days since 1851-01-01")
    with pytest.raises(InputError, match="b are not all finite"):
        join_times("*", [good, other])
    with pytest.raises(InputError, match="do not increase"):
        join_times("*", [bad, part("b", [1], "days since 1850-01-01")])
