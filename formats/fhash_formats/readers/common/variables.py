"""Variables of a file: choice of one, fields of records, steps in groups."""

from __future__ import annotations

import difflib
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf import Column, Packing, beside
from fhash_formats.readers.common.file_series import Request
from fhash_formats.readers.common.layout import (
    Dimension,
    Layout,
    Read,
    arrange,
    shared_roles,
    with_roles,
)
from fhash_formats.series import Coordinate, meant
from fhash_formats.support.values import json_attributes

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
        field: path of names in a compound type, () where the array is no such.
        members: arrays of the same kind, one a step; () for an array that the file holds as one
            (`join`).
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


PARTS = ("real", "imag")
"""Fields of a complex number, by numpy's names."""


def leaves(
    dtype: np.dtype[Any], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], np.dtype[Any], tuple[int, ...]]]:
    """Path, type and shape of each number in a type, nested fields included.

    A field that is an array has a shape; others have ().
    """
    if dtype.subdtype is not None:
        inner, shape = dtype.subdtype
        for deeper, leaf, rest in leaves(inner, path):
            yield deeper, leaf, (*shape, *rest)
    elif dtype.names is not None and dtype.fields is not None:
        for name in dtype.names:
            yield from leaves(dtype.fields[name][0], (*path, name))
    elif dtype.kind == "c":
        part = np.empty(0, dtype).real.dtype
        yield from (((*path, name), part, ()) for name in PARTS)
    else:
        yield path, dtype, ()


def expand(variables: Sequence[Variable]) -> list[Variable]:
    """The variables, with one for each field in place of those of a compound type.

    The parts of a complex array are there by name only, beside the array itself.
    """
    expanded = []
    for variable in variables:
        if variable.dtype.names is None and variable.dtype.kind != "c":
            expanded.append(variable)
            continue
        if variable.dtype.kind == "c":
            expanded.append(variable)
        expanded += [
            replace(
                variable,
                name=".".join((variable.name, *path)),
                shape=(*variable.shape, *shape),
                dtype=dtype,
                field=path,
                auxiliary=variable.auxiliary or variable.dtype.kind == "c",
            )
            for path, dtype, shape in leaves(variable.dtype)
        ]
    return expanded


def field_reading(read: Read, variable: Variable, stored: int) -> Read:
    """`read` of an array of `stored` dimensions as that of a variable's field of it."""
    if not variable.field:
        return read

    def field(ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        values: Any = read(ranges[:stored])
        for name in variable.field:
            values = getattr(values, name) if values.dtype.kind == "c" else values[name]
        # a copy, so that the other fields are not held in memory
        return np.array(values[(..., *ranges[stored:])])

    return field


STEP_NAMES = """step steps timestep timesteps time_step ts time times t it iter iteration iterations
cycle frame snapshot snap output out dump plt chk data state"""
STEPS = frozenset(STEP_NAMES.split())
"""Words before the number of a step. Other numbers count levels, members or blocks."""

NUMBERED = re.compile(r"(?P<word>.*?)[\s_#:=.-]*(?P<number>\d+(\.\d+)?)")
TIME_KEYS = ("time", "time_value", "timevalue", "sim_time", "simtime", "current_time")
"""Names, in any case, of the attribute or number that holds the time of a group."""

UNIT_KEYS = ("timeunits", "time_units", "time_unit", "timeunit")
SI_KEY = "timeUnitSI"
"""openPMD's attribute: seconds in one unit of `time`."""

Attributes = Callable[[str], Mapping[str, Any]]


@dataclass(frozen=True)
class _StepPath:
    """The part of a path that counts steps: the path with `*` for it, and the number."""

    template: str
    number: float
    group: str
    plain: bool


def _step_path(path: str) -> _StepPath | None:
    """The part of a path that counts steps, None without one; the array's own name is none."""
    parts = path.split("/")
    for depth, part in enumerate(parts[:-1]):
        match = NUMBERED.fullmatch(part)
        if match is None:
            continue
        word = match["word"].strip().lower()
        if word and word not in STEPS:
            continue
        stem = part[: match.start("number")]
        return _StepPath(
            template="/".join([*parts[:depth], f"{stem}*", *parts[depth + 1 :]]),
            number=float(match["number"]),
            group="/".join(parts[: depth + 1]),
            plain=not word,
        )
    return None


def join(variables: Sequence[Variable], attributes: Attributes) -> list[Variable]:
    """The variables, and one more for each kind of array that has one group a step.

    Its members become auxiliary, so that they are read only where they are named. Arrays of
    different shapes, types or units are no series. A single group counts where its name or its
    attributes say that it is a step.

    attributes: attributes of a group by its path.
    """
    kinds: dict[str, list[tuple[_StepPath, Variable]]] = {}
    for variable in variables:
        place = None if variable.error or len(variable.shape) < 2 else _step_path(variable.name)
        if place is not None and not variable.auxiliary:
            kinds.setdefault(place.template, []).append((place, variable))
    broken = _broken(variables)
    joined, inside = [], set()
    for template, members in kinds.items():
        members.sort(key=lambda member: member[0].number)
        first = members[0][1]
        alike = {
            (member.shape, member.dtype.newbyteorder("="), member.units) for _, member in members
        }
        numbers = {place.number for place, _ in members}
        alone = len(members) == 1 and members[0][0].plain
        if len(alike) > 1 or len(numbers) < len(members):
            continue
        if alone and group_time(attributes(members[0][0].group)) is None:
            continue
        shape = (len(members), *first.shape)
        joined.append(
            replace(
                first,
                name=template,
                shape=shape,
                error=next((why for key, why in broken if template.startswith(key)), ""),
                members=tuple(member for _, member in members),
            )
        )
        inside |= {member.name for _, member in members}
    rest = [
        replace(variable, auxiliary=True) if variable.name in inside else variable
        for variable in variables
    ]
    return [*joined, *rest]


def _broken(variables: Sequence[Variable]) -> list[tuple[str, str]]:
    """Names, or beginnings of names, of joined variables one step of which cannot be opened."""
    found = []
    for variable in variables if any(each.error for each in variables) else ():
        if not variable.error:
            continue
        own, group = _step_path(variable.name), _step_path(f"{variable.name}/")
        if own is not None:
            found.append((own.template, f"{variable.name} is {variable.error}"))
        elif group is not None:
            found.append((group.template, f"{variable.name} is {variable.error}"))
    return found


def group_time(attributes: Mapping[str, Any]) -> tuple[float, str] | None:
    """Time and its unit in the attributes of a group; None without a time.

    openPMD: `time` times `timeUnitSI` is in seconds.
    """
    known = json_attributes(attributes)
    lower = {name.lower(): name for name in known}
    key = next((lower[key] for key in TIME_KEYS if key in lower), None)
    value = None if key is None else _number(known[key])
    if value is None:
        return None
    scale = _number(known.get(SI_KEY))
    if scale is not None:
        return value * scale, "s"
    units = next((str(known[lower[key]]) for key in UNIT_KEYS if key in lower), "")
    return value, units


def _number(value: Any) -> float | None:
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value)


def times(
    members: Iterable[Variable],
    attributes: Attributes,
    scalar: Callable[[str], tuple[float, str] | None],
) -> Coordinate:
    """Times of the steps of a joined variable; the numbers in the names if the file gives none.

    attributes: of a group or array by its path. scalar: value and unit of a number by its path,
    None if there is no number.
    """
    places = [(_step_path(member.name), member.name) for member in members]
    found = []
    numbers = []
    for place, name in places:
        assert place is not None
        numbers.append(place.number)
        inner = name.removeprefix(place.group).split("/")[1:-1]
        groups = ["/".join([place.group, *inner[:depth]]) for depth in range(len(inner) + 1)]
        candidates = [group_time(attributes(path)) for path in (*groups, name)]
        candidates += [scalar(f"{group}/{key}") for group in groups for key in ("time", "Time")]
        found.append(next((time for time in candidates if time is not None), None))
    known = [time for time in found if time is not None]
    if len(known) < len(found) or len({units for _, units in known}) > 1:
        return Coordinate(name="step", values=np.asarray(numbers, np.float64))
    units = known[0][1]
    return Coordinate(
        name="time",
        values=np.asarray([value for value, _ in known], np.float64),
        attributes={"units": units} if units else {},
    )


class FileOfArrays(ABC):
    """The variables of an open file, what their dimensions are, and how they are read.

    A format says how one of its arrays is described and read. What holds for arrays with one group
    a step is said here.
    """

    def __init__(self, source: str, request: Request, arrays: Sequence[Variable]) -> None:
        """arrays: of the file. What the abstract methods need is there already."""
        self.source, self.request = source, request
        self.variables = join(arrays, self._attributes)

    @abstractmethod
    def packing(self, variable: Variable) -> Packing | None:
        """The packing of the values, None where the user wants them as stored."""

    @abstractmethod
    def _stated(self, variable: Variable) -> list[Dimension]:
        """The dimensions of an array, with what the file says about each."""

    @abstractmethod
    def _reading(self, variable: Variable) -> Read:
        """The function that reads the values of an array."""

    @abstractmethod
    def _positions(self, variable: Variable, layout: Layout) -> dict[str, Coordinate]:
        """Coordinates of the axes of an array."""

    @abstractmethod
    def _attributes(self, path: str) -> Mapping[str, Any]:
        """Attributes of a group or an array by its path."""

    @abstractmethod
    def _scalar(self, path: str) -> tuple[float, str] | None:
        """Value and unit of a number by its path, None if there is no number."""

    @abstractmethod
    def _columns(self, group: str) -> Mapping[str, Column]:
        """Candidates for coordinates in a group, by lower-case name."""

    def choose(self, var: str | None) -> Variable:
        """The variable that is wanted; see `choose`."""
        request = self.request
        return choose(
            self.source,
            self.variables,
            var,
            booleans=request.booleans,
            selected=len(request.select),
        )

    def arrange(self, variable: Variable) -> Layout:
        """The reading of a variable; see `layout.arrange`."""
        return arrange(self.source, variable.name, self.dimensions(variable), self.request)

    def dimensions(self, variable: Variable) -> list[Dimension]:
        """The dimensions of a variable, with what the file says about each."""
        return with_roles(self._dimensions(variable), self._roles)

    @cached_property
    def _roles(self) -> dict[str, str]:
        return shared_roles(map(self._dimensions, series_like(self.variables)))

    def _dimensions(self, variable: Variable) -> list[Dimension]:
        if variable.members:
            steps = Dimension(name="step", length=len(variable.members), role="t")
            return [steps, *self._stated(variable.members[0])]
        return self._stated(variable)

    def reading(self, variable: Variable) -> Read:
        """The function that reads the values of a variable."""
        if not variable.members:
            return self._reading(variable)
        types = {
            member.name: (made.dtype if made is not None else member.dtype.newbyteorder("="))
            for member, made in ((member, self.packing(member)) for member in variable.members)
        }
        first = variable.members[0].name
        for name, dtype in types.items():
            if dtype != types[first]:
                raise InputError(
                    f"{self.source}: {name} has values of type {dtype}, {first} of type"
                    f" {types[first]}; the steps of one series must be alike, --raw-values reads"
                    " the numbers as stored"
                )
        return stacked([self._reading(member) for member in variable.members])

    def coordinates(self, variable: Variable, layout: Layout) -> dict[str, Coordinate]:
        """Coordinates of the axes of a variable.

        Raises InputError if a step has positions of its own that differ from those of the first.
        """
        coords = self._positions(variable, layout)
        if not variable.members or "t" not in layout.axes or 0 in layout.picked:
            return coords
        coords["t"] = times(variable.members, self._attributes, self._scalar)
        for member in variable.members[1:]:
            place = self._columns(parent(member.name))
            own = beside(self.source, layout.axes, layout.shape, [place], certain=True, tied="t")
            for axis, coordinate in own.items():
                if not np.array_equal(coordinate.values, coords[axis].values):
                    raise InputError(
                        f"{self.source}: {member.name} has other coordinates along {axis} than"
                        f" {variable.members[0].name}; the steps of one series must be alike"
                    )
        return coords


def stacked(reads: Sequence[Read]) -> Read:
    """A read of several arrays as one, with their number as the first dimension."""

    def read(ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        return np.stack([one(ranges[1:]) for one in reads[ranges[0]]])

    return read
