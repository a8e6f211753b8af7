"""One group a step, as many simulations write: `Step#0/density`, `/data/100/fields/E/x` of openPMD.

The arrays of one kind become one variable, "Step#*/density", in the order of their numbers. Times
are attributes of the groups, or numbers beside the arrays; without them the numbers of the steps
stand for times.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf_packing import Packing
from fhash_formats.readers.common.layout import Layout, Read
from fhash_formats.readers.common.positions import Column, beside
from fhash_formats.readers.common.variables import Variable, parent
from fhash_formats.series import Coordinate
from fhash_formats.support.attributes import json_attributes

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
class _Place:
    """The part of a path that counts steps: the path with `*` for it, and the number."""

    template: str
    number: float
    group: str
    plain: bool


def _place(path: str) -> _Place | None:
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
        return _Place(
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
    kinds: dict[str, list[tuple[_Place, Variable]]] = {}
    for variable in variables:
        place = None if variable.error or len(variable.shape) < 2 else _place(variable.name)
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
        own, group = _place(variable.name), _place(f"{variable.name}/")
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
    places = [(_place(member.name), member.name) for member in members]
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


def require_one_type(
    source: str, variable: Variable, packing: Callable[[Variable], Packing | None]
) -> None:
    """Raise InputError if the steps of a variable are unpacked to different types."""
    types = {
        member.name: (made.dtype if made is not None else member.dtype.newbyteorder("="))
        for member, made in ((member, packing(member)) for member in variable.members)
    }
    first = variable.members[0].name
    for name, dtype in types.items():
        if dtype != types[first]:
            raise InputError(
                f"{source}: {name} has values of type {dtype}, {first} of type {types[first]}; the"
                " steps of one series must be alike, --raw-values reads the numbers as stored"
            )


def require_positions(
    source: str,
    variable: Variable,
    layout: Layout,
    coords: Mapping[str, Coordinate],
    columns: Callable[[str], Mapping[str, Column]],
) -> None:
    """Raise InputError if a step has positions of its own that differ from those of the first.

    columns: what may be a coordinate in a group, by lower-case name.
    """
    for member in variable.members[1:]:
        place = columns(parent(member.name))
        own = beside(source, layout.axes, layout.shape, [place], certain=True, tied="t")
        for axis, coordinate in own.items():
            if not np.array_equal(coordinate.values, coords[axis].values):
                raise InputError(
                    f"{source}: {member.name} has other coordinates along {axis} than"
                    f" {variable.members[0].name}; the steps of one series must be alike"
                )


def reading(reads: Sequence[Read]) -> Read:
    """A read of several arrays as one, with their number as the first dimension."""

    def stacked(ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        return np.stack([read(ranges[1:]) for read in reads[ranges[0]]])

    return stacked
