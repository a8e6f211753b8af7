"""Rules of which series belong together: one quantity on one grid, and times that go on.

Files of a pattern, `append`, `Writer`, and parts of a series ask here. What one of two does not say
is no difference: it is taken to be what the other says.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.series import AXES, UNNAMED, Coordinate, Series, SourceMetadata
from fhash_formats.support.dates import (
    CALENDARS,
    DAY,
    FIRST_GREGORIAN,
    SINCE,
    UNITS,
    Clock,
    clock,
)

ROUNDING = float(np.finfo(np.float32).eps)
"""Difference of two positions as a share of the larger one, as float32 rounds them."""
SHARE_OF_STEP = 0.1
"""Difference of two positions as a share of their distance from the next ones, at most: far from 0,
the rounding of float32 alone would take the next grid for the same."""
LOSS = Fraction(1, 10**6)
"""Largest change of a time that is counted anew, as a share of the distance of two times."""
OWN_FILE = "or encode it as a file of its own"

Coords = Mapping[str, Coordinate]
Parts = Sequence[tuple[Path, Coordinate]]


@dataclass(frozen=True, kw_only=True)
class Labels:
    """The labels that tell a series from others.

    Attributes:
        source: its path, for messages.
        name: of the variable, "" where the source does not name it.
        group: that the variable is in, "" where that says nothing.
        numbers: those in the name of its file: a variable may be numbered as its file is.
        units, attributes: of the values.
        shape: (z, y, x) of a frame.
        dtypes: number types of the frames, and of the source.
        coords: of t, z, y and x, as far as they are known.
        given: the axes whose positions the source gives.
    """

    source: str
    name: str = ""
    group: str = ""
    numbers: Collection[int] = ()
    units: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    shape: Sequence[int] = ()
    dtypes: Sequence[str] = ()
    coords: Coords = field(default_factory=dict)
    given: Collection[str] = AXES[1:]

    @classmethod
    def of(cls, series: Series) -> Labels:
        """The labels of a series."""
        stored = (series.source_dtype or series.dtype).newbyteorder("=")
        files = " ".join(path.name for path in series.files)
        return cls(
            source=series.source,
            name=series.name if series.named else "",
            group=series.group,
            numbers={int(digits) for digits in re.findall(r"[0-9]+", files)},
            units=series.units,
            attributes=series.attributes,
            shape=tuple(series.shape[1:]),
            dtypes=(str(series.dtype), str(stored)),
            coords=series.coords,
            given=series.given,
        )

    @classmethod
    def of_file(cls, path: object, header: Mapping[str, Any], coords: Coords) -> Labels:
        """The labels of a container; positions that are counted from 0 and say no more are not
        given."""
        variable = header["variable"]
        return cls(
            source=str(path),
            name="" if variable["name"] == UNNAMED else variable["name"],
            units=variable["units"],
            attributes=variable["attributes"],
            shape=tuple(header["domain"]["shape"][1:]),
            dtypes=(variable["dtype"],),
            coords=coords,
            given={axis for axis, each in coords.items() if each.attributes or not is_index(each)},
        )


def is_index(coordinate: Coordinate) -> bool:
    """Whether positions are those of an axis without any: counted from 0."""
    return np.array_equal(coordinate.values, np.arange(coordinate.values.size))


def require_alike(one: Labels, other: Labels) -> None:
    """Raise InputError, which says what differs, unless a series is more of what another one is.

    one: the series that is added; positions that it does not give are those of the other. Times are
    compared by `counted_times`.
    """
    for what, (here, there), advice in _differences(one, other):
        raise InputError(
            f"{one.source} has {what} {here}, {other.source} {there}: they are not one series;"
            f" {advice}"
        )


Difference = tuple[str, tuple[str, ...], str]
"""A difference: its subject, how it is in the one and in the other series, and what to do."""


def _differences(one: Labels, other: Labels) -> Iterator[Difference]:
    """Yield what differs, the quantity first."""
    yield from _quantities(one, other)
    if not same_units(one.units, other.units):
        yield "the unit", (one.units, other.units), "convert one of them"
    if tuple(one.shape) != tuple(other.shape):
        shapes = tuple(str(tuple(each.shape)) for each in (one, other))
        yield "a frame (z, y, x) of shape", shapes, f"select the same region, {OWN_FILE}"
    for here, there in zip(one.dtypes, other.dtypes, strict=False):
        if here != there:
            yield "values of type", (here, there), f"convert one of them, {OWN_FILE}"
    for axis in AXES[1:]:
        if axis in one.given:
            yield from _axes(axis, one.coords[axis], other.coords[axis])


def _quantities(one: Labels, other: Labels) -> Iterator[Difference]:
    """Yield how the quantities differ: by standard_name, by name, else by long_name."""
    keys = ["standard_name"]
    if not (one.name and other.name and one.name == other.name):
        keys.append("long_name")
    advice = f"--var chooses the variable, {OWN_FILE}"
    if one.name and other.name and not _same_name(one, other):
        names = (f"{each.group}/{each.name}".lstrip("/") for each in (one, other))
        yield "the variable", tuple(map(repr, names)), advice
    for key in keys:
        here, there = (_text(each.attributes.get(key)) for each in (one, other))
        if here and there:
            if here != there:
                yield f"the {key}", (repr(here), repr(there)), advice
            return


def _same_name(one: Labels, other: Labels) -> bool:
    """Whether two names are one, but for numbers that they have from their files: frame_01."""
    groups = [re.sub(r"[0-9]+", "0", each.group) for each in (one, other)]
    if all(groups) and groups[0] != groups[1]:
        return False
    if one.name == other.name:
        return True
    bare = [re.sub(r"[_\-. ]*[0-9]+$", "", each.name) for each in (one, other)]
    number = re.search(r"[0-9]+$", one.name)
    return bare[0] == bare[1] and number is not None and int(number[0]) in one.numbers


def _axes(axis: str, one: Coordinate, other: Coordinate) -> Iterator[Difference]:
    """Yield how the positions along an axis differ."""
    for key in ("standard_name", "positive"):
        here, there = (_text(each.attributes.get(key)) for each in (one, other))
        if here and there and here.lower() != there.lower():
            yield f"along {axis} the {key}", (here, there), f"convert one of them, {OWN_FILE}"
    here, there = (_text(each.attributes.get("units")) for each in (one, other))
    if not same_units(here, there):
        yield f"positions along {axis} in", (here, there), "convert one of them"
    if not same_positions(one.values, other.values):
        ends = tuple(f"{each.values[0]:.9g} to {each.values[-1]:.9g}" for each in (one, other))
        told = f"select the same region, turn the axis, {OWN_FILE}"
        yield f"positions along {axis}:", ends, told


def same_positions(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> bool:
    """Whether positions are the same, but for their rounding to float32."""
    if one.shape != other.shape:
        return False
    with np.errstate(over="ignore", invalid="ignore"):  # of a damaged file
        allowed = ROUNDING * np.maximum(np.abs(one), np.abs(other))
        if other.size > 1:
            allowed = np.minimum(allowed, SHARE_OF_STEP * np.abs(np.diff(other)).min())
        return bool(np.array_equal(one, other) or (np.abs(one - other) <= allowed).all())


def require_same_grid(
    one: SourceMetadata | None, other: SourceMetadata | None, sources: tuple[str, str]
) -> None:
    """Raise InputError unless two sources lie in one map: grid mapping, latitudes, longitudes.

    sources: their paths, for messages. What one of them does not say is no difference.
    """
    if one is None or other is None:
        return
    here, there = _mapping(one), _mapping(other)
    both = [key for key in here if key in there and key not in UNCERTAIN]
    told = [f"{key} of the grid mapping" for key in both if not _same_value(here[key], there[key])]
    for array in one.variables:
        known = other.named(array.name)
        if known is None or not (_is_place(array, one) and _is_place(known, other)):
            continue
        if not same_places(array.values, known.values):
            told.append(f"positions {array.name}")
    if told:
        raise InputError(
            f"{sources[0]} has another {told[0]} than {sources[1]}: they are not one series; bring"
            f" both to one grid, {OWN_FILE}"
        )


UNCERTAIN = frozenset(["long_name", "comment", "crs_wkt", "spatial_ref", "GeoTransform"])
"""Attributes of a grid mapping that programs write in many ways for one."""


def _mapping(metadata: SourceMetadata) -> Mapping[str, Any]:
    """The attributes of the grid mapping."""
    words = str(metadata.variable_attributes.get("grid_mapping", "")).split()
    found = metadata.named(words[0].rstrip(":")) if words else None
    return {} if found is None else found.attributes


def _is_place(array: Any, metadata: SourceMetadata) -> bool:
    """Whether an array beside the data has a position for each vertex of a plane, at all steps."""
    axes = [metadata.dimensions.get(name) for name in array.dimensions]
    space = len(axes) > 1 and all(axis in AXES[1:] for axis in axes)
    return space and array.is_coordinate and array.values.dtype.kind in "iuf"


def same_places(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> bool:
    """Whether positions of vertices are the same, but for their rounding to float32."""
    if one.shape != other.shape:
        return False
    a, b = one.astype(np.float64), other.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.allclose(a, b, rtol=2 * ROUNDING, atol=0, equal_nan=True))


def _same_value(one: Any, other: Any) -> bool:
    """Whether two attributes are the same: texts, or numbers but for their rounding."""
    if isinstance(one, str | bytes) or isinstance(other, str | bytes):
        return _text(one) == _text(other)
    a, b = np.atleast_1d(one), np.atleast_1d(other)
    if a.dtype.kind in "iufb" and b.dtype.kind in "iufb":
        return same_places(a, b)
    return bool(a.shape == b.shape and (a == b).all())


def _text(value: Any) -> str:
    """An attribute as text without spaces around it; "" for none."""
    if value is None:
        return ""
    return (value.decode("latin-1") if isinstance(value, bytes) else str(value)).strip()


UNIT_WORDS = """m metre metres meter meters|s sec second seconds|K kelvin kelvins degK deg_K
kg kilogram kilograms|g gram grams|Pa pascal pascals|J joule joules|W watt watts|N newton newtons
V volt volts|rad radian radians|km kilometre kilometres kilometer kilometers
hPa hectopascal hectopascals mbar millibar millibars|% percent
min minute minutes mins|h hour hours hr hrs|d day days
degC celsius Celsius degrees_C degree_C degreeC degree_Celsius degrees_Celsius deg_C °C
degree degrees deg °|degrees_north degree_north degrees_N degree_N degreesN degreeN
degrees_east degree_east degrees_E degree_E degreesE degreeE"""
UNIT_NAMES = {
    word: words.split()[0] for words in re.split(r"[|\n]", UNIT_WORDS) for word in words.split()
}
"""One name of each unit that is written in several ways (CF and UDUNITS)."""
SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
FACTOR = re.compile(
    r"(?P<name>[A-Za-zµμ°Ω%_]+)((\^|\*\*)?(?P<power>[+-]?[0-9]{1,3}))?"
    r"|(?P<number>[0-9]{1,9}(\.[0-9]{1,9})?)"
)
BETWEEN = re.compile(r"\s*(/|\*(?!\*)|·|\.|(?<=\s)|$)\s*")


def same_units(one: str, other: str) -> bool:
    """Whether two units mean the same, as far as their form tells: "m s-1" and "m/s".

    True where one is not known.
    """
    return not one or not other or _unit_form(one) == _unit_form(other)


def _unit_form(text: str) -> Any:
    """The form of a unit that all ways to write it have; the text where it is no product."""
    powers: Counter[str] = Counter()
    factor, inverse, place = Fraction(1), 1, 0
    plain = " ".join(text.split())
    words = plain.translate(SUPERSCRIPTS).replace(" per ", "/")
    while place < len(words):
        match = FACTOR.match(words, place)
        if match is None:
            return plain
        if match["number"] is not None:
            number = Fraction(match["number"])
            if not number:
                return plain
            factor *= number**inverse
        else:
            name = UNIT_NAMES.get(match["name"], match["name"])
            powers[name] += inverse * int(match["power"] or 1)
        between = BETWEEN.match(words, match.end())
        if between is None:
            return plain
        inverse = -1 if between[1] == "/" else 1
        place = between.end()
    return factor, frozenset((name, power) for name, power in powers.items() if power)


def counted_times(source: str, parts: Parts) -> list[npt.NDArray[np.float64]]:
    """The times of each file, counted as in the first, each rounded once.

    Files may count since different dates and in different units, in one calendar. Raises InputError
    for times that cannot be compared, or that float64 cannot hold as counted in the first file.
    """
    first_path, first = parts[0]
    common, counted = _clock(first.attributes), []
    for path, time in parts:
        if _units(time) == _units(first):
            counted.append(time.values)
            continue
        own = _clock(time.attributes)
        if own is None or common is None or not _one_calendar(own, time, common, first):
            here, there = (" ".join(_units(each)).strip() or "none" for each in (time, first))
            raise InputError(
                f"{source}: the time in {path} has not the units of the time in {first_path}:"
                f" {here} and {there}; convert one of them, {OWN_FILE}"
            )
        if not np.isfinite(time.values).all():
            raise InputError(f"{source}: the times in {path} are not all finite")
        values = [common.value(own.instant(float(value))) for value in time.values]
        counted.append(np.array(values))
    _check_exact(source, parts, counted)
    return counted


def _clock(attributes: Mapping[str, Any]) -> Clock | None:
    """The clock of a time, also of one that counts since no date; None for other units."""
    unit = UNITS.get(_text(attributes.get("units")))
    return clock(attributes) or (
        None if unit is None else Clock(unit=unit, epoch=0, calendar="since no date")
    )


def _one_calendar(one: Clock, time: Coordinate, other: Clock, first: Coordinate) -> bool:
    """Whether two calendars give the same dates: one calendar, or those of the world after 1582."""
    if one.calendar == other.calendar:
        return True
    if {one.calendar, other.calendar} != {"standard", "proleptic_gregorian"}:
        return False
    ends = (each.instant(float(at.values.min())) for each, at in ((one, time), (other, first)))
    return all(np.isfinite(each.values).all() for each in (time, first)) and all(
        end >= FIRST_GREGORIAN * DAY for end in ends
    )


def join_times(source: str, parts: Parts) -> Coordinate:
    """The times of files one after the other, counted as in the first; see `counted_times`.

    Raises InputError for times that do not increase, or that float64 cannot hold as counted in the
    first file.
    """
    first = parts[0][1]
    values = counted_times(source, parts)
    ends = zip(values, (path for path, _ in parts), strict=True)
    for (before, path), (after, next_path) in pairwise(ends):
        if not before[-1] < after[0]:
            passed = f"{after[0]:g} in {next_path} after {before[-1]:g} in {path}"
            advice = "; --overlap first or last says which counts" if before[0] < after[-1] else ""
            raise InputError(
                f"{source}: times do not increase in the order of the file names: {passed}{advice}"
            )
    joined = np.concatenate(values)
    return Coordinate(name=first.name, values=joined, attributes=first.attributes)


def _check_exact(source: str, parts: Parts, counted: Sequence[npt.NDArray[np.float64]]) -> None:
    """Raise InputError where counting in other units moved a time by more than LOSS of a step."""
    first_path, first = parts[0]
    common = _clock(first.attributes)
    if common is None or all(_units(time) == _units(first) for _, time in parts):
        return
    if not np.isfinite(first.values).all():
        raise InputError(f"{source}: the times in {first_path} are not all finite")
    exact = []
    for _, time in parts:
        own = _clock(time.attributes)
        assert own is not None
        exact += [own.instant(float(value)) for value in time.values]
    gaps = (abs(after - before) for before, after in pairwise(exact) if before != after)
    gap = min(gaps, default=Fraction(0))
    for value, instant in zip(np.concatenate(counted), exact, strict=True):
        if abs(common.instant(float(value)) - instant) > LOSS * gap:
            raise InputError(
                f"{source}: the times lie too close to be counted in the units of {first_path}"
                f" ({first.attributes.get('units')}) without loss"
            )


def _units(time: Coordinate) -> tuple[str, str]:
    """Units and calendar of a time; a calendar has a meaning beside a date only."""
    units = str(time.attributes.get("units", "")).strip()
    calendar = str(time.attributes.get("calendar") or "standard").strip().lower()
    return units, CALENDARS.get(calendar, calendar) if SINCE.fullmatch(units) else ""
