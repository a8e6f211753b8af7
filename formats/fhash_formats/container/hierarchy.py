"""Hierarchy: members of the ZIP become headers and arrays of one or several variables."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from typing import Any

from fhash_formats.container.array import ArrayMetadata, attributes_of, check_keys
from fhash_formats.container.header import POSITIONS, TABLE, check_format, complete, validate_header
from fhash_formats.container.record import MAX_BYTES, Record, loads
from fhash_formats.container.source_entry import AUXILIARY
from fhash_formats.container.zip_file import DOCUMENT, Member, Source, read_member
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

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
NODE = re.compile(r"[A-Za-z0-9_-]{1,100}")
"""Name of an array at the root."""
SHOWN_ATTRIBUTES = ("units", "long_name", "standard_name")
"""Attributes of a variable that its array has for libraries that show it."""

_NUMBER = re.compile(r"0|[1-9][0-9]{0,8}")
_OF_ROOT = ("format", "format_version", "required_features")


@dataclass(frozen=True, kw_only=True)
class VariablePlaces:
    """A variable of a file.

    Attributes:
        name: in the file.
        header: of the variable, with the keys of the root but `variables`, checked.
        places: path in the hierarchy by name of the array.
        own: names of the arrays that count as its own: all but coordinates, and arrays beside the
            data that lie with another variable.
    """

    name: str
    header: dict[str, Any]
    places: Mapping[str, str]
    own: Sequence[str]


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
    names = list(headers)
    nodes = {header[ARRAY]: name for name, header in headers.items() if ARRAY in header}
    places: dict[str, dict[str, str]] = {name: {} for name in headers}
    others = []
    for array in arrays:
        if array in nodes:
            _add_path(places[nodes[array]], TABLE, array)
        elif array.startswith(f"{PARTS}/"):
            number, _, part = array.removeprefix(f"{PARTS}/").partition(".")
            name = re.sub(r"\.\.|\.", lambda dots: "." if len(dots[0]) == 2 else "/", part)
            owner = int(number) if _NUMBER.fullmatch(number) else len(names)
            if owner >= len(names) or array_path(owner, name) != array or not name:
                raise DamagedFileError(f"array {array} belongs to no variable")
            if name.startswith(COORDINATES):
                raise DamagedFileError(f"array {array} is a coordinate, which lies at the root")
            _add_path(places[names[owner]], name, array)
        else:
            others.append(array)
    shared = set()
    free = frozenset(others)
    own = {name: tuple(found) for name, found in places.items()}
    for name, header in headers.items():
        for part, place in header.get(SHARES, {}).items():
            number, other = place if isinstance(place, list) else (place, part)
            if other not in own[names[number]]:
                raise DamagedFileError(f"array {array_path(number, other)} is missing")
            _add_path(places[name], part, places[names[number]][other])
        for axis, dimension in zip(POSITIONS, header[DIMENSIONS], strict=True):
            if dimension in free:
                places[name][f"{COORDINATES}{axis}"] = dimension
                shared.add(dimension)
    found = [
        VariablePlaces(
            name=name,
            header=header,
            places=places[name],
            own=(*own[name], *(s for s in header.get(SHARES, ()) if not s.startswith(AUXILIARY))),
        )
        for name, header in headers.items()
    ]
    return found, [array for array in others if array not in shared]


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


def _headers(root: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The headers of all variables by name, complete and checked."""
    top = Record(root, "header key ")
    check_format(top)
    of_root = {key: root[key] for key in _OF_ROOT}
    headers: dict[str, dict[str, Any]] = {}
    nodes: set[str] = set()
    entries, records = top.get(VARIABLES), top.records(VARIABLES)
    top.need(bool(entries), VARIABLES, "at least one variable")
    for entry, record in zip(entries, records, strict=True):
        own = record.record("variable").text("name")
        name = record.text("name") if record.has("name") else own
        key = "name" if record.has("name") else "variable"
        record.need(name not in headers, key, "a name that no other has")
        with variable_named(name, len(entries)):
            header = complete(entry) | of_root
            validate_header(header)
            _check_names(Record(header, "header key "), nodes)
            nodes.update({header[ARRAY]} if ARRAY in header else ())
        headers[name] = header
    for name, header in headers.items():
        with variable_named(name, len(entries)):
            checked = Record(header, "header key ")
            unlike = "four names that no variable has"
            checked.need(nodes.isdisjoint(header[DIMENSIONS]), DIMENSIONS, unlike)
            _check_shares(checked, len(headers))
    return headers


def _check_names(header: Record, nodes: Collection[str]) -> None:
    """Check the names of a variable's table and axes. nodes: those of the variables before."""
    if header.has(ARRAY):
        node = header.text(ARRAY)
        fits = NODE.fullmatch(node) is not None and node != PARTS and node not in nodes
        header.need(fits, ARRAY, "a name of A-Z a-z 0-9 _ - that no other has")
    dimensions = header.texts(DIMENSIONS)
    fits = len(set(dimensions)) == len(dimensions) == len(POSITIONS) and PARTS not in dimensions
    fits = fits and all(NODE.fullmatch(dimension) for dimension in dimensions)
    header.need(fits, DIMENSIONS, "four different names of A-Z a-z 0-9 _ -")


def _check_shares(header: Record, count: int) -> None:
    """Check which arrays of a variable lie with another one. count: number of the variables."""
    if not header.has(SHARES):
        return
    header.record(SHARES)
    for part, place in header.get(SHARES).items():
        number, other = place if isinstance(place, list) and len(place) == 2 else (place, part)
        beside = part.startswith(AUXILIARY) and str(other).startswith(AUXILIARY)
        named = part == other and not part.startswith(COORDINATES)
        fits = (beside or named) and type(number) is int and 0 <= number < count
        header.need(fits, SHARES, "names of arrays with the number of a variable")


def _add_path(places: dict[str, str], name: str, array: str) -> None:
    """Note the place of a variable's array; raises DamagedFileError where it has another."""
    if name in places:
        raise DamagedFileError(f"array {array} is {name}, which {places[name]} is already")
    places[name] = array


GROUP: dict[str, Any] = {"zarr_format": 3, "node_type": "group"}
"""The zarr.json of a group without attributes."""

_CHUNK = re.compile(r"(.+)/(c(?:/[0-9]+)+)")


@dataclass(frozen=True, kw_only=True)
class Hierarchy:
    """The content of a container's ZIP.

    Attributes:
        header: attribute "fhash" of the root.
        arrays: metadata by path of the array, in the order of the file.
        chunks: members by the same path, and index of the chunk.
        variables: at least one.
        attributes: of the root beside the header.
    """

    header: dict[str, Any]
    arrays: dict[str, ArrayMetadata]
    chunks: dict[str, dict[tuple[int, ...], Member]]
    variables: tuple[VariablePlaces, ...]
    attributes: Mapping[str, Any]


def read_hierarchy(source: Source, members: Mapping[str, Member]) -> Hierarchy:
    """The hierarchy of the members.

    Raises DamagedFileError or UnsupportedFileError that names the member.
    """
    if DOCUMENT not in members:
        raise DamagedFileError(f"member {DOCUMENT} is missing")
    if source.gap:
        source.prefetch(
            (member.offset, member.header_size + member.size)
            for name, member in members.items()
            if name.rpartition("/")[2] == DOCUMENT and member.size <= MAX_BYTES
        )
    groups: dict[str, Mapping[str, Any]] = {}
    group_documents: dict[str, Mapping[str, Any]] = {}
    documents: dict[str, Mapping[str, Any]] = {}
    chunk_members: list[tuple[str, str, Member]] = []
    for name, member in members.items():
        node, _, file_name = name.rpartition("/")
        if file_name == DOCUMENT:
            document = _read_document(source, member)
            if document["node_type"] == "array":
                documents[node] = document
            else:
                groups[node] = document.get("attributes", {})
                group_documents[node] = document
        elif match := _CHUNK.fullmatch(name):
            chunk_members.append((match[1], match[2], member))
        else:
            raise DamagedFileError(f"member {name} belongs to no array")
    if "" not in groups or not isinstance(groups[""].get("fhash"), dict):
        raise DamagedFileError(f"member {DOCUMENT} is not the group of an fhash container")
    for node in [*documents, *groups]:
        if node and node.rpartition("/")[0] not in groups:
            raise DamagedFileError(f"member {node}/{DOCUMENT} lies in no group")
    # Another format says so in its header, and may have arrays of which nothing is known here.
    header = groups[""]["fhash"]
    variables, others = read_variables(header, documents.keys())
    _check_consolidated(group_documents, documents)
    arrays = _read_arrays(documents, others)
    for variable in variables:
        with variable_named(variable.name, len(variables)):
            arrays |= _read_arrays(documents, variable.places.values())
    return Hierarchy(
        header=header,
        arrays={path: arrays[path] for path in documents},
        chunks=_chunks_by_index(arrays, chunk_members),
        variables=tuple(variables),
        attributes={name: value for name, value in groups[""].items() if name != "fhash"},
    )


def _check_consolidated(
    groups: Mapping[str, Mapping[str, Any]], arrays: Mapping[str, Mapping[str, Any]]
) -> None:
    """Refuse a root that repeats other documents than the file has.

    A library that takes them from the root would show other values than this one.
    """
    repeated = groups[""].get(CONSOLIDATED)
    if repeated is not None:
        own = {name: document for name, document in groups.items() if name}
        if repeated != consolidated({**own, **arrays}):
            raise DamagedFileError(
                f"member {DOCUMENT}: {CONSOLIDATED} has other documents than the file"
            )


def _read_document(source: Source, member: Member) -> Mapping[str, Any]:
    """The zarr.json of a group, checked, or of an array."""
    # Checked before reading: the data of a chunk may be that large, metadata may not.
    if max(member.sizes) > MAX_BYTES:
        raise DamagedFileError(
            f"member {member.name}: {max(member.sizes)} bytes of metadata; the limit is {MAX_BYTES}"
        )
    data = read_member(source, member)
    with member_named(member.name):
        values = loads(data)
        if values.get("zarr_format") != 3 or values.get("node_type") not in ("array", "group"):
            raise UnsupportedFileError("not the metadata of a Zarr v3 array or group")
        if values["node_type"] == "group":
            check_keys(values, {*GROUP, "attributes"})
            attributes_of(values)
        return values


def _read_arrays(
    documents: Mapping[str, Mapping[str, Any]], paths: Iterable[str]
) -> dict[str, ArrayMetadata]:
    """The metadata of arrays by path. Raises errors that name the member."""
    arrays = {}
    for path in paths:
        with member_named(f"{path}/{DOCUMENT}"):
            arrays[path] = ArrayMetadata.from_dict(documents[path])
    return arrays


@contextmanager
def member_named(name: str) -> Iterator[None]:
    """A block whose errors about a file begin with the name of a member."""
    try:
        yield
    except DamagedFileError as error:
        raise type(error)(f"member {name}: {error}") from error


def _chunks_by_index(
    arrays: Mapping[str, ArrayMetadata], members: list[tuple[str, str, Member]]
) -> dict[str, dict[tuple[int, ...], Member]]:
    """The members of chunks by name of the array and index of the chunk.

    Raises DamagedFileError for a missing chunk, which must never read as the fill value, and for
    one too many, which could hide anything.
    """
    chunks: dict[str, dict[tuple[int, ...], Member]] = {name: {} for name in arrays}
    for name, key, member in members:
        if name not in arrays:
            raise DamagedFileError(f"member {member.name} belongs to no array")
        with member_named(member.name):
            chunks[name][arrays[name].parse_key(key)] = member
    for name, metadata in arrays.items():
        # Names are unique and indices lie within the grid, so an equal count means that no chunk
        # is missing.
        if len(chunks[name]) != prod(metadata.grid):
            raise DamagedFileError(
                f"array {name} has {len(chunks[name])} chunks; {prod(metadata.grid)} are declared"
            )
    return chunks
