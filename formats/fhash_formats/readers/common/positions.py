"""Coordinates beside an array: found by name, kept as float64 without loss."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.roles import NAMES
from fhash_formats.readers.common.times import real_time
from fhash_formats.series import AXES, Coordinate
from fhash_formats.support.attributes import STORED, json_attributes

TIME_UNITS = {
    "D": "days",
    "h": "hours",
    "m": "minutes",
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
}


@dataclass(frozen=True, kw_only=True)
class Column:
    """A stored 1-D array (or scalar, length 1) that may be a coordinate.

    `read` gives its values, `along` is the name of its dimension. A column that is not `numeric`
    holds labels, such as the names of members.
    """

    name: str
    length: int
    along: str | None = None
    read: Callable[[], npt.NDArray[Any]]
    attributes: Mapping[str, Any]
    numeric: bool = True


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
        # since the first date, and not since 1970: nanoseconds since then exceed what float64 can
        # hold
        extra = {
            "units": f"{TIME_UNITS[unit]} since {stored[0]}",
            "calendar": "proleptic_gregorian",
        }
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
            column = columns[0]
            assumed = (
                f"axis {axis} of length {lengths[axis]}" if axis in lengths else f"no axis {axis}"
            )
            wrong = (
                f"{column.name} has {column.length} values, but read as ({','.join(axes)})"
                f" the array {tuple(shape)} has {assumed}"
            )
            raise InputError(
                f"{source}: {wrong}; say what its dimensions are with --axes, such as t,z,y,x"
            )
    return coords
