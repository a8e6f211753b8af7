"""Labelled variables, what every reader makes of a file: choice of one, fields, steps in groups."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.file_series import Stamp
from fhash_formats.readers.layout import Read
from fhash_formats.readers.stored_parts import StoredParts
from fhash_formats.series import AXIS_NAMES, MAX_NAME, Coordinate, meant
from fhash_formats.support.values import json_attributes, text_of

MAX_LISTED = 12
"""Names in one message; a file with hundreds of arrays would fill the screen."""

MADE_UP = "phony_dim_"
"""Beginning of the names that h5netcdf makes up for dimensions without one."""
MAX_WHOLE = 1 << 26
"""Values of an array beside others that is read at once, such as positions and tables."""
MAX_LETTERS = 64
"""Letters of a date, or of a label."""

KINDS = {
    "b": "boolean",
    "S": "text",
    "U": "text",
    "T": "text",
    "O": "objects",
    "M": "dates",
    "m": "time spans",
}


MIN_DIMENSIONS = 2
"""Dimensions of an array that may be a series; those beyond 4 are selected (layout.py)."""


FIELD_DIMENSIONS = 3
"""Dimensions from which on an array is a field of its own, and not something beside one."""


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


def _unread(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
    raise AssertionError("nobody said how the values are read")


@dataclass(frozen=True, kw_only=True)
class Behind:
    """Parts of a variable that somebody wrote, and the files that hold them.

    Attributes:
        parts: None where all are stored.
        files: beside the file that was opened.
        stamp: of what says the shape, where it is not the file that was opened.
        folder: all files that hold values.
    """

    parts: StoredParts | None = None
    files: Sequence[Path] = ()
    stamp: Stamp | None = None
    folder: Path | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Variable:
    """One lazy labelled array of a source.

    Attributes:
        name: full name, "group/density".
        shape: lengths in the source's order.
        dtype: type of the stored values.
        dimensions: name of each, None for one without, and for one that a library made up. Those
            that are left out at the end have no name.
        attributes: as they are stored.
        read: gives stored values.
        chunks: lengths of a stored chunk, or of each chunk along a dimension; None without chunks.
        auxiliary: it only describes others (coordinates, bounds).
        error: why a library cannot open it, "" if it can.
        note: why nobody means it who does not name it, "" if somebody may.
        values: type of what `read` gives, where it is unpacked already; None for stored values.
        scales: full names of the variables that the source ties to dimensions, by name of these.
        behind: looks at what was stored.
        require: raises what is missing where the values cannot be read here.
        flat: whether its name has no groups, whatever letters it has.
        computed: whether its values follow from a header, so that they are not kept beside others.
        unlimited: names of its dimensions that can grow.
        handle: whatever else the reader needs; where `values` is given, what packs them.
        field: path of names in a compound type, () where the array is no such.
        members: arrays of the same kind, one a step; () for an array that the file holds as one
            (`join`).
        hidden: gives, for places along each dimension, True where the format says that the value is
            to be ignored; None where all count. Such values are missing.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    dimensions: tuple[str | None, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    read: Read = _unread
    chunks: Sequence[int | Sequence[int]] | None = None
    auxiliary: bool = False
    error: str = ""
    note: str = ""
    values: np.dtype[Any] | None = None
    scales: Mapping[str, str] = field(default_factory=dict)
    behind: Callable[[], Behind] = Behind
    require: Callable[[], None] = lambda: None
    flat: bool = False
    computed: bool = False
    unlimited: Sequence[str] = ()
    handle: Any = None
    field: tuple[str, ...] = ()
    members: tuple[Variable, ...] = ()
    hidden: Read | None = None

    def __post_init__(self) -> None:
        given = [None if each and each.startswith(MADE_UP) else each for each in self.dimensions]
        open_places = len(self.shape) - len(given)
        object.__setattr__(self, "dimensions", (*given, *[None] * open_places))

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each dimension, "" for one without."""
        return tuple(each or "" for each in self.dimensions)

    @property
    def group(self) -> str:
        """The group that holds it, "" at the top."""
        return "" if self.flat else parent(self.name)

    @property
    def label(self) -> str:
        """Its name without the groups around it."""
        return self.name if self.flat else plain_name(self.name)

    @property
    def first(self) -> Variable:
        """The array of the first step, which is itself where there is one for all steps."""
        return self.members[0] if self.members else self

    @property
    def units(self) -> str:
        """Units of the values, "" where unknown."""
        units = self.attributes.get("units", "")
        return text_of(units) if isinstance(units, str | bytes) else ""

    @property
    def is_letters(self) -> bool:
        """Whether it holds texts as an array of letters, the last dimensions of which are one."""
        count = prod(self.shape[1:])
        return self.dtype == "S1" and len(self.shape) > 1 and 0 < count <= MAX_LETTERS

    def texts(self) -> npt.NDArray[Any]:
        """All texts, of letters too, (n,)."""
        stored = self.whole()
        if not self.is_letters:
            return stored
        rows = stored.reshape(len(stored), -1).tolist()
        return np.array([b"".join(row) for row in rows])

    def whole(self) -> npt.NDArray[Any]:
        """All stored values; raises InputError for more than are read at once."""
        if prod(self.shape) > MAX_WHOLE:
            raise InputError(f"{self.name} has {prod(self.shape)} values; {MAX_WHOLE} are possible")
        return np.asarray(self.read((slice(None),) * len(self.shape)))

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
            return f"{len(self.shape)} dimensions {self.shape}; 2 to 4 can be read"
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
    candidates = [each for each in suitable if not each.auxiliary and not each.note]
    if var is None:
        fields = [each for each in candidates if len(each.shape) - selected > 2]
        fitting = [each for each in fields if len(each.shape) - selected <= 4]
        candidates = fitting or fields or candidates
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
        f"{variable.name}: {variable.problem(booleans) or variable.note or A_COORDINATE}"
        for variable in found[:MAX_LISTED]
    )
    rest = f"; and {len(found) - MAX_LISTED} more" if len(found) > MAX_LISTED else ""
    raise InputError(
        f"{source} holds no variable of 2 to 4 dimensions with integer or float values; found"
        f" {problems}{rest}"
    )


A_COORDINATE = "a coordinate or its bounds"


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
                read=_field_read(variable, path),
                chunks=variable.chunks and (*variable.chunks, *shape),
                field=path,
                auxiliary=variable.auxiliary or variable.dtype.kind == "c",
            )
            for path, dtype, shape in leaves(variable.dtype)
        ]
    return expanded


def _field_read(whole: Variable, path: tuple[str, ...]) -> Read:
    """The read of a field of an array."""
    stored = len(whole.shape)

    def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        values: Any = whole.read(places[:stored])
        for name in path:
            values = getattr(values, name) if values.dtype.kind == "c" else values[name]
        # a copy, so that the other fields are not held in memory
        return np.array(values[(..., *places[stored:])])

    return read


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
        match = NUMBERED.fullmatch(part) if len(part) <= MAX_NAME else None
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
                dimensions=("step", *first.dimensions),
                chunks=first.chunks and (1, *first.chunks),
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


@dataclass(frozen=True, kw_only=True)
class Source:
    """An open source: its variables, and what belongs to all of them.

    Attributes:
        name: for messages.
        variables: in the source's order.
        path: of the file; None for data in memory.
        groups: attributes of each group by path, "" is the source itself.
        close: lets go of all that is open.
        stamp: of the file, or of what says the shapes.
        folder: that holds all of the source; None for a file.
        slow: stamp of a file at a URL.
        files: further files that hold values.
        naming: whether dimensions have names by which positions and all else are found, as in
            NetCDF. Elsewhere names of coordinates count, and nothing is kept but what is beside.
        spread: whether all groups belong together, as in an HDF5 file of any program.
        aliases: full names by others that a user may call variables.
        only: the variable that the path means; "" for any.
        coordinates: names of coordinates that no attribute tells.
        computed: whether values were computed, so that what packs them in a file tells nothing.
        left_out: variables that no file holds, with the reason.
        default_fill: gives the number that the format's library puts where nobody wrote, as stored.
    """

    name: str
    variables: Sequence[Variable]
    path: Path | None = None
    groups: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    close: Callable[[], None] = lambda: None
    stamp: Stamp | None = None
    folder: Path | None = None
    slow: Stamp | None = None
    files: Sequence[Path] = ()
    naming: bool = False
    spread: bool = False
    aliases: Mapping[str, str] = field(default_factory=dict)
    only: str = ""
    coordinates: Sequence[str] = ()
    computed: bool = False
    left_out: Mapping[str, str] = field(default_factory=dict)
    default_fill: Callable[[np.dtype[Any]], Any] = lambda dtype: None


def stacked(reads: Sequence[Read]) -> Read:
    """A read of several arrays as one, with their number as the first dimension."""

    def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        first = places[0]
        assert isinstance(first, slice)
        return np.stack([one(places[1:]) for one in reads[first]])

    return read


def by_ranges(shape: Sequence[int], get: Callable[[list[range]], npt.NDArray[Any]]) -> Read:
    """A read of an array of a shape, of which `get` gives a range along each dimension."""

    def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        ranges = [
            range(each, each + 1) if isinstance(each, int) else range(*each.indices(length))
            for each, length in zip(places, shape, strict=True)
        ]
        return get(ranges)[tuple(0 if isinstance(n, int) else slice(None) for n in places)]

    return read


def components(
    whole: Variable, place: int, given: Sequence[str | None] = (), *, interleaved: bool = True
) -> list[Variable]:
    """One variable for each index along a dimension of components, such as `velocity.x`.

    A single one has the name of the array.

    given: names of the components, which count where all are there and differ; else x, y, z, or
        numbers. interleaved: whether the components of a vertex lie together in the file, so that
        all are read for one.
    """
    count = whole.shape[place]
    if count > MAX_COMPONENTS:
        raise InputError(
            f"{whole.name} has {count} components; {MAX_COMPONENTS} can be told apart, --axes says"
            " what the dimension is"
        )

    def one(number: int, name: str) -> Variable:
        def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
            part = slice(0, count) if interleaved else slice(number, number + 1)
            values = whole.read((*places[:place], part, *places[place:]))
            taken: npt.NDArray[Any] = values.take(number if interleaved else 0, axis=place)
            return taken

        return replace(
            whole,
            name=whole.name + name,
            shape=_without(whole.shape, place),
            dimensions=_without(whole.dimensions, place),
            chunks=None if whole.chunks is None else _without(whole.chunks, place),
            read=read,
        )

    names = [""] if count == 1 else [f".{name}" for name in _component_names(count, given)]
    return [one(number, name) for number, name in enumerate(names)]


def _without(items: Sequence[Any], place: int) -> tuple[Any, ...]:
    return (*items[:place], *items[place + 1 :])


def _component_names(count: int, given: Sequence[str | None]) -> list[str]:
    names = [name for name in given if name]
    if len(names) == count and len(set(names)) == count:
        return names
    return list(LETTERS) if count == len(LETTERS) else [str(number) for number in range(count)]


MAX_COMPONENTS = 1 << 12
"""Components of an array, each of which is a variable."""

LETTERS = ("x", "y", "z")
"""Names of the components of a vector with three of them."""


def component_by_number(var: str | None, variables: Sequence[Variable]) -> str | None:
    """The name of a component that was given by its number: `velocity.x` for `velocity.0`.

    It is the given name where that is a variable, or no number of a component.
    """
    if var is None or any(var in (each.name, plain_name(each.name)) for each in variables):
        return var
    stem, _, number = var.rpartition(".")
    parts = [
        each
        for each in variables
        if stem and stem in (each.name.rpartition(".")[0], plain_name(each.name).rpartition(".")[0])
    ]
    if number.isascii() and number.isdigit() and int(number) < len(parts):
        return parts[int(number)].name
    return var


def positions(
    name: str, values: npt.ArrayLike, attributes: Mapping[str, Any] | None = None
) -> Variable:
    """A coordinate that a reader computes, (n,), along the dimension of its name."""
    made = np.asarray(values)
    return Variable(
        name=name,
        shape=made.shape,
        dtype=made.dtype,
        dimensions=(plain_name(name),) if made.ndim else (),
        attributes=attributes or {},
        read=lambda places: made[places],
        auxiliary=True,
        computed=True,
    )


def file_source(path: Path, variables: Sequence[Variable], **more: Any) -> Source:
    """The source of a file; `more` is what `Source` takes beside."""
    return Source(name=str(path), path=path, variables=variables, **more)


HEADER = "header"
"""Group of the positions that a header says."""


def placed(
    arrays: Sequence[Variable], coords: Mapping[str, Variable], group: str = HEADER
) -> list[Variable]:
    """Variables of a format whose header places the axes, and these positions.

    arrays: their dimensions have the names of AXIS_NAMES. coords: positions by axis, one of an axis
        that they lack. group: of the positions.
    """
    found = [replace(each, name=f"{group}/{each.name}") for each in coords.values()]
    tied = {AXIS_NAMES[axis]: each.name for axis, each in zip(coords, found, strict=True)}
    return [*found, *(replace(each, scales={**each.scales, **tied}) for each in arrays)]
