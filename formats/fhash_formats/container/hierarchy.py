"""Names of a hierarchy: where arrays of one or several variables lie, and headers in the root."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.header import complete, validate_header
from fhash_formats.errors import DamagedFileError

VARIABLES = "variables"
"""Key of the root's header: the headers of the variables."""
ARRAY = "array"
"""Key of a variable's header: name of its table at the root, if it lies there."""
DIMENSIONS = "dimensions"
"""Key of a variable's header: names of its axes, and of the arrays with its positions."""
SHARES = "shares"
"""Key of a variable's header: arrays beside the data that lie with another variable."""
PARTS = "parts"
"""Group of all arrays but tables that show values, and coordinates."""
COORDINATES = "coords/"
"""Beginning of the names of coordinates."""
CONSOLIDATED = "consolidated_metadata"
"""Key of the root's document with the documents of all others, for libraries that ask for it."""
SHOWN_ATTRIBUTES = ("units", "long_name", "standard_name")
"""Attributes of a variable that its array has for libraries that show it."""

_OF_ROOT = ("format", "format_version", "required_features")


def array_path(number: int, name: str) -> str:
    """The path of a variable's array in the group of parts: "parts/0.mlp.weight_1".

    Args:
        number: of the variable, from 0 in the order of the file.
        name: the array's name.
    """
    return f"{PARTS}/{number}.{name.replace('.', '..').replace('/', '.')}"


def free_node(wish: str, taken: Collection[str]) -> str:
    """A name at the root that nothing has yet, as near as possible to a wish.

    Each run of letters that are not allowed becomes one "_". A name that is taken, or that of the
    group of parts, gets a number.
    """
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", wish)[:80]
    # Zarr keeps names that begin with two underscores for itself.
    plain = re.sub(r"^__+", "_", plain) or "_"
    name, number = plain, 1
    while name in taken or name == PARTS:
        number += 1
        name = f"{plain}_{number}"
    return name


def shows_values(table: ArrayMetadata) -> bool:
    """Whether a library that has the codec of a table finds the values of its variable there.

    In integers, vertices without a value have a number that looks like one.
    """
    if table.tiles is None:
        return False
    # Tiles with settings of their own may have masks of which the codec says nothing.
    settings = table.tiles.settings
    return table.dtype.kind == "f" or (settings is not None and settings.mask is None)


def consolidated(documents: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The value of the key `consolidated_metadata` for the documents by path of their node."""
    return {"kind": "inline", "must_understand": False, "metadata": dict(documents)}


@contextmanager
def variable_named(name: str, count: int) -> Iterator[None]:
    """A block whose errors about a file begin with the name of a variable, if it is one of several.

    count: number of the file's variables.
    """
    try:
        yield
    except DamagedFileError as error:
        if count == 1:
            raise
        raise type(error)(f"variable {name[:80]!a}: {error}") from error


def read_headers(root: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The headers of all variables by name, complete and checked, in the order of the file.

    root: attribute "fhash" of the root. Raises DamagedFileError or UnsupportedFileError for a
    header that is not sound.
    """
    of_root = {key: root[key] for key in _OF_ROOT}
    headers: dict[str, dict[str, Any]] = {}
    for entry in root[VARIABLES]:
        name = entry.get("name", entry["variable"]["name"])
        with variable_named(name, len(root[VARIABLES])):
            header = complete(entry) | of_root
            validate_header(header)
        headers[name] = header
    return headers


GROUP: dict[str, Any] = {"zarr_format": 3, "node_type": "group"}
"""The zarr.json of a group without attributes."""
