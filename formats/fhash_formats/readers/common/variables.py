"""The choice of an array of a file: the only suitable one, or the one that was named."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.source_metadata import meant

MAX_LISTED = 12
"""Names in one message; a file with hundreds of arrays would fill the screen."""

KINDS = {
    "b": "boolean",
    "S": "text",
    "U": "text",
    "T": "text",
    "O": "objects",
    "M": "dates",
    "m": "time spans",
}


MIN_DIMENSIONS = 3
"""Dimensions of an array that may be a series; those beyond 4 are selected (layout.py)."""


class SeveralVariablesError(InputError):
    """A choice between variables that is left to the user; `names` are their full names."""

    def __init__(self, message: str, names: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.names = tuple(names)


def kind_of(dtype: np.dtype[Any]) -> str:
    """A type in words: "float32", "boolean", "text", "compound" and so on."""
    if dtype.kind == "V":
        return "compound" if dtype.names else "opaque"
    return KINDS[dtype.kind] if dtype.kind in KINDS else dtype.newbyteorder("=").name


@dataclass(frozen=True, kw_only=True)
class Variable:
    """One array of a file.

    Attributes:
        name: full name, "group/density".
        shape: lengths in the file's order.
        dtype: type of the values.
        auxiliary: it only describes others (coordinates, bounds).
        error: why a library cannot open it, "" if it can.
        handle: whatever the reader needs to find it again.
        units: of the values, "" where unknown.
        field: path of names in a compound type, () where the array is no such (fields.py).
        members: arrays of the same kind, one a step; () for an array that the file holds as one
            (step_groups.py).
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    auxiliary: bool = False
    error: str = ""
    handle: Any = None
    units: str = ""
    field: tuple[str, ...] = ()
    members: tuple[Variable, ...] = ()

    def __str__(self) -> str:
        return f"{self.name} {self.shape}"

    def problem(self, booleans: bool) -> str:
        """Why this array cannot be a series, "" if it can."""
        if self.error:
            return f"what cannot be opened: {self.error}"
        if self.dtype.kind == "b" and not booleans:
            return (
                "boolean values; a mask is given with --feature mask:FILE,"
                " values are integers or floats"
            )
        if self.dtype.kind == "c":
            return (
                f"values of type {kind_of(self.dtype)}; read its parts, with"
                f" --var {self.name}.real and --var {self.name}.imag"
            )
        if self.dtype.kind not in "iufb" or self.dtype.itemsize > 8:
            return (
                f"values of type {kind_of(self.dtype)};"
                " integers and floats up to 64 bits can be read"
            )
        if len(self.shape) < MIN_DIMENSIONS:
            return f"{len(self.shape)} dimensions {self.shape}; 3 or 4 can be read"
        if 0 in self.shape:
            return f"an axis of length 0, shape {self.shape}; there is nothing to read"
        return ""


def series_like(variables: Iterable[Variable]) -> Iterator[Variable]:
    """Variables of a file that may be series and hold data."""
    return (each for each in variables if not each.auxiliary and not each.problem(booleans=True))


def choose(
    source: str,
    variables: Sequence[Variable],
    var: str | None,
    *,
    booleans: bool = False,
    selected: int = 0,
) -> Variable:
    """The variable named `var`, or the only suitable one.

    `var` is a full name, or its last parts where only one variable has them: "E/x", "state.rho",
    "rho". `selected` is the number of dimensions that the user selects along: arrays that then have
    3 or 4 left come before others. Raises InputError for no such name, an unsuitable one, several
    to choose from, or none.
    """
    suitable = [variable for variable in variables if not variable.problem(booleans)]
    candidates = [variable for variable in suitable if not variable.auxiliary]
    fitting = [variable for variable in candidates if len(variable.shape) - selected in (3, 4)]
    if var is None:
        candidates = fitting or candidates
    if var is not None:
        variable = named(source, variables, candidates or suitable, var)
        problem = variable.problem(booleans)
        if problem:
            raise InputError(f"{source}: variable {variable.name} has {problem}")
        return variable
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise SeveralVariablesError(
            f"{source} holds {len(candidates)} variables: {_listed(candidates)}; choose one with"
            " --var",
            [variable.name for variable in candidates],
        )
    if not variables:
        raise InputError(f"{source} holds no array at all")
    # the parts of a complex array are told of by the array itself
    found = [variable for variable in variables if not (variable.field and variable.auxiliary)]
    problems = "; ".join(
        f"{variable.name}: {variable.problem(booleans) or 'a coordinate or its bounds'}"
        for variable in found[:MAX_LISTED]
    )
    rest = f"; and {len(found) - MAX_LISTED} more" if len(found) > MAX_LISTED else ""
    raise InputError(
        f"{source} holds no variable of 3 or 4 dimensions with integer or float values; found"
        f" {problems}{rest}"
    )


def parent(name: str) -> str:
    """The group of a variable, "" at the top."""
    return name.rpartition("/")[0]


def plain_name(name: str) -> str:
    """The name of a variable without the groups around it."""
    return name.rpartition("/")[2]


def named(
    source: str, variables: Sequence[Variable], candidates: Sequence[Variable], var: str
) -> Variable:
    """The variable that `var` names, as `choose` does, whether or not it can be read.

    candidates: variables that a message lists. Raises InputError for no such name, or several.
    """
    names = set(meant(var, [variable.name for variable in variables]))
    found = [variable for variable in variables if variable.name in names]
    if len(found) > 1:
        # a series of steps comes before each of its steps
        found = [variable for variable in found if not variable.auxiliary] or found
    if len(found) > 1:
        raise InputError(
            f"{source}: --var {var} means {len(found)} variables: {_listed(found)}; give the whole"
            " name"
        )
    if found:
        return found[0]
    nearest = sorted(
        candidates,
        key=lambda variable: (
            -difflib.SequenceMatcher(None, var.lower(), variable.name.lower()).ratio()
        ),
    )
    raise InputError(
        f"{source} has no variable '{var}'; "
        + (f"it holds {_listed(nearest)}" if nearest else "nor any other that can be read")
    )


def _listed(variables: Sequence[Variable]) -> str:
    text = ", ".join(str(variable) for variable in variables[:MAX_LISTED])
    return (
        text if len(variables) <= MAX_LISTED else f"{text} and {len(variables) - MAX_LISTED} more"
    )
