"""Times of series: which coordinate counts them, what people read there, and those of many files.

The real time among the coordinates of a dimension comes before numbers of steps. Dates that are
written as texts are counted, and months are counted anew in days. Where a time is missing, the
numbers of the steps stand for all: every reader, label and export then gives one answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf_packing import packing
from fhash_formats.readers.common.roles import NAMES, role_of_coordinate
from fhash_formats.series import Coordinate
from fhash_formats.source_metadata import SourceMetadata, SourceVariable
from fhash_formats.support.attributes import text_of
from fhash_formats.support.dates import (
    CALENDARS,
    MONTH_UNITS,
    SINCE,
    UNITS,
    clock,
    in_days,
    of_texts,
)

STANDARD_NAMES = ("time", "forecast_period", "forecast_reference_time")
"""Standard names of CF for coordinates that count time."""


MAX_LETTERS = 64
"""Letters of a date."""

NUMBERED = "step numbers stand for the times"

LOSS = Fraction(1, 10**6)
"""Largest change of a time that is counted anew, as a share of the distance of two times."""

Parts = Sequence[tuple[Path, Coordinate]]


class Described(Protocol):
    """A stored array that may be a coordinate: its full name, attributes and values."""

    @property
    def name(self) -> str:
        """Full name."""

    @property
    def attributes(self) -> Mapping[str, Any]:
        """Attributes as the library gives them."""

    @property
    def read(self) -> Callable[[], npt.NDArray[Any]]:
        """Function that reads the values."""


Kind = TypeVar("Kind", bound=Described)


def is_time(name: str, attributes: Mapping[str, Any], dtype: np.dtype[Any]) -> bool:
    """Whether a coordinate counts time, and not only steps: by its type, units or names."""
    units = str(attributes.get("units", "")).strip()
    if dtype.kind == "M" or SINCE.fullmatch(units) or units.lower() in UNITS:
        return True
    return str(attributes.get("standard_name", "")).strip().lower() in STANDARD_NAMES


def counts_steps(values: npt.NDArray[Any]) -> bool:
    """Whether values are whole numbers that rise by 1 from 0 or 1: numbers of steps."""
    if values.dtype.kind not in "iuf" or not values.size:
        return False
    numbers = values.ravel()
    return bool(
        numbers[0] in (0, 1) and np.array_equal(numbers, numbers[0] + np.arange(numbers.size))
    )


def only_counts(column: Described) -> bool:
    """Whether a coordinate of time only counts the steps."""
    return not is_time(*_description(column)) and counts_steps(column.read())


def real_time(named: Kind | None, others: Iterable[Kind]) -> Kind | None:
    """The coordinate of the time dimension: its namesake, unless that only counts its steps.

    Args:
        named: the coordinate with the name of the dimension, None without one.
        others: further coordinates along the dimension. One that counts time comes before numbers
            of steps and before none: dates first, then other units of time, then a name of time.
    """
    if named is not None and is_time(*_description(named)):
        return named
    if named is not None and not counts_steps(named.read()):
        return named
    ranked = [(_rank(column), number, column) for number, column in enumerate(others)]
    found = sorted((each for each in ranked if each[0] is not None), key=lambda each: each[:2])
    return found[0][2] if found else named


def _rank(column: Described) -> int | None:
    """Place among coordinates of time, the first is best; None for one that is no time."""
    name, attributes, dtype = _description(column)
    if dtype.kind == "M" or SINCE.fullmatch(str(attributes.get("units", ""))):
        # the start of a forecast is the same for all of its steps
        return 3 if attributes.get("standard_name") == "forecast_reference_time" else 0
    known = name.lower() in NAMES["t"].split() or role_of_coordinate(name, attributes) == "t"
    if is_time(name, attributes, dtype):
        return 1 if known else None
    return 2 if known and not counts_steps(column.read()) else None


def _description(column: Described) -> tuple[str, Mapping[str, Any], np.dtype[Any]]:
    return column.name.rpartition("/")[2], column.attributes, column.read().dtype


def settled(coordinate: Coordinate) -> tuple[Coordinate, str]:
    """The times that stand for those of a file, and what is to be said of it, "" where nothing is.

    Months, years and weeks are counted anew in days. Where a time is missing, the numbers of the
    steps stand for all. Units that name no date are no `units` any more, since programs that decode
    CF refuse them; the numbers stay.
    """
    name, attributes = coordinate.name, coordinate.attributes
    missing = np.flatnonzero(~np.isfinite(coordinate.values))
    if missing.size:
        steps = np.arange(coordinate.values.size, dtype=np.float64)
        told = f"{name} has no time at step {missing[0]}; {NUMBERED}"
        return Coordinate(name=name, values=steps), told
    if _decodable(attributes):
        return coordinate, ""
    units = attributes.get("units")
    found = in_days(coordinate.values.tolist(), attributes)
    if found is None:
        told = f"{name} counts '{units}', which names no date; its numbers stand for the times"
        return replace(coordinate, attributes=_undated(attributes)), told
    how = "calendar months" if _unit(attributes) in MONTH_UNITS else "days"
    told = f"{name} counts '{units}'; it is read as {how}, and given in {found[1]['units']}"
    values = np.array(found[0], np.float64)
    return replace(coordinate, values=values, attributes={**attributes, **found[1]}), told


def is_numbered(remark: str) -> bool:
    """Whether the numbers of steps stand for times of which something is said."""
    return remark.endswith(NUMBERED)


def with_times(metadata: SourceMetadata, time: Coordinate) -> SourceMetadata:
    """The metadata of a variable whose times stand for those of its source; see `settled`.

    The coordinate of the time dimension is then that of the times, and what the source had under
    this name is kept as it was, under another.
    """
    dimension = metadata.along("t")
    variables = []
    for each in metadata.variables:
        told = time.name == each.name or dimension in each.dimensions
        if told and not _decodable(each.attributes):
            each = replace(each, attributes=_undated(each.attributes))
        if each.name == dimension and _is_replaced(metadata.named(each.name)):
            name = f"{each.name}_in_source"
            while metadata.named(name) is not None:
                name += "_"
            each = replace(each, name=name)
        variables.append(each)
    if dimension == time.name and dimension not in [each.name for each in variables]:
        stamp = SourceVariable(
            name=dimension,
            dimensions=(dimension,),
            values=time.values,
            attributes=dict(time.attributes),
            is_coordinate=True,
        )
        variables.insert(0, stamp)
    return replace(metadata, variables=tuple(variables))


def written_times(
    dimension: str, columns: Iterable[tuple[str, npt.NDArray[Any], Mapping[str, Any]]]
) -> Coordinate | None:
    """The times that a column of texts along a dimension gives, None without such a column.

    columns: name, texts (n,) and attributes of each.
    """
    for _, texts, attributes in columns:
        calendar = str(attributes.get("calendar") or "proleptic_gregorian").strip().lower()
        if calendar in CALENDARS:
            known = CALENDARS[calendar]
            found = of_texts([text_of(each) for each in texts.reshape(-1).tolist()], known)
            if found is not None:
                values = np.array(found[0], np.float64)
                named = {"standard_name": "time", **found[1]}
                return Coordinate(name=dimension, values=values, attributes=named)
    return None


def _unit(attributes: Mapping[str, Any]) -> str:
    match = SINCE.fullmatch(str(attributes.get("units", "")))
    return match[1].lower() if match else ""


def _decodable(attributes: Mapping[str, Any]) -> bool:
    """Whether programs that decode CF make dates of a coordinate, or take it as numbers."""
    unit, known = _unit(attributes), clock(attributes) is not None
    calendar = str(attributes.get("calendar") or "standard").strip().lower()
    return known == bool(unit) and not unit.startswith("week") and calendar != "360"


def _undated(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes without units and calendar, which have other names."""
    return {
        f"{key}_in_source" if key in ("units", "calendar") else key: value
        for key, value in attributes.items()
    }


def _is_replaced(variable: SourceVariable | None) -> bool:
    """Whether others stand for the times of a stored variable."""
    if variable is None or variable.values.dtype.kind not in "iuf":
        return variable is not None
    attributes = variable.attributes
    values = packing("", variable.values.dtype, attributes).unpack(variable.values.copy())
    if not np.isfinite(values).all():
        return True
    return not _decodable(attributes) and in_days(values.tolist(), attributes) is not None


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
