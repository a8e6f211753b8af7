"""The Zarr v3 hierarchy in a ZIP: members become a header and arrays.

Every member must have a place in the hierarchy, and every array must have all of its chunks.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

from fhash_formats.container import strict_json
from fhash_formats.container.array import ArrayMetadata, attributes_of, check_keys
from fhash_formats.container.layout import Member
from fhash_formats.container.source import Source
from fhash_formats.container.zip_checked import DOCUMENT, read_member
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

GROUP: dict[str, Any] = {"zarr_format": 3, "node_type": "group"}
"""The zarr.json of a group without attributes."""

_CHUNK = re.compile(r"(.+)/(c(?:/[0-9]+)+)")


@dataclass(frozen=True, kw_only=True)
class Hierarchy:
    """The content of a container's ZIP.

    Attributes:
        header: attribute "fhash" of the root.
        arrays: metadata by name of the array.
        chunks: members by name of the array and index of the chunk.
    """

    header: dict[str, Any]
    arrays: dict[str, ArrayMetadata]
    chunks: dict[str, dict[tuple[int, ...], Member]]


def read_hierarchy(source: Source, members: Mapping[str, Member]) -> Hierarchy:
    """The hierarchy of the members.

    Raises DamagedFileError or UnsupportedFileError that names the member.
    """
    if DOCUMENT not in members:
        raise DamagedFileError(f"member {DOCUMENT} is missing")
    groups: dict[str, Mapping[str, Any]] = {}
    arrays: dict[str, ArrayMetadata] = {}
    chunk_members: list[tuple[str, str, Member]] = []
    for name, member in members.items():
        node, _, file_name = name.rpartition("/")
        if file_name == DOCUMENT:
            document = _read_document(source, member)
            if isinstance(document, ArrayMetadata):
                arrays[node] = document
            else:
                groups[node] = document
        elif match := _CHUNK.fullmatch(name):
            chunk_members.append((match[1], match[2], member))
        else:
            raise DamagedFileError(f"member {name} belongs to no array")
    if "" not in groups or not isinstance(groups[""].get("fhash"), dict):
        raise DamagedFileError(f"member {DOCUMENT} is not the group of an fhash container")
    for node in [*arrays, *groups]:
        if node and node.rpartition("/")[0] not in groups:
            raise DamagedFileError(f"member {node}/{DOCUMENT} lies in no group")
    return Hierarchy(
        header=groups[""]["fhash"], arrays=arrays, chunks=_place_chunks(arrays, chunk_members)
    )


def _read_document(source: Source, member: Member) -> ArrayMetadata | Mapping[str, Any]:
    """The metadata of an array or the attributes of a group."""
    # Checked before reading: the data of a chunk may be that large, metadata may not.
    if max(member.sizes) > strict_json.MAX_BYTES:
        raise DamagedFileError(
            f"member {member.name}: {max(member.sizes)} bytes of metadata; "
            f"the limit is {strict_json.MAX_BYTES}"
        )
    data = read_member(source, member)
    try:
        values = strict_json.loads(data)
        if values.get("zarr_format") != 3 or values.get("node_type") not in ("array", "group"):
            raise UnsupportedFileError("not the metadata of a Zarr v3 array or group")
        if values["node_type"] == "array":
            return ArrayMetadata.from_dict(values)
        check_keys(values, {*GROUP, "attributes"})
        return attributes_of(values)
    except DamagedFileError as error:
        raise type(error)(f"member {member.name}: {error}") from error


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
        try:
            chunks[name][arrays[name].parse_key(key)] = member
        except DamagedFileError as error:
            raise DamagedFileError(f"member {member.name}: {error}") from error
    for name, metadata in arrays.items():
        # Names are unique and indices lie within the grid, so an equal count means that no chunk
        # is missing.
        if len(chunks[name]) != prod(metadata.grid):
            raise DamagedFileError(
                f"array {name} has {len(chunks[name])} chunks; {prod(metadata.grid)} are declared"
            )
    return chunks
