"""The Zarr v3 hierarchy in a ZIP: members become a header and arrays.

Every member must have a place in the hierarchy, and every array must have all of its chunks.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from typing import Any

from fhash_formats.container import strict_json
from fhash_formats.container.array import ArrayMetadata, attributes_of, check_keys
from fhash_formats.container.source import Source
from fhash_formats.container.variables import (
    CONSOLIDATED,
    VariablePlaces,
    consolidated,
    read_variables,
    variable_named,
)
from fhash_formats.container.zip_file import DOCUMENT, Member, read_member
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

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
            if name.rpartition("/")[2] == DOCUMENT and member.size <= strict_json.MAX_BYTES
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
        chunks=_place_chunks(arrays, chunk_members),
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
    if max(member.sizes) > strict_json.MAX_BYTES:
        raise DamagedFileError(
            f"member {member.name}: {max(member.sizes)} bytes of metadata; "
            f"the limit is {strict_json.MAX_BYTES}"
        )
    data = read_member(source, member)
    with member_named(member.name):
        values = strict_json.loads(data)
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


def _place_chunks(
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
