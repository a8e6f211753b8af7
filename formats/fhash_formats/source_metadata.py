"""`SourceMetadata`: what belongs to a variable in its source, beside the values.

It holds the variable's own dimensions, its attributes as they are stored, the coordinates, bounds,
grid mapping and other small arrays that CF makes belong to it, and the attributes of the file.
Nothing in it is decoded: dates are numbers, packed numbers stay packed. So a program that decodes
CF makes the same of it as of the source.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.support.plain_json import plain_text

__all__ = [
    "COORDINATES",
    "NAMING",
    "NO_AXIS",
    "SourceMetadata",
    "SourceVariable",
    "is_plain_name",
    "meant",
    "plain_form",
    "references",
    "renamed",
    "shown_name",
    "with_history",
    "with_plain_names",
    "without_names",
]

NO_AXIS = ""
"""Axis of a dimension of length 1 that is none of t, z, y and x."""
COORDINATES = "coordinates"
"""CF attribute that names the auxiliary coordinates of a variable."""

MAX_NAME = 256
"""Letters of a name."""
MAX_FILE_NAME = 240
"""Bytes of a name that may become that of a file or folder."""

NAMING = (
    "grid_mapping",
    "bounds",
    "climatology",
    "formula_terms",
    "ancillary_variables",
    "cell_measures",
    "geometry",
    "node_coordinates",
    "node_count",
    "part_node_count",
    "interior_ring",
)
"""Attributes that name further variables, as "name name" or "key: name key: name"."""

LOOSELY_NAMING = re.compile(r"edges|mesh|.+_vars?|.+_variables?", re.IGNORECASE)
"""Further attributes whose words name variables, if there are such: A_var, PS_var, edges."""

Places = int | Sequence[int] | None
"""Places along a dimension: some of them in order, one of them, which takes the dimension away, or
None where none of the stored ones is right."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceVariable:
    """An array beside the data: a coordinate, bounds, a grid mapping, coefficients of levels.

    Attributes:
        name: in the source.
        dimensions: names of its axes, () for a scalar.
        values: in the stored type, not decoded; texts are objects or bytes.
        attributes: as they are stored.
        is_coordinate: whether it is a coordinate of the variable.
    """

    name: str
    dimensions: tuple[str, ...]
    values: npt.NDArray[Any]
    attributes: Mapping[str, Any] = field(default_factory=dict)
    is_coordinate: bool = False

    def cut(self, places: Mapping[str, Places]) -> SourceVariable | None:
        """The variable at some places along dimensions; None where it has no values there."""
        values, kept = self.values, list(self.dimensions)
        for number, name in reversed(list(enumerate(self.dimensions))):
            if name not in places:
                continue
            chosen = places[name]
            if chosen is None:
                return None
            single = isinstance(chosen, int)
            indices = np.array([chosen] if isinstance(chosen, int) else list(chosen), dtype=np.intp)
            values = np.take(values, indices, axis=number)
            if single:
                del kept[number]
                values = values.reshape(values.shape[:number] + values.shape[number + 1 :])
        return replace(self, values=values, dimensions=tuple(kept))


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceMetadata:
    """All that belongs to a variable of a source.

    Attributes:
        dimensions: dimensions of the variable in the source's own order, each with its axis "t",
            "z", "y" or "x", or NO_AXIS where it has length 1 and is none. An axis that is not
            there was made up, with length 1.
        variable_attributes: all attributes of the variable as they are stored.
        variables: the arrays beside it.
        attributes: of the file, or of the group of the variable.
        stored: number type of the stored values, where it is not that of the decoded ones.
        file: name of the file, without folders; None for data in memory.
        digest: SHA-256 of the file, hexadecimal; None where it was not taken.
    """

    dimensions: Mapping[str, str]
    variable_attributes: Mapping[str, Any] = field(default_factory=dict)
    variables: tuple[SourceVariable, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    stored: str | None = None
    file: str | None = None
    digest: str | None = None

    def cut(self, places: Mapping[str, Places]) -> SourceMetadata:
        """The metadata of a part of the variable.

        places: along an axis "t", "z", "y" or "x": the chosen vertices or steps in order, or None
            for places between them, at which no array beside the data has a value.
        """
        by_name = {name: places[axis] for name, axis in self.dimensions.items() if axis in places}
        if not by_name:
            return self
        cut = (variable.cut(by_name) for variable in self.variables)
        kept = tuple(variable for variable in cut if variable is not None)
        lost = {variable.name for variable in self.variables} - {each.name for each in kept}
        attributes = without_names(self.variable_attributes, lost)
        return replace(self, variables=kept, variable_attributes=attributes)

    def named(self, name: str) -> SourceVariable | None:
        """The array of a name; None without it."""
        return next((each for each in self.variables if each.name == name), None)

    def along(self, axis: str) -> str | None:
        """Name of the dimension that is an axis; None where the axis was made up."""
        return next((name for name, each in self.dimensions.items() if each == axis), None)


def without_names(attributes: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Attributes whose list of coordinates does not name some variables.

    A name of no variable would keep a reader from all the others.
    """
    listed = attributes.get(COORDINATES)
    if not names or not isinstance(listed, str):
        return dict(attributes)
    kept = " ".join(name for name in listed.split() if name not in names)
    others = {key: value for key, value in attributes.items() if key != COORDINATES}
    return {**others, COORDINATES: kept} if kept else others


def references(
    attributes: Mapping[str, Any], *, loosely: bool = False
) -> Iterator[tuple[str, str]]:
    """Attributes that name other variables, each with a name in it, in order.

    loosely: those of LOOSELY_NAMING as well, whose words need not be names.
    """
    more = [key for key in attributes if loosely and LOOSELY_NAMING.fullmatch(key)]
    for key in dict.fromkeys((COORDINATES, *NAMING, *more)):
        text = attributes.get(key)
        for word in text.split() if isinstance(text, str) else ():
            if not word.endswith(":"):
                yield key, word
            elif key == "grid_mapping":
                yield key, word[:-1]


def renamed(attributes: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Attributes that name other variables by their new names. names: new by old ones."""

    def word(old: str) -> str:
        bare = old.removesuffix(":")
        return names.get(bare, bare) + old[len(bare) :]

    changed = {
        key: " ".join(
            word(old) if key == "grid_mapping" or not old.endswith(":") else old
            for old in attributes[key].split()
        )
        for key in dict.fromkeys(
            key for key, name in references(attributes, loosely=True) if name in names
        )
    }
    return {**attributes, **changed}


def with_history(attributes: Mapping[str, Any], line: str) -> dict[str, Any]:
    """Attributes of a file with one more line of `history`, as CF asks of every program."""
    before = attributes.get("history")
    text = f"{before.rstrip()}\n{line}" if isinstance(before, str) and before.strip() else line
    return {**attributes, "history": text}


def shown_name(name: str, taken: Collection[str]) -> str:
    """The name of a variable, or another where a dimension has its last part as a name.

    The component "B/x" of a vector on a grid of x, y and z is B_x then, and an array without a
    group values_x. taken: names of the dimensions.
    """
    *groups, last = name.split("/")
    if last not in taken:
        return name
    return f"{next((each for each in groups[::-1] if each and '*' not in each), 'values')}_{last}"


def meant(wish: str, names: Collection[str]) -> list[str]:
    """The names that a wish means: the whole of one, else its last parts, "E/x", "x" or E_x."""
    name = wish.strip("/")
    if name in names:
        return [name]
    return [
        each
        for each in names
        if each.endswith((f"/{name}", f".{name}")) or "_".join(each.split("/")[-2:]) == name
    ]


def is_plain_name(name: object) -> bool:
    """Whether every format takes a text as the name of a variable, a dimension or an attribute."""
    return (
        isinstance(name, str)
        and 0 < len(name) <= MAX_NAME
        and name.isprintable()
        and not set(name) & set("/\\")
        and name == name.strip()
        and bool(name.strip("._"))
        and not name.startswith("__")
    )


def plain_form(name: str, taken: Collection[str] = (), *, default: str = "unnamed") -> str:
    """The name as files and folders of every format take it, and as none of `taken` is.

    It is the name itself where that is so.

    default: stands for a name of which nothing is left.
    """
    safe = (c if c.isprintable() and c not in "/\\" else "_" for c in plain_text(name))
    text = "".join(safe).strip()
    while len(text.encode(errors="replace")) > MAX_FILE_NAME:
        text = text[:-1].strip()
    if text.startswith("__"):
        text = f"_{text.lstrip('_')}"
    if text == "zarr.json" or text.startswith(".z"):  # files of Zarr
        text = text.replace(".", "_")
    text = text if text.strip("._") else default
    number, found = 2, text
    while found in taken:
        found, number = f"{text}_{number}", number + 1
    return found


def with_plain_names(metadata: SourceMetadata) -> tuple[SourceMetadata, dict[str, str]]:
    """The metadata with names that every format takes, and the new names by the old ones."""
    every = dict.fromkeys(metadata.dimensions)
    for variable in metadata.variables:
        every |= dict.fromkeys([variable.name, *variable.dimensions])
    names: dict[str, str] = {}
    taken = {name for name in every if plain_form(name) == name}
    for name in every:
        if name not in taken:
            names[name] = plain_form(name, taken | set(names.values()))
    if not names:
        return metadata, {}
    variables = tuple(
        replace(
            variable,
            name=names.get(variable.name, variable.name),
            dimensions=tuple(names.get(each, each) for each in variable.dimensions),
            attributes=renamed(variable.attributes, names),
        )
        for variable in metadata.variables
    )
    return replace(
        metadata,
        dimensions={names.get(name, name): axis for name, axis in metadata.dimensions.items()},
        variable_attributes=renamed(metadata.variable_attributes, names),
        variables=variables,
    ), names
