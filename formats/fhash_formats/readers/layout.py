"""The dimensions of a stored array: which are axes, and which are fixed at an index by the user.

A series has the axes t, z, y and x. Whatever else an array has (members, components, species) is
selected: `--select member=2`. What a dimension is, the file says by names and coordinates, or the
user by `--axes`; where two readings are likely, the user is asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.cf import Column, assign_axes, coordinate
from fhash_formats.readers.file_series import Request
from fhash_formats.series import AXES, Coordinate
from fhash_formats.support.values import text_of

Read = Callable[[tuple[slice | int, ...]], npt.NDArray[Any]]
"""Values at a slice or an index along each dimension."""

FEWEST_COMPONENTS = 2
"""Length of a last dimension from which on it may hold the components of a vector."""

MOST_COMPONENTS = 9
"""Length of a last dimension up to which it may hold components; a tensor in 3-D has 9."""

FURTHER_NAMES = """member members ensemble ensemble_member ens realization realisation number model
component components comp vector vec direction channel channels band bands species spec tracer
variable variables field fields quantile percentile scenario spin mode bnds bounds nv nbnd"""
FURTHER = frozenset(FURTHER_NAMES.split())
"""Names of dimensions that are no axis of space or time."""


@dataclass(frozen=True, kw_only=True)
class Dimension:
    """One dimension of a stored array.

    Attributes:
        name: the file's name for it, None without one.
        length: of the dimension.
        role: the axis that the file says it is, or None.
        column: what the file stores along it: positions, or labels such as names of members.
    """

    name: str | None
    length: int
    role: str | None = None
    column: Column | None = None

    @property
    def further(self) -> bool:
        """Whether its name says that it is no axis of space or time."""
        return self.role is None and (self.name or "").lower() in FURTHER


def shared_roles(arrays: Iterable[Sequence[Dimension]]) -> dict[str, str]:
    """The axis of each named dimension of a file that only its place in an array tells.

    A dimension has one role in a file: what it is in an array of four axes, it is in one of three.

    arrays: dimensions of all arrays of the file that hold data.
    """
    found: dict[str, str] = {}
    for each in arrays:
        dimensions = with_roles(each, found)
        picked = single(dimensions, {})
        kept = [one for place, one in enumerate(dimensions) if place not in picked]
        if len(kept) != len(AXES) or any(one.further for one in kept):
            continue
        if all(one.role for one in kept) or is_asked(dimensions, picked, selected=False):
            continue
        try:
            axes = assign_axes(
                "", [n.length for n in kept], [n.role for n in kept], [n.name for n in kept], None
            )
        except InputError:  # of this array; it is said where the array is wanted
            continue
        for one, axis in zip(kept, axes, strict=True):
            if one.role is None and one.name:
                found[one.name] = axis
    return found


def with_roles(dimensions: Sequence[Dimension], roles: Mapping[str, str]) -> list[Dimension]:
    """The dimensions, each without a role with that of its name. roles: see `shared_roles`."""
    return [
        replace(one, role=roles[one.name])
        if one.role is None and one.name is not None and one.name in roles
        else one
        for one in dimensions
    ]


def label(place: int, dimension: Dimension) -> str:
    """The name by which a user selects along a dimension."""
    return dimension.name or f"dim{place}"


def shown(dimensions: Sequence[Dimension]) -> str:
    """The dimensions for a message: "member=5, lat=64"."""
    return ", ".join(
        f"{label(place, dimension)}={dimension.length}"
        for place, dimension in enumerate(dimensions)
    )


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A decided reading of a stored array.

    Attributes:
        dimensions: all dimensions of the array, in the file's order.
        picked: index along each dimension that is selected, by its place.
        axes: the axis of each other dimension, in the file's order.
    """

    dimensions: tuple[Dimension, ...]
    picked: Mapping[int, int]
    axes: tuple[str, ...]

    @property
    def kept(self) -> tuple[Dimension, ...]:
        """Dimensions that are axes."""
        return tuple(
            dimension for place, dimension in enumerate(self.dimensions) if place not in self.picked
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes, in the file's order."""
        return tuple(dimension.length for dimension in self.kept)

    def chunks(
        self, chunks: Sequence[int | Sequence[int]] | None
    ) -> tuple[int | Sequence[int], ...] | None:
        """Shape of a stored chunk along the axes."""
        if chunks is None:
            return None
        return tuple(length for place, length in enumerate(chunks) if place not in self.picked)

    def fetch(self, read: Read) -> Read:
        """`read` of the whole array as one that takes ranges of the axes alone."""
        if not self.picked:
            return read

        def fetched(ranges: tuple[slice | int, ...]) -> npt.NDArray[Any]:
            axes = iter(ranges)
            values = read(
                tuple(
                    slice(self.picked[place], self.picked[place] + 1)
                    if place in self.picked
                    else next(axes)
                    for place in range(len(self.dimensions))
                )
            )
            return values.reshape(
                [n for place, n in enumerate(values.shape) if place not in self.picked]
            )

        return fetched

    def coordinates(self, source: str, tied: Mapping[str, Column]) -> dict[str, Coordinate]:
        """Coordinates of the axes to which the file ties a column of positions.

        A selected dimension of time or space, such as one level, keeps its position.
        """
        coords = {
            axis: coordinate(source, column.name, column.read(), column.attributes)
            for axis, column in tied.items()
        }
        for place, index in self.picked.items():
            dimension = self.dimensions[place]
            column, role = dimension.column, dimension.role
            if column is None or role is None or role in coords or role in self.axes:
                continue
            if column.numeric and column.length == dimension.length:
                positions = coordinate(source, column.name, column.read(), column.attributes)
                coords[role] = Coordinate(
                    name=positions.name,
                    values=positions.values[index : index + 1],
                    attributes=positions.attributes,
                )
        return coords

    def attributes(self) -> dict[str, str]:
        """The selection as an attribute of the series; none if nothing was selected."""
        chosen = [
            f"{label(place, self.dimensions[place])}={index}"
            for place, index in sorted(self.picked.items())
            if self.dimensions[place].length > 1
        ]
        return {"selection": ", ".join(chosen)} if chosen else {}


def arrange(source: str, name: str, dimensions: Sequence[Dimension], request: Request) -> Layout:
    """The reading of an array that the file and the user decide.

    Raises InputError where a selection does not fit, where something must be selected, and where
    two readings are likely.
    """
    picked = picks(source, name, dimensions, request.select)
    if request.axes is None:
        picked |= single(dimensions, picked)
        open_places = must_select(dimensions, picked)
        if open_places:
            raise InputError(_unselected(source, name, dimensions, picked, open_places))
    kept = [dimension for place, dimension in enumerate(dimensions) if place not in picked]
    asking = request.asked and request.axes is None
    if asking and is_asked(dimensions, picked, selected=bool(request.select)):
        raise InputError(_question(source, name, dimensions, kept))
    if len(kept) < 2:
        raise InputError(
            f"{source}: --select leaves {len(kept)} of the dimensions ({shown(dimensions)}) of"
            f" {name}; at least 2 are needed"
        )
    shape = [dimension.length for dimension in kept]
    axes = assign_axes(
        source,
        shape,
        [dimension.role for dimension in kept],
        [dimension.name for dimension in kept],
        request.axes,
    )
    return Layout(dimensions=tuple(dimensions), picked=picked, axes=axes)


def single(dimensions: Sequence[Dimension], picked: Mapping[int, int]) -> dict[int, int]:
    """Index 0 along named dimensions of length 1 that are no axis, or that are too many."""
    found: dict[int, int] = {}
    for place, dimension in enumerate(dimensions):
        excess = len(dimensions) - len(picked) - len(found) - len(AXES)
        if place in picked or dimension.length != 1 or dimension.role is not None:
            continue
        if dimension.name is None:
            continue  # the user says which of several it is
        if dimension.further or excess > 0:
            found[place] = 0
    return found


def must_select(dimensions: Sequence[Dimension], picked: Mapping[int, int]) -> list[int]:
    """Places of the dimensions along which the user must select an index, likely ones first."""
    left = [place for place in range(len(dimensions)) if place not in picked]
    further = [place for place in left if dimensions[place].further]
    excess = len(left) - len(further) - len(AXES)
    if excess <= 0:
        return further
    others = [place for place in left if place not in further]
    roles = [dimensions[place].role for place in others]
    unknown = [
        place
        for place in others
        if dimensions[place].role is None or roles.count(dimensions[place].role) > 1
    ]
    last = others[-1]
    if last in unknown and _short([dimensions[place] for place in others]):
        unknown = [last, *(place for place in unknown if place != last)]
    return further + unknown[:excess]


def is_asked(dimensions: Sequence[Dimension], picked: Mapping[int, int], *, selected: bool) -> bool:
    """Whether the last dimension may be x as well as the components of a vector.

    It is short, shorter than the two before it, and nothing in the file says what it is. Who has
    selected along it, or has selected until three dimensions were left, has answered.
    """
    kept = [dimension for place, dimension in enumerate(dimensions) if place not in picked]
    answered = len(dimensions) - 1 in picked or (selected and len(kept) < len(AXES))
    if answered or len(kept) not in (3, 4):
        return False
    last = kept[-1]
    return last.role is None and last.column is None and _short(kept)


def _short(kept: Sequence[Dimension]) -> bool:
    """Whether the last of the dimensions has a length that fits the components of a vector."""
    last = kept[-1]
    return FEWEST_COMPONENTS <= last.length <= MOST_COMPONENTS and last.length < min(
        kept[-2].length, kept[-3].length
    )


def readings(dimensions: Sequence[Dimension], kept: Sequence[Dimension]) -> tuple[str, str]:
    """The options for the two readings of `is_asked`: as axes, and as components."""
    roles = [dimension.role for dimension in kept[:-1]]
    axes = ("t", "z", "y", "x")[-len(kept) :]
    if any(roles):
        last = next((axis for axis in axes if axis not in roles), "x")
        rest = iter([axis for axis in axes if axis not in (*roles, last)])
        axes = (*(role or next(rest) for role in roles), last)
    return f"--axes {','.join(axes)}", f"--select {label(len(dimensions) - 1, kept[-1])}=0"


def _question(
    source: str, name: str, dimensions: Sequence[Dimension], kept: Sequence[Dimension]
) -> str:
    as_axes, as_components = readings(dimensions, kept)
    *lengths, last = [str(dimension.length) for dimension in kept]
    form = "x".join([*lengths, last])
    if len(kept) == len(AXES) and as_axes.endswith("t,z,y,x"):
        form = f"{lengths[0]} steps of {'x'.join([*lengths[1:], last])}"
    return (
        f"{source}: {name} is {form} vertices ({as_axes}), or a {'x'.join(lengths)} field of"
        f" {last} components ({as_components}); say which, 'fhash info {source}' prints both"
        " commands"
    )


def _unselected(
    source: str,
    name: str,
    dimensions: Sequence[Dimension],
    picked: Mapping[int, int],
    places: Sequence[int],
) -> str:
    options = " ".join(f"--select {label(place, dimensions[place])}=0" for place in places)
    lengths = " and ".join(
        f"{label(place, dimensions[place])} has {dimensions[place].length}" for place in places
    )
    return (
        f"{source}: {name} has {len(dimensions)} dimensions ({shown(dimensions)}), and a series"
        f" only t, z, y and x; select one index of the others, such as {options} ({lengths})"
    )


def picks(
    source: str, name: str, dimensions: Sequence[Dimension], select: Sequence[tuple[str, str]]
) -> dict[int, int]:
    """Index along each selected dimension, by place."""
    picked: dict[int, int] = {}
    for key, text in select:
        place = _number_of(dimensions, key)
        if place is None:
            raise InputError(
                f"{source}: --select {key}={text}: {name} has no dimension '{key}'; its dimensions"
                f" are {shown(dimensions)}"
            )
        if place in picked:
            raise InputError(
                f"{source}: --select {key}={text} selects along {label(place, dimensions[place])} a"
                " second time; give one index for each dimension"
            )
        picked[place] = _index(source, key, text, dimensions[place])
    return picked


def _number_of(dimensions: Sequence[Dimension], key: str) -> int | None:
    """Place of a dimension called by its name, as "dim3" or as "3" or "-1"."""
    for place, dimension in enumerate(dimensions):
        if dimension.name == key:
            return place
    number = key.removeprefix("dim")
    if not number.removeprefix("-").isdecimal() or not number.isascii():
        return None
    place = int(number)
    place += len(dimensions) if place < 0 else 0
    return place if 0 <= place < len(dimensions) else None


def _index(source: str, key: str, text: str, dimension: Dimension) -> int:
    """The index that a text stands for: a number as in Python, else a label or a position."""
    try:
        index = int(text)
    except ValueError:
        return _index_of_label(source, key, text, dimension)
    if not -dimension.length <= index < dimension.length:
        raise InputError(
            f"{source}: --select {key}={text} is outside the indices 0..{dimension.length - 1}"
            + _position_of(key, index, dimension)
        )
    return index % dimension.length


def _position_of(key: str, number: int, dimension: Dimension) -> str:
    """Advice on selecting the position that a whole number is, where the coordinate has it."""
    column = dimension.column
    if column is None or not column.numeric:
        return ""
    found = np.flatnonzero(column.read().reshape(-1) == number)
    return f"; {key}={float(number)} is the position of that number" if found.size else ""


def _index_of_label(source: str, key: str, text: str, dimension: Dimension) -> int:
    column = dimension.column
    labels = (
        [] if column is None else [_text(value) for value in column.read().reshape(-1).tolist()]
    )
    if text in labels:
        return labels.index(text)
    try:
        wanted = float(text)
    except ValueError:
        wanted = math.nan
    if column is not None and column.numeric:
        positions = column.read().reshape(-1).astype(np.float64)
        found = np.flatnonzero(np.isclose(positions, wanted, rtol=1e-6, atol=0))
        if found.size:
            return int(found[0])
    listed = f", or one of {', '.join(labels[:8])}" if labels else ""
    raise InputError(
        f"{source}: --select {key}={text} is no index 0..{dimension.length - 1}{listed}"
    )


def _text(value: Any) -> str:
    return text_of(value).strip()
