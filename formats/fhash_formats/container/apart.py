"""Parts of a coded table that lie in arrays of their own: its head and its masks.

Writers of the versions 1.4 to 1.7 put them there in large files. The codec of the table names these
arrays (FORMAT.md, Parts apart). A reader puts the head back into the settings of the codec when a
file is opened, and each mask behind the stream of its tile.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fhash_formats.container.coding import HEAD, MASK, TRANSFORM, Codec
from fhash_formats.container.sharding import SHARDING
from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.apart import without_names

__all__ = ["HEAD_ARRAY", "MASK_ARRAY", "TABLE", "inline", "transform_settings", "with_settings"]

TABLE = "tables/level_1"
"""Array of the table."""
HEAD_ARRAY = "mlp/parameters"
"""Array of the weights and biases of the table's head."""
MASK_ARRAY = "occupancy/mask"
"""Array of the masks of the table's tiles."""

_PARTS = {"head": (HEAD_ARRAY, HEAD), "mask": (MASK_ARRAY, MASK)}
"""Array and codec of a part, by its key in the configuration of the table's codec."""

Document = Mapping[str, Any]
"""The zarr.json of an array."""


def inline(documents: Mapping[str, Document], chunk: Callable[[str], bytes]) -> dict[str, Document]:
    """The documents of a file's arrays, the table's as if it had its head and masks itself.

    Args:
        documents: zarr.json by name of the array.
        chunk: gives the bytes of an array's only chunk, by the name of the array.

    Raises DamagedFileError where the table names another array, or one that is not there or has
    another codec, and where an array with such a codec is not named.
    """
    for name, document in documents.items():
        codec = _first(document.get("codecs")).get("name")
        if codec in (HEAD, MASK) and (name, codec) not in _PARTS.values():
            raise DamagedFileError(f"array {name} is coded by {codec} but belongs to no table")
        if name != TABLE and without_names(transform_settings(document.get("codecs")))[1]:
            raise DamagedFileError(f"array {name} has no head or masks in other arrays")
    settings = transform_settings(documents.get(TABLE, {}).get("codecs"))
    whole = without_names(settings)[0]
    replaced: dict[str, Any] = {}
    for key, (array, codec) in _PARTS.items():
        part = settings.get(key)
        named = part.get("array") if isinstance(part, Mapping) else None
        there = _first(documents.get(array, {}).get("codecs")).get("name") == codec
        if named is None and not there:
            continue
        if named != array or not there:
            raise DamagedFileError(
                f"array {TABLE} names {ascii(named)[:80]} as the place of its {key}; "
                f"{array} is {'there' if there else f'no array coded by {codec}'}"
            )
        replaced[key] = (
            base64.b64encode(chunk(array)).decode("ascii") if key == "head" else whole["mask"]
        )
    result = dict(documents)
    if replaced:
        table = documents[TABLE]
        result[TABLE] = {**table, "codecs": with_settings(table["codecs"], replaced)}
    return result


def _first(codecs: object) -> Mapping[str, Any]:
    """The first codec of inner chunks; an empty one where the list is none of codecs."""
    first = codecs[0] if isinstance(codecs, list) and codecs else None
    if not isinstance(first, Mapping):
        return {}
    configuration = first.get("configuration")
    if first.get("name") == SHARDING and isinstance(configuration, Mapping):
        inner = configuration.get("codecs")
        # Shards of shards are refused later; here they must not recurse without end.
        first = inner[0] if isinstance(inner, list) and inner else {}
    return first if isinstance(first, Mapping) else {}


def transform_settings(codecs: object) -> Mapping[str, Any]:
    """The configuration of `fhash.transform`, in shards or not; an empty one for other codecs."""
    first = _first(codecs)
    configuration = first.get("configuration")
    is_transform = first.get("name") == TRANSFORM and isinstance(configuration, Mapping)
    return configuration if is_transform and isinstance(configuration, Mapping) else {}


def with_settings(codecs: Sequence[Codec], settings: Mapping[str, Any]) -> list[Codec]:
    """Codecs whose `fhash.transform`, within shards or without, has other settings as well."""
    first, *others = codecs
    configuration = first["configuration"]
    if first["name"] == SHARDING:
        inner = with_settings(configuration["codecs"], settings)
        return [{**first, "configuration": {**configuration, "codecs": inner}}, *others]
    return [{**first, "configuration": {**configuration, **settings}}, *others]
