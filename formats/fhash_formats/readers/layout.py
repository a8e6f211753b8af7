"""The dimensions of a stored array: which are axes, and which are fixed at an index by the user.

A series has the axes t, z, y and x. Whatever else an array has (members, components, species) is
selected: `--select member=2`. What a dimension is, the file says by names and coordinates, or the
user by `--axes`; where two readings are likely, the user is asked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.cf import Column, coordinate
from fhash_formats.readers.file_series import Request
from fhash_formats.series import AXES, Coordinate
from fhash_formats.support.values import is_number, text_of

Read = Callable[[tuple[slice | int, ...]], npt.NDArray[Any]]
"""Values at a slice or an index along each dimension."""

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
        kept = left(dimensions, picked)
        if len(kept) != len(AXES) or any(one.further for one in kept):
            continue
        if all(one.role for one in kept) or is_asked(dimensions, picked, selected=False):
            continue
        try:
            axes = assign_axes("", kept, None)
        except InputError:  # of this array; it is said where the array is wanted
            continue
        for one, axis in zip(kept, axes, strict=True):
            if one.role is None and one.name:
                found[one.name] = axis
    return found


def with_roles(dimensions: Sequence[Dimension], roles: Mapping[str, str]) -> list[Dimension]:
    """The dimensions, each without a role with that of its name. roles: see `shared_roles`."""
    return [replace(one, role=one.role or roles.get(one.name or "")) for one in dimensions]


def label(place: int, dimension: Dimension) -> str:
    """The name by which a user selects along a dimension."""
    return dimension.name or f"dim{place}"


def shown(dimensions: Sequence[Dimension]) -> str:
    """The dimensions for a message: "member=5, lat=64"."""
    return ", ".join(f"{label(place, each)}={each.length}" for place, each in enumerate(dimensions))


def left(dimensions: Sequence[Dimension], picked: Mapping[int, int]) -> list[Dimension]:
    """The dimensions along which nothing is selected."""
    return [dimension for place, dimension in enumerate(dimensions) if place not in picked]


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
    def kept(self) -> list[Dimension]:
        """Dimensions that are axes."""
        return left(self.dimensions, self.picked)

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
            one = {place: slice(index, index + 1) for place, index in self.picked.items()}
            places = range(len(self.dimensions))
            values = read(tuple(one[n] if n in one else next(axes) for n in places))
            return values.reshape([values.shape[place] for place in places if place not in one])

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
                found = coordinate(source, column.name, column.read(), column.attributes)
                coords[role] = replace(found, values=found.values[index : index + 1])
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
    what = f"{source}: {name} has {len(dimensions)} dimensions ({shown(dimensions)})"
    picked = picks(source, name, dimensions, request.select)
    if request.axes is None:
        picked |= single(dimensions, picked)
        open_places = [(label(n, dimensions[n]), n) for n in must_select(dimensions, picked)]
        if open_places:
            options = " ".join(f"--select {each}=0" for each, _ in open_places)
            told = " and ".join(f"{each} has {dimensions[n].length}" for each, n in open_places)
            raise InputError(
                f"{what}, and a series only t, z, y and x; select one index of the others, such as"
                f" {options} ({told})"
            )
    kept = left(dimensions, picked)
    asking = request.asked and request.axes is None
    if asking and is_asked(dimensions, picked, selected=bool(request.select)):
        as_axes, as_components = readings(dimensions, kept)
        *lengths, last = [str(dimension.length) for dimension in kept]
        form = "x".join([*lengths, last])
        if len(kept) == len(AXES) and as_axes.endswith("t,z,y,x"):
            form = f"{lengths[0]} steps of {'x'.join([*lengths[1:], last])}"
        raise InputError(
            f"{source}: {name} is {form} vertices ({as_axes}), or a {'x'.join(lengths)} field of"
            f" {last} components ({as_components}); say which, 'fhash info {source}' prints both"
            " commands"
        )
    if len(kept) < 2:
        raise InputError(f"{what}; --select leaves {len(kept)}, and at least 2 are needed")
    axes = assign_axes(source, kept, request.axes)
    return Layout(dimensions=tuple(dimensions), picked=picked, axes=axes)


def assign_axes(
    what: str, kept: Sequence[Dimension], axes: tuple[str, ...] | None
) -> tuple[str, ...]:
    """The axis of each of 3 or 4 dimensions.

    `axes`, if the user gave it, decides. Otherwise the roles do. Dimensions without a role take the
    axes that are left in the order (t, z, y, x). 3 dimensions are (z, y, x) unless a role says
    time; then they are (t, y, x) first of all.

    Raises InputError where that is ambiguous: two dimensions with one meaning, or an order that
    cannot be completed with certainty.
    """
    roles = [each.role for each in kept]
    if axes is not None:
        if len(axes) != len(kept):
            raise InputError(
                f"{what}: --axes {','.join(axes)} names {len(axes)} axes, the array has {len(kept)}"
                f" dimensions {tuple(each.length for each in kept)}"
            )
        return axes
    said = [role for role in roles if role is not None]
    told = ", ".join(f"{each.name or '?'}={each.length}" for each in kept)
    if len(set(said)) != len(said):
        raise InputError(
            f"{what}: two dimensions of ({told}) mean the same axis; say what they are with --axes,"
            " such as t,z,y,x"
        )
    open_places = len(kept) - len(said)
    if open_places > 1 and said != sorted(said, key=AXES.index):
        raise InputError(
            f"{what}: the order of the dimensions ({told}) is not clear; say what they are with"
            " --axes, such as x,y,z,t"
        )
    free = [axis for axis in (AXES if len(kept) == len(AXES) else AXES[1:]) if axis not in said]
    fill = iter(free[len(free) - open_places :])
    return tuple(role if role is not None else next(fill) for role in roles)


def single(dimensions: Sequence[Dimension], picked: Mapping[int, int]) -> dict[int, int]:
    """Index 0 along named dimensions of length 1 that are no axis, or that are too many."""
    found: dict[int, int] = {}
    for place, dimension in enumerate(dimensions):
        excess = len(dimensions) - len(picked) - len(found) - len(AXES)
        if place in picked or dimension.length != 1 or dimension.role is not None:
            continue
        # of one without a name, the user says which of several it is
        if dimension.name is not None and (dimension.further or excess > 0):
            found[place] = 0
    return found


def must_select(dimensions: Sequence[Dimension], picked: Mapping[int, int]) -> list[int]:
    """Places of the dimensions along which the user must select an index, likely ones first."""
    open_places = [place for place in range(len(dimensions)) if place not in picked]
    further = [place for place in open_places if dimensions[place].further]
    others = [place for place in open_places if place not in further]
    excess = len(others) - len(AXES)
    if excess <= 0:
        return further
    roles = [dimensions[place].role for place in others]
    unknown = [
        n for n, role in zip(others, roles, strict=True) if not role or roles.count(role) > 1
    ]
    if others[-1] in unknown and _short([dimensions[place] for place in others]):
        unknown = [others[-1], *unknown[:-1]]
    return further + unknown[:excess]


def is_asked(dimensions: Sequence[Dimension], picked: Mapping[int, int], *, selected: bool) -> bool:
    """Whether the last dimension may be x as well as the components of a vector.

    It is short, shorter than the two before it, and nothing in the file says what it is. Who has
    selected along it, or has selected until three dimensions were left, has answered.
    """
    kept = left(dimensions, picked)
    answered = len(dimensions) - 1 in picked or (selected and len(kept) < len(AXES))
    if answered or len(kept) not in (3, 4):
        return False
    last = kept[-1]
    return last.role is None and last.column is None and _short(kept)


def _short(kept: Sequence[Dimension]) -> bool:
    """Whether the last of the dimensions may hold components: a vector has 2 or more, tensors 9."""
    *_, first, second, last = (dimension.length for dimension in kept)
    return 2 <= last <= 9 and last < min(first, second)


def readings(dimensions: Sequence[Dimension], kept: Sequence[Dimension]) -> tuple[str, str]:
    """The options for the two readings of `is_asked`: as axes, and as components."""
    roles = [dimension.role for dimension in kept[:-1]]
    axes = ("t", "z", "y", "x")[-len(kept) :]
    if any(roles):
        last = next((axis for axis in axes if axis not in roles), "x")
        rest = iter([axis for axis in axes if axis not in (*roles, last)])
        axes = (*(role or next(rest) for role in roles), last)
    return f"--axes {','.join(axes)}", f"--select {label(len(dimensions) - 1, kept[-1])}=0"


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
    names = [dimension.name for dimension in dimensions]
    if key in names:
        return names.index(key)
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
        found = _place_of(index, dimension) is not None
        advice = f"; {key}={float(index)} is the position of that number" if found else ""
        raise InputError(
            f"{source}: --select {key}={text} is outside the indices 0..{dimension.length - 1}"
            + advice
        )
    return index % dimension.length


def _place_of(number: float, dimension: Dimension, rtol: float = 0) -> int | None:
    """Index of a position along a dimension; None where it has no such."""
    column = dimension.column
    if column is None or not column.numeric:
        return None
    positions = column.read().reshape(-1).astype(np.float64)
    found = np.flatnonzero(np.isclose(positions, number, rtol=rtol, atol=0))
    return int(found[0]) if found.size else None


def _index_of_label(source: str, key: str, text: str, dimension: Dimension) -> int:
    column = dimension.column
    values = [] if column is None else column.read().reshape(-1).tolist()
    labels = [text_of(value).strip() for value in values]
    if text in labels:
        return labels.index(text)
    found = _place_of(float(text), dimension, rtol=1e-6) if is_number(text) else None
    if found is not None:
        return found
    listed = f", or one of {', '.join(labels[:8])}" if labels else ""
    raise InputError(
        f"{source}: --select {key}={text} is no index 0..{dimension.length - 1}{listed}"
    )
