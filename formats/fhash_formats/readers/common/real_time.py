"""The real time among the coordinates of one dimension: it comes before numbers of steps."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_formats.readers.common.roles import NAMES, role_of_coordinate
from fhash_formats.support.dates import UNITS

SINCE = re.compile(r"\s*\S+\s+since\s+\S.*", re.IGNORECASE)
"""Units of a time that is counted since a date."""

STANDARD_NAMES = ("time", "forecast_period", "forecast_reference_time")
"""Standard names of CF for coordinates that count time."""


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
