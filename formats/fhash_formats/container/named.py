"""One variable in a container: its table and coordinates under the names that its source has.

FORMAT.md describes such files in its section "Names". A library that reads Zarr and has the codec
then shows the variable. Here the names of arrays ("tables/level_1") become their paths ("u").
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fhash_formats.container.apart import TABLE, transform_settings
from fhash_formats.container.coding import Codec
from fhash_formats.container.header import POSITIONS
from fhash_formats.container.record import Record
from fhash_formats.container.variables import NODE, free_node
from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.apart import without_names

__all__ = [
    "ARRAY",
    "DIMENSIONS",
    "FEATURE",
    "SHOWN_ATTRIBUTES",
    "Names",
    "paths_of",
    "shows_values",
]

FEATURE = "named"
"""Feature of files whose table and coordinates have the names of the source."""
ARRAY = "array"
"""Key of the header: path of the table."""
DIMENSIONS = "dimensions"
"""Key of the header: names of its axes."""
SHOWN_ATTRIBUTES = ("units", "long_name", "standard_name")
"""Attributes of a variable that its array has for libraries that show it."""
TAKEN = (
    "auxiliary",
    "coords",
    "key_frames",
    "missing",
    "mlp",
    "occupancy",
    "steps",
    "tables",
    "whole",
)
"""Names at the root that other arrays and groups have."""


def shows_values(dtype: np.dtype[Any], codecs: Sequence[Codec]) -> bool:
    """Whether a library that has the codec of a table finds the values of its variable there.

    It does not where head or masks lie in other arrays. In integers, vertices without a value have
    a number that looks like one.
    """
    settings = transform_settings(codecs)
    masked_integers = dtype.kind in "iu" and "mask" in settings
    return bool(settings) and not without_names(settings)[1] and not masked_integers


@dataclass(frozen=True, kw_only=True)
class Names:
    """The names at the root of a file of one variable.

    Attributes:
        table: path of the table.
        dimensions: names of the coordinates, in the order of POSITIONS.
        shape: lengths of the coordinates.
        attributes: that the table shows.
    """

    table: str
    dimensions: tuple[str, ...]
    shape: tuple[int, ...]
    attributes: Mapping[str, Any]

    @classmethod
    def of(
        cls, variable: Mapping[str, Any], coordinates: Iterable[str], shape: Sequence[int]
    ) -> Names:
        """The names for a variable, each as near as possible to that in the source.

        variable: as in the header. coordinates: names in the order of POSITIONS.
        """
        taken = [*TAKEN]
        for name in (variable["name"], *coordinates):
            taken.append(free_node(str(name), taken))
        told = {**variable.get("attributes", {}), "units": variable.get("units")}
        return cls(
            table=taken[len(TAKEN)],
            dimensions=tuple(taken[len(TAKEN) + 1 :]),
            shape=tuple(shape),
            attributes={key: told[key] for key in SHOWN_ATTRIBUTES if told.get(key)},
        )

    def hidden(self) -> Names:
        """The same names for a table whose numbers are not the values."""
        return replace(self, table=TABLE, attributes={})

    def path(self, name: str) -> str:
        """The path of an array."""
        return _paths(self.table, self.dimensions).get(name, name)

    def axes(self, shape: Sequence[int]) -> tuple[str, ...]:
        """The names of the axes of a table: those of the coordinates that have every position."""
        taken = [*TAKEN, self.table, *self.dimensions]
        names = []
        for name, length, own in zip(self.dimensions, self.shape, shape, strict=True):
            names.append(name if length == own else free_node(f"{name}_box", taken))
            taken.append(names[-1])
        return tuple(names)

    def header(self) -> dict[str, Any]:
        """The keys of the header."""
        return {ARRAY: self.table, DIMENSIONS: list(self.dimensions)}


def paths_of(header: Mapping[str, Any], arrays: Collection[str]) -> dict[str, str]:
    """The path of each array by its name.

    Args:
        header: of the root, of one variable; it need not be checked yet.
        arrays: paths of all arrays.

    Raises DamagedFileError for names that are not allowed or contradict the arrays.
    """
    features = header.get("required_features")
    if not isinstance(features, list) or FEATURE not in features:
        return {path: path for path in arrays}
    record = Record(header, "header key ")
    table, dimensions = record.text(ARRAY), record.texts(DIMENSIONS)
    fits = table == TABLE or (NODE.fullmatch(table) is not None and table not in TAKEN)
    record.need(fits, ARRAY, f"{TABLE}, or a name of A-Z a-z 0-9 _ - that nothing else has")
    fits = len(dimensions) == len(POSITIONS) == len({*dimensions, table} - {table})
    fits = fits and all(NODE.fullmatch(name) and name not in TAKEN for name in dimensions)
    record.need(fits, DIMENSIONS, "four names of A-Z a-z 0-9 _ - that nothing else has")
    names = {path: name for name, path in _paths(table, dimensions).items()}
    found: dict[str, str] = {}
    for path in arrays:
        name = names.get(path, path)
        if name in found or (path in names.values() and name == path and path != table):
            raise DamagedFileError(f"array {path} has another name in the header")
        found[name] = path
    return found


def _paths(table: str, dimensions: Sequence[str]) -> dict[str, str]:
    """The paths of those arrays that have names of the source."""
    coordinates = zip(POSITIONS, dimensions, strict=True)
    return {TABLE: table, **{f"coords/{axis}": name for axis, name in coordinates}}
