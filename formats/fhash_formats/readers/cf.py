"""CF conventions: packed values, names of axes, times, positions."""

from __future__ import annotations

import base64
import math
import re
import struct
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.series import (
    AXES,
    AXIS_NAMES,
    MAX_NAME,
    Coordinate,
    Series,
    SourceMetadata,
    SourceVariable,
)
from fhash_formats.support.dates import (
    CALENDARS,
    MONTH_UNITS,
    SINCE,
    UNITS,
    clock,
    in_days,
    is_numeric_date,
    of_texts,
)
from fhash_formats.support.values import STORED, json_attributes, text_of

SCALING = frozenset(("scale_factor", "add_offset"))
"""Attributes that make stored numbers counts of another unit."""

OTHER_FILLS = frozenset(("fillvalue", "missingvalue", "codemissingvalue", "nodata", "nodatavalue"))
OTHER_SCALES = {"scalefactor": 1, "slope": 1, "scale": 1, "offset": 0, "intercept": 0}
"""Other names of fill values, and of a scale and an offset with what changes nothing, as files of
HDF-EOS, GPM and MODIS have them: in lower case, without "_"."""

AS_STORED = "; --raw-values reads the numbers as they are stored"
"""Advice where attributes make no sense."""


@dataclass(frozen=True, kw_only=True)
class Packing:
    """The packing of an array: its stored type, the type of its values, its fill values, and the
    scale and the offset (None: none)."""

    stored: np.dtype[Any]
    dtype: np.dtype[Any]
    fills: tuple[Any, ...] = ()
    scale: float | None = None
    offset: float | None = None

    @property
    def scaled(self) -> bool:
        """Whether stored numbers are counts of another unit than the values."""
        return self.scale is not None or self.offset is not None

    @property
    def integers(self) -> bool:
        """Whether the values are integers, and only the missing ones made floats of them."""
        return self.stored.kind in "iu" and not self.scaled and self.dtype != self.stored

    def unpack(self, stored: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Physical values of stored ones; the same array where nothing is packed."""
        # the view is for _Unsigned; the array is fresh and may be changed in place
        numbers = stored.astype(stored.dtype.newbyteorder("="), copy=False).view(self.stored)
        missing = [numbers == fill for fill in self.fills]
        values = numbers.astype(self.dtype, copy=False)
        if self.scale is not None:
            values *= self.scale
        if self.offset is not None:
            values += self.offset
        for each in missing:
            values[each] = np.nan
        return values


def packing(
    source: str,
    dtype: np.dtype[Any],
    attributes: Mapping[str, Any],
    fill_value: Any = None,
    *,
    gaps: bool = False,
) -> Packing:
    """The packing that an array's attributes describe.

    attributes: JSON values, or as h5py gives them. fill_value: a further fill value, from zarr's
    own metadata. gaps: whether values may be missing for which no number stands. Raises InputError
    for an attribute that is not a number.
    """
    stored = dtype.newbyteorder("=")
    told = text_of(_single(attributes.get("_Unsigned", ""))).lower()
    signs = {"true": "iu", "false": "ui"}.get(told, "--")
    other = stored.kind == signs[0]
    if other:
        stored = np.dtype(f"{signs[1]}{stored.itemsize}")
    values: list[Any] = []
    for value in (fill_value, attributes.get("_FillValue"), attributes.get("missing_value")):
        values += value if isinstance(value, list | tuple | np.ndarray) else [value]
    for name in attributes:
        if _bare(name) in OTHER_FILLS and name not in ("_FillValue", "missing_value"):
            listed = np.ravel(attributes[name])[:MAX_FILLS].tolist()
            numbers = [number_of_text(text_of(each)) for each in listed]
            values += [each for each in numbers if each is not None and each == each]
    unsigned = other and stored.kind == "i"
    fills = [_fill(source, each, stored, unsigned=unsigned) for each in values if each is not None]
    scale, offset = (_single(attributes.get(name)) for name in ("scale_factor", "add_offset"))
    return _packing(
        stored,
        fills,
        _number(source, "scale_factor", scale),
        _number(source, "add_offset", offset),
        _scaled_type(stored, scale, offset),
        gaps=gaps,
    )


MAX_FILLS = 16
"""Fill values of one attribute."""


def _bare(name: str) -> str:
    """The name of an attribute in lower case without "_"."""
    return name.replace("_", "").lower()


def unapplied(attributes: Mapping[str, Any]) -> str:
    """Attributes that may scale the values, and follow no convention; "" without any."""
    found = []
    for name in attributes:
        value = _single(attributes[name])
        known = _bare(name) in OTHER_SCALES and name not in SCALING
        number = isinstance(value, int | float | np.integer | np.floating)
        if known and number and value != OTHER_SCALES[_bare(name)]:
            found.append(f"{name} = {value:.9g}")
    return ", ".join(found)


def valid_limits(packed: Packing, attributes: Mapping[str, Any]) -> tuple[Any, Any] | None:
    """The least and the greatest valid value in the units of unpacked ones; None without any.

    CF 1.11, section 2.5.1: they count packed numbers, unless they are floats and those are not.
    Attributes that are no numbers say nothing.
    """
    told = np.ravel(attributes.get("valid_range", ()))
    given = told if told.size == 2 else [attributes.get(f"valid_{end}") for end in ("min", "max")]
    ends: list[Any] = [-math.inf, math.inf]
    for place, each in enumerate(map(_single, given)):
        if not isinstance(each, int | float | np.integer | np.floating) or each != each:
            continue
        integers, whole = packed.stored.kind in "iu", isinstance(each, int | np.integer)
        if packed.scaled and (whole or not integers):
            limits = np.iinfo(packed.stored) if integers else None
            if limits is not None:  # those of _Unsigned numbers may be written signed
                each = int(each) % (1 << limits.bits) if limits.min == 0 else int(each)
                each = min(max(each, int(limits.min)), int(limits.max))
            stored = np.array([each], packed.stored)
            each = replace(packed, fills=()).unpack(stored)[0]
        elif integers and whole and packed.stored.kind == "u" and each < 0:
            each = int(each) + (1 << 8 * packed.stored.itemsize)
        ends[place] = each.item() if isinstance(each, np.generic) else each
    if ends == [-math.inf, math.inf]:
        return None
    turned = packed.scaled and (1.0 if packed.scale is None else packed.scale) < 0
    low, high = ends[::-1] if turned and told.size == 2 else ends
    return (low, high)


def note_packing(series: Series, packed: Packing) -> None:
    """Tell a series what stood for missing values in its source, and its integer type there."""
    if packed.fills and not packed.scaled and series.fill is None:
        series.fill = packed.fills[0].item()
    if packed.scaled and packed.stored.kind == "i" and packed.stored.itemsize > 1:
        lowest = np.iinfo(packed.stored).min + np.arange(3, dtype=packed.stored)
        series.unlikely = frozenset(packed.unpack(lowest).tolist())
    if packed.integers:
        series.source_dtype = packed.stored


def missing_values(source: str, dtype: np.dtype[Any], values: Sequence[float]) -> Packing:
    """The packing of an array in which some numbers stand for missing values, and nothing else.

    values: they occur nowhere if the type cannot hold them.
    """
    stored = dtype.newbyteorder("=")
    return _packing(stored, [_fill(source, value, stored) for value in values])


def _packing(
    stored: np.dtype[Any],
    fills: Sequence[Any],
    scale: float | None = None,
    offset: float | None = None,
    scaled: np.dtype[Any] | None = None,
    *,
    gaps: bool = False,
) -> Packing:
    """A packing without fills that are nowhere (None), or mark themselves (NaN)."""
    kept = tuple(fill for fill in fills if fill is not None and fill == fill)
    dtype = stored
    if scaled is not None and (scale is not None or offset is not None):
        dtype = scaled
    elif (kept or gaps) and stored.kind in "iu":
        dtype = np.dtype(np.float32 if stored.itemsize <= 2 else np.float64)
    return Packing(stored=stored, dtype=dtype, fills=kept, scale=scale, offset=offset)


def _scaled_type(stored: np.dtype[Any], scale: Any, offset: Any) -> np.dtype[Any]:
    """The type of scaled values, chosen as xarray does.

    An offset alone, or of another type than the scale, is not CF and needs float64; so do integers
    of 32 bits with both.
    """
    wide = offset is not None and stored.kind in "iu" and stored.itemsize == 4
    if not isinstance(scale, np.floating) or scale.dtype.itemsize > 8 or wide:
        return np.dtype(np.float64)
    alike = offset is None or type(offset) is type(scale)
    return scale.dtype if alike else np.dtype(np.float64)


def _single(value: Any) -> Any:
    """The only element of an attribute that is an array or list of one; else the attribute."""
    if isinstance(value, np.ndarray):
        return value.reshape(-1)[0] if value.size == 1 else value
    return value[0] if isinstance(value, list | tuple) and len(value) == 1 else value


def number_of_text(text: str) -> float | None:
    """A fill value that is stored as text; None where it is no number.

    xarray writes the fill value of a float array of zarr format 3 as base64 of a little-endian
    float64; others write a number or "NaN".
    """
    with suppress(ValueError):
        return float(text)
    with suppress(ValueError, struct.error):
        return float(struct.unpack("<d", base64.standard_b64decode(text))[0])
    return None


def _fill(source: str, value: Any, stored: np.dtype[Any], *, unsigned: bool = False) -> Any:
    """A fill value in the stored type; None if that type cannot hold it, so that it never occurs.

    unsigned: whether the value was written for unsigned numbers that are read as signed.
    """
    if isinstance(value, str | bytes):
        value = text_of(value)
        number = number_of_text(value)
        value = value if number is None else number
    if not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"{source}: the fill value {value!r} is not a number{AS_STORED}")
    if stored.kind == "f":
        with np.errstate(over="ignore"):
            return stored.type(value)
    if not math.isfinite(value) or value != int(value):
        return None
    integer, limits = int(value), np.iinfo(stored)
    if integer < 0 and stored.kind == "u":  # that of an _Unsigned array is written signed
        integer += 1 << limits.bits
    if unsigned and integer > limits.max:
        integer -= 1 << limits.bits
    return stored.type(integer) if limits.min <= integer <= limits.max else None


def _number(source: str, name: str, value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"{source}: {name} is {value!r}, not a number{AS_STORED}")
    return float(value)


NAMES = {
    "t": "time t times time_counter valid_time leadtime lead_time forecast_period forecast_time"
    " date timestep timesteps time_step step steps record records frame frames",
    "z": "z lev level levels height depth altitude alt plev pressure pressure_level isobaric"
    " model_level_number bottom_top zc x3v x3 k",
    "y": "y lat latitude rlat grid_latitude projection_y_coordinate south_north nlat yc x2v x2 j",
    "x": "x lon longitude rlon grid_longitude projection_x_coordinate west_east nlon xc x1v x1 i",
}
"""Conventional names of coordinates, the most usual first; those of times before those of steps.

x1v, x2v, x3v are Athena++'s, bottom_top and the like WRF's.
"""

ROLE_OF_NAME = {name: axis for axis, names in NAMES.items() for name in names.split()}

AXIS_PATTERNS = {
    "standard_name": {
        "t": r"time|forecast_reference_time|forecast_period",
        "z": r"(atmosphere|ocean)_.*_coordinate|height.*|altitude|depth.*|air_pressure"
        r"|model_level_number|.*_sigma_.*",
        "y": r"(grid_)?latitude|projection_y_(angular_)?coordinate",
        "x": r"(grid_)?longitude|projection_x_(angular_)?coordinate",
    },
    "units": {
        "t": r"\S+ since \S.*",
        "z": r"(pascal|pa|hpa|kpa|bar|millibar|mbar|mb|dbar|decibar|atm|layer|level|sigma_level)s?",
        "y": r"degrees?_?n(orth)?",
        "x": r"degrees?_?e(ast)?",
    },
}


def role_of_name(name: str) -> str | None:
    """The axis of a conventional name in any case, or with a trailing number: "time_0"; or None."""
    word = name[:MAX_NAME].lower()
    return ROLE_OF_NAME.get(word) or ROLE_OF_NAME.get(re.sub(r"(?<=..)_?\d+$", "", word))


def role_of_coordinate(name: str, attributes: Mapping[str, Any]) -> str | None:
    """The axis of a coordinate by CF, else by its name, or None.

    CF 1.11, section 4: axis, standard_name, units, positive.
    """
    axis = str(attributes.get("axis", "")).lower()
    if axis in AXES:
        return axis
    if is_numeric_date(str(attributes.get("units", ""))):
        return "t"
    for key, patterns in AXIS_PATTERNS.items():
        text = str(attributes.get(key, "")).strip().lower()
        for role, pattern in patterns.items():
            if re.fullmatch(pattern, text):
                return role
    if str(attributes.get("positive", "")).lower() in ("up", "down"):
        return "z"
    return role_of_name(name)


NUMBERED = "step numbers stand for the times"


@dataclass(frozen=True, kw_only=True)
class Column:
    """A stored 1-D array (or scalar, length 1) that may be a coordinate.

    `read` gives its values. A column that is not `numeric` holds labels, such as the names of
    members.
    """

    name: str
    length: int
    read: Callable[[], npt.NDArray[Any]]
    attributes: Mapping[str, Any]
    numeric: bool = True

    @property
    def described(self) -> tuple[str, Mapping[str, Any], np.dtype[Any]]:
        """Its name without groups, its attributes and its type."""
        return self.name.rpartition("/")[2], self.attributes, self.read().dtype


def is_time(name: str, attributes: Mapping[str, Any], dtype: np.dtype[Any]) -> bool:
    """Whether a coordinate counts time, and not only steps: by its type, units or names."""
    units = str(attributes.get("units", "")).strip()
    if dtype.kind == "M" or SINCE.fullmatch(units) or units.lower() in UNITS:
        return True
    if is_numeric_date(units):
        return True
    name = str(attributes.get("standard_name", "")).strip().lower()
    return name in ("time", "forecast_period", "forecast_reference_time")


def counts_steps(values: npt.NDArray[Any]) -> bool:
    """Whether values are whole numbers that rise by 1 from 0 or 1: numbers of steps."""
    numbers = values.ravel()
    if values.dtype.kind not in "iuf" or not numbers.size or numbers[0] not in (0, 1):
        return False
    return np.array_equal(numbers, numbers[0] + np.arange(numbers.size))


def only_counts(column: Column) -> bool:
    """Whether a coordinate of time only counts the steps."""
    return not is_time(*column.described) and counts_steps(column.read())


def real_time(named: Column | None, others: Iterable[Column]) -> Column | None:
    """The coordinate of the time dimension: its namesake, unless that only counts its steps.

    Args:
        named: the coordinate with the name of the dimension, None without one.
        others: further coordinates along the dimension. One that counts time comes before numbers
            of steps and before none: dates first, then other units of time, then a name of time.
    """
    if named is not None and not only_counts(named):
        return named
    ranked = [(_rank(column), number, column) for number, column in enumerate(others)]
    found = sorted((each for each in ranked if each[0] is not None), key=lambda each: each[:2])
    return found[0][2] if found else named


def _rank(column: Column) -> int | None:
    """Place among coordinates of time, the first is best; None for one that is no time."""
    name, attributes, dtype = column.described
    units = str(attributes.get("units", ""))
    if dtype.kind == "M" or SINCE.fullmatch(units) or is_numeric_date(units):
        # the start of a forecast is the same for all of its steps
        return 3 if attributes.get("standard_name") == "forecast_reference_time" else 0
    known = name.lower() in NAMES["t"].split() or role_of_coordinate(name, attributes) == "t"
    if is_time(name, attributes, dtype):
        return 1 if known else None
    return 2 if known and not counts_steps(column.read()) else None


def settled(coordinate: Coordinate) -> tuple[Coordinate, str]:
    """The times that stand for those of a file, and what is to be said of it, "" where nothing is.

    Months, years, weeks and dates written as numbers are counted anew in days. Where a time is
    missing, the numbers of the steps stand for all. Units that name no date are no `units` any
    more, since programs that decode CF refuse them; the numbers stay.
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


def written_times(dimension: str | None, length: int, arrays: Iterable[Any]) -> Coordinate | None:
    """The times that texts along a dimension, or letters, give; None without such.

    dimension: its name; None for one without, along which arrays with a name of times may lie.
    arrays: Variables.
    """
    for array in arrays:
        if array.shape[:1] != (length,) or array.error:
            continue
        along, name = array.dimensions[0], array.name.rpartition("/")[2].lower()
        texts = len(array.shape) == 1 and array.dtype.kind in "SUTO"
        fits = along == dimension if along is not None else name in NAMES["t"].split()
        calendar = str(array.attributes.get("calendar") or "proleptic_gregorian").strip().lower()
        if (array.is_letters or texts) and fits and calendar in CALENDARS:
            words = [text_of(each) for each in array.texts().reshape(-1).tolist()]
            found = of_texts(words, CALENDARS[calendar])
            if found is not None:
                values = np.array(found[0], np.float64)
                named = {"standard_name": "time", **found[1]}
                return Coordinate(
                    name=dimension or AXIS_NAMES["t"], values=values, attributes=named
                )
    return None


def _unit(attributes: Mapping[str, Any]) -> str:
    match = SINCE.fullmatch(str(attributes.get("units", "")))
    return match[1].lower() if match else ""


def _decodable(attributes: Mapping[str, Any]) -> bool:
    """Whether programs that decode CF make dates of a coordinate, or take it as numbers."""
    unit, known = _unit(attributes), clock(attributes) is not None
    calendar = str(attributes.get("calendar") or "standard").strip().lower()
    anew = unit.startswith(("week", "common_year")) or calendar == "360"
    anew = anew or is_numeric_date(str(attributes.get("units", "")))
    return known == bool(unit) and not anew


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


UNIT_NAMES = "D=days h=hours m=minutes s=seconds ms=milliseconds us=microseconds ns=nanoseconds"
TIME_UNITS = dict(each.split("=") for each in UNIT_NAMES.split())
"""Units of time by numpy's code."""


def coordinate(
    source: str, name: str, values: npt.NDArray[Any], attributes: Mapping[str, Any]
) -> Coordinate:
    """A Coordinate of stored values.

    Numbers stay as they are; dates become numbers since the first of them, with `units` and
    `calendar`. Raises InputError where float64 cannot tell two stored values apart, or where a date
    is missing.
    """
    stored = np.atleast_1d(values)
    extra: dict[str, Any] = {}
    if stored.dtype.kind == "M":
        unit = np.datetime_data(stored.dtype)[0]
        if unit not in TIME_UNITS or np.isnat(stored).any():
            raise InputError(
                f"{source}: coordinate {name} holds dates that cannot be counted ({stored.dtype},"
                " or one is missing)"
            )
        # since the first date, and not since 1970: float64 cannot hold nanoseconds since then
        units = f"{TIME_UNITS[unit]} since {stored[0]}"
        extra = {"units": units, "calendar": "proleptic_gregorian"}
        stored = (stored - stored[0]).astype(np.int64)
    numbers = stored.astype(np.float64)
    if stored.dtype.kind in "iu" and np.unique(numbers).size != np.unique(stored).size:
        raise InputError(
            f"{source}: coordinate {name} has values that 64-bit floats cannot tell apart, from"
            f" {stored[0]} to {stored[-1]}"
        )
    return Coordinate(
        name=name.rsplit("/", 1)[-1],
        values=numbers,
        attributes={**json_attributes(attributes, without=STORED), **extra},
    )


def usable(dtype: np.dtype[Any]) -> bool:
    """Whether values of this type can be positions."""
    return dtype.kind in "iufM" and dtype.itemsize <= 8


def beside(
    source: str,
    axes: Sequence[str],
    shape: Sequence[int],
    places: Sequence[Mapping[str, Column]],
    *,
    certain: bool,
    tied: Collection[str] = (),
) -> dict[str, Coordinate]:
    """Coordinates by conventional name for the axes of an array, from the nearest place first.

    Places are its group, then the root. A column counts only if it has the axis's length; a length
    alone is never taken for a meaning. An axis that the array lacks has length 1. Axes in `tied`
    are skipped: the file itself says what belongs to them.

    If the order of the axes was only assumed (not `certain`) and such a column has the length of
    *another* dimension, the assumption is wrong: raises InputError that asks for --axes.
    """
    lengths = dict(zip(axes, shape, strict=True))
    coords: dict[str, Coordinate] = {}
    for axis in (axis for axis in AXES if axis not in tied):
        columns = [place[name] for place in places for name in NAMES[axis].split() if name in place]
        fitting = [column for column in columns if column.length == lengths.get(axis, 1)]
        if fitting:
            column = real_time(fitting[0], fitting[1:]) if axis == "t" else fitting[0]
            assert column is not None
            coords[axis] = coordinate(source, column.name, column.read(), column.attributes)
        elif columns and not certain and columns[0].length in shape and columns[0].length > 1:
            length = f" of length {lengths[axis]}" if axis in lengths else ""
            raise InputError(
                f"{source}: {columns[0].name} has {columns[0].length} values, but read as"
                f" ({','.join(axes)}) the array {tuple(shape)} has {'' if length else 'no '}axis"
                f" {axis}{length}; say what its dimensions are with --axes, such as t,z,y,x"
            )
    return coords
