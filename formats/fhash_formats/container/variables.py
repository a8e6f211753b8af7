"""Several variables in one container: names of their arrays, and checks of the root's header.

FORMAT.md describes such files in its section "Several variables". Each variable has a header and
arrays as a file of its own would have them. Here the names of arrays in such a file
("tables/level_1") become their places in the hierarchy ("u"), and back.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from fhash_formats.container.apart import TABLE
from fhash_formats.container.header import POSITIONS, check_format, validate_header
from fhash_formats.container.record import Record
from fhash_formats.errors import DamagedFileError

__all__ = [
    "AUXILIARY",
    "CONSOLIDATED",
    "FEATURE",
    "NODE",
    "PARTS",
    "SHARES",
    "VariablePlaces",
    "consolidated",
    "free_node",
    "is_several",
    "part_place",
    "read_variables",
    "variable_named",
]

FEATURE = "variables"
"""Feature of files of several variables, and key of their headers at the root."""
PARTS = "parts"
"""Group of all arrays of variables but those that show their values."""
CONSOLIDATED = "consolidated_metadata"
"""Key of the root's document with the documents of all others, for libraries that ask for it."""
NODE = re.compile(r"[A-Za-z0-9_-]{1,100}")
"""Name of an array at the root; without dots, so that those in `parts` mean one variable."""

AUXILIARY = "auxiliary/"
"""Beginning of the names of arrays beside the data."""
SHARES = "shares"
"""Key of a variable's header: arrays beside the data that lie with another variable."""

_COORDINATES = "coords/"


@dataclass(frozen=True, kw_only=True)
class VariablePlaces:
    """A variable of a file of several.

    Attributes:
        name: as in the file's list.
        header: as a file of this variable alone would have it, checked by `validate_header`.
        places: path in the hierarchy by name of the array in a file of this variable alone.
        own: names of the arrays that no other variable has.
    """

    name: str
    header: dict[str, Any]
    places: Mapping[str, str]
    own: Sequence[str]


def is_several(header: Mapping[str, Any]) -> bool:
    """Whether the header of a root is that of several variables; it need not be checked yet."""
    features = header.get("required_features")
    return isinstance(features, list) and FEATURE in features


def part_place(node: str, name: str) -> str:
    """The path of a variable's array in the group of parts: "parts/u.mlp.parameters".

    Args:
        node: the variable's own name in the hierarchy.
        name: the array's name in a file of this variable alone.
    """
    return f"{PARTS}/{node}.{name.replace('.', '..').replace('/', '.')}"


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


def read_variables(
    root: Mapping[str, Any], arrays: Collection[str]
) -> tuple[list[VariablePlaces], list[str]]:
    """The variables of a root's header, and the arrays that belong to none.

    Args:
        root: attribute "fhash" of the root.
        arrays: paths of all arrays in the hierarchy.

    Raises DamagedFileError or UnsupportedFileError for a header that is not sound, and for arrays
    that contradict it.
    """
    headers = _headers(root)
    nodes = {header["array"]: name for name, header in headers.items()}
    places: dict[str, dict[str, str]] = {name: {} for name in headers}
    others = []
    for array in arrays:
        if array in nodes:
            _place(places[nodes[array]], TABLE, array)
        elif array.startswith(f"{PARTS}/"):
            node, _, part = array.removeprefix(f"{PARTS}/").partition(".")
            name = re.sub(r"\.\.|\.", lambda dots: "." if len(dots[0]) == 2 else "/", part)
            if node not in nodes or part_place(node, name) != array or not name:
                raise DamagedFileError(f"array {array} belongs to no variable")
            if name.startswith(_COORDINATES):
                raise DamagedFileError(f"array {array} is a coordinate, which lies at the root")
            _place(places[nodes[node]], name, array)
        else:
            others.append(array)
    shared = set()
    free = frozenset(others)
    own = {name: tuple(found) for name, found in places.items()}
    for name, header in headers.items():
        for part, node in header.get(SHARES, {}).items():
            owner = nodes[node]
            if part not in own[owner]:
                raise DamagedFileError(f"array {part_place(node, part)} is missing")
            _place(places[name], part, places[owner][part])
        for axis, dimension in zip(POSITIONS, header["dimensions"], strict=True):
            if dimension not in free:
                raise DamagedFileError(f"array {dimension} is missing")
            places[name][f"{_COORDINATES}{axis}"] = dimension
            shared.add(dimension)
    found = [
        VariablePlaces(name=name, header=header, places=places[name], own=own[name])
        for name, header in headers.items()
    ]
    return found, [array for array in others if array not in shared]


def consolidated(documents: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The value of the key `consolidated_metadata` for the documents by path of their node."""
    return {"kind": "inline", "must_understand": False, "metadata": dict(documents)}


@contextmanager
def variable_named(name: str) -> Iterator[None]:
    """A block whose errors about a file begin with the name of a variable."""
    try:
        yield
    except DamagedFileError as error:
        raise type(error)(f"variable {name[:80]!a}: {error}") from error


def _headers(root: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The headers of all variables by name, complete and checked."""
    top = Record(root, "header key ")
    check_format(top)
    features = frozenset(top.texts("required_features"))
    headers: dict[str, dict[str, Any]] = {}
    nodes: set[str] = set()
    for entry, record in zip(top.get(FEATURE), top.records(FEATURE), strict=True):
        name = record.text("name")
        record.need(bool(name) and name not in headers, "name", "a text that no other has")
        with variable_named(name):
            node = record.text("array")
            fits = NODE.fullmatch(node) is not None and node != PARTS and node not in nodes
            record.need(fits, "array", "a name of A-Z a-z 0-9 _ - that no other has")
            dimensions = record.texts("dimensions")
            fits = len(set(dimensions)) == len(dimensions) == len(POSITIONS)
            fits = fits and all(NODE.fullmatch(dimension) for dimension in dimensions)
            record.need(fits, "dimensions", "four different names of A-Z a-z 0-9 _ -")
            for feature in record.texts("required_features"):
                known = f"{feature[:40]!a} at the root as well"
                record.need(feature in features, "required_features", known)
            complete = {"format": root["format"], "format_version": root["format_version"]}
            validate_header(header := {**entry, **complete})
        nodes.add(node)
        headers[name] = header
    top.need(bool(headers), FEATURE, "at least one variable")
    for name, header in headers.items():
        with variable_named(name):
            _check_shares(header, nodes)
    for name, header in headers.items():
        if not nodes.isdisjoint(header["dimensions"]):
            raise DamagedFileError(
                f"variable {name[:80]!a}: header key dimensions has the array of a variable"
            )
    return headers


def _check_shares(header: Mapping[str, Any], nodes: Collection[str]) -> None:
    """Check which arrays of a variable lie with another one."""
    record = Record(header, "header key ")
    if not record.has(SHARES):
        return
    record.record(SHARES)
    for part, node in header[SHARES].items():
        fits = part.startswith(AUXILIARY) and isinstance(node, str) and node in nodes
        record.need(fits, SHARES, f"names of arrays {AUXILIARY}... with the array of a variable")


def _place(places: dict[str, str], name: str, array: str) -> None:
    """Note the place of a variable's array; raises DamagedFileError where it has another."""
    if name in places:
        raise DamagedFileError(f"array {array} is {name}, which {places[name]} is already")
    places[name] = array
