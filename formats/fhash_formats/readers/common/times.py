"""Times of files one after the other, which may count since different dates."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.real_time import SINCE
from fhash_formats.series import Coordinate
from fhash_formats.support.dates import CALENDARS, clock

LOSS = Fraction(1, 10**6)
"""Largest change of a time that is counted anew, as a share of the distance of two times."""

Parts = Sequence[tuple[Path, Coordinate]]


def join_times(source: str, parts: Parts) -> Coordinate:
    """The times of files one after the other, counted as in the first.

    Files may count since different dates and in different units, in one calendar. Raises InputError
    for times that cannot be compared, that do not increase, or that float64 cannot hold as counted
    in the first file.
    """
    first_path, first = parts[0]
    values = [
        time.values
        if _units(time) == _units(first)
        else _converted(source, path, time, first_path, first)
        for path, time in parts
    ]
    ends = zip(values, (path for path, _ in parts), strict=True)
    for (before, path), (after, next_path) in pairwise(ends):
        if not before[-1] < after[0]:
            passed = f"{after[0]:g} in {next_path} after {before[-1]:g} in {path}"
            raise InputError(
                f"{source}: times do not increase in the order of the file names: {passed}"
            )
    joined = np.concatenate(values)
    _check_exact(source, parts, joined)
    return Coordinate(name=first.name, values=joined, attributes=first.attributes)


def _check_exact(source: str, parts: Parts, joined: npt.NDArray[np.float64]) -> None:
    """Raise InputError where counting in other units moved a time by more than LOSS of a step."""
    first_path, first = parts[0]
    common = clock(first.attributes)
    if common is None or all(_units(time) == _units(first) for _, time in parts):
        return
    if not np.isfinite(joined).all():
        raise InputError(f"{source}: the times in {first_path} are not all finite")
    exact = []
    for _, time in parts:
        own = clock(time.attributes)
        assert own is not None
        exact += [own.instant(float(value)) for value in time.values]
    gap = min(abs(after - before) for before, after in pairwise(exact) if before != after)
    for value, instant in zip(joined, exact, strict=True):
        if abs(common.instant(float(value)) - instant) > LOSS * gap:
            raise InputError(
                f"{source}: the times lie too close to be counted in the units of {first_path}"
                f" ({first.attributes.get('units')}) without loss"
            )


def _converted(
    source: str, path: Path, time: Coordinate, first_path: Path, first: Coordinate
) -> npt.NDArray[np.float64]:
    """Times of a file in the units of the first, each rounded once."""
    own, common = clock(time.attributes), clock(first.attributes)
    if own is None or common is None or own.calendar != common.calendar:
        here, there = (" ".join(_units(each)).strip() or "none" for each in (time, first))
        raise InputError(
            f"{source}: the time in {path} has not the units of the time in {first_path}:"
            f" {here} and {there}"
        )
    if not np.isfinite(time.values).all():
        raise InputError(f"{source}: the times in {path} are not all finite")
    return np.array([common.value(own.instant(float(value))) for value in time.values])


def _units(time: Coordinate) -> tuple[str, str]:
    """Units and calendar of a time; a calendar has a meaning beside a date only."""
    units = str(time.attributes.get("units", "")).strip()
    calendar = str(time.attributes.get("calendar") or "standard").strip().lower()
    return units, CALENDARS.get(calendar, calendar) if SINCE.fullmatch(units) else ""
