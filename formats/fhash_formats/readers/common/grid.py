"""Even grids as image formats describe them: origin, spacing, components of vectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.variables import Variable
from fhash_formats.series import AXIS_NAMES, Coordinate

LETTERS = ("x", "y", "z")
"""Names of the components of a vector with three of them."""

IDENTITY_TOLERANCE = 1e-9
"""Largest difference from 1 or 0 of a direction that still is that of an axis."""


def lattice(
    axis: str, origin: float, spacing: float, count: int, *, first: float = 0
) -> Coordinate:
    """The coordinate of an even axis: origin + (first + i) * spacing for i below `count`.

    `first` is the index of the first position; a half stands for the centre of a cell. Raises
    InputError for an origin or a spacing that is not finite, and for a spacing of 0.
    """
    if not np.isfinite([origin, spacing]).all() or (spacing == 0 and count > 1):
        raise InputError(
            f"the grid has the origin {origin} and the spacing {spacing} along {axis}; both must be"
            " finite, and the spacing not 0"
        )
    values = origin + (first + np.arange(count, dtype=np.float64)) * spacing
    return Coordinate(name=AXIS_NAMES[axis], values=values)


def axis_steps(directions: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The signed steps (n,) of axis vectors (n, n), one a row, each along its own axis.

    Raises InputError for vectors that are turned: the positions would not belong to one axis each.
    """
    steps: npt.NDArray[np.float64] = np.diagonal(directions)
    others = np.abs(directions - np.diag(steps))
    if not np.isfinite(directions).all() or others.max() > IDENTITY_TOLERANCE * np.abs(steps).max():
        raise InputError(
            "the grid is turned against the axes (its direction is not the identity), and only"
            " grids along x, y and z can be read; resample it first"
        )
    return steps


def component_names(count: int, given: Sequence[str | None] = ()) -> list[str]:
    """Names of `count` components: those given, where all are and they differ; x, y, z; or 0, 1."""
    names = [name for name in given if name]
    if len(names) == count and len(set(names)) == count:
        return names
    return list(LETTERS) if count == len(LETTERS) else [str(number) for number in range(count)]


def component_variables(
    name: str,
    count: int,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    handle: Any,
    *,
    given: Sequence[str | None] = (),
    auxiliary: bool = False,
    error: str = "",
) -> list[Variable]:
    """The variables of an array: itself, or one for each component, such as `velocity.x`.

    The handle of each is (handle, number of the component).
    """
    names = [""] if count == 1 else [f".{part}" for part in component_names(count, given)]
    return [
        Variable(
            name=f"{name}{part}",
            shape=shape,
            dtype=dtype,
            auxiliary=auxiliary,
            error=error,
            handle=(handle, number),
        )
        for number, part in enumerate(names)
    ]


def component_by_number(var: str | None, variables: Sequence[Variable]) -> str | None:
    """The name of a component that was given by its number: `velocity.x` for `velocity.0`.

    It is the given name where that is a variable, or no number of a component.
    """
    if var is None or any(var in (each.name, _last(each.name)) for each in variables):
        return var
    stem, _, number = var.rpartition(".")
    parts = [
        each
        for each in variables
        if stem and stem in (each.name.rpartition(".")[0], _last(each.name).rpartition(".")[0])
    ]
    if number.isascii() and number.isdigit() and int(number) < len(parts):
        return parts[int(number)].name
    return var


def _last(name: str) -> str:
    return name.rpartition("/")[2]
