"""Mutations of heads and masks in arrays of their own, which version 1.4 of the format added.

All checksums are correct. A file without such arrays is passed over.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from typing import Any

from containers import Parts, with_crc
from documents import DOCUMENT, OTHERS, dumped
from mutated_payload import (
    NothingFitsError,
    coding,
    configuration_of,
    damaged,
    documents_of,
    inner_chunks,
    is_sharded,
    replaced,
    shard_of,
)

TABLE = "tables/level_1"
CODECS = ("fhash.head", "fhash.mask", "fhash.transform", "bytes")


def _apart(chance: random.Random, parts: Parts) -> Parts:
    """Change names, codecs, shapes or bytes of the parts of a table, or what the header says."""
    documents = documents_of(parts)
    names = [name for name in documents if coding(documents[name]) in CODECS[:2]]
    if not names:
        raise NothingFitsError
    name, turn = chance.choice(names), chance.randrange(7)
    document, table = documents[name], documents[TABLE]
    if turn == 0:
        _named_otherwise(chance, configuration_of(table))
        return replaced(parts, {f"{TABLE}/{DOCUMENT}": dumped(table)})
    if turn == 1:
        _codecs_of(document)[0] = {
            "name": chance.choice(CODECS),
            "configuration": chance.choice(({}, {"a": 1}, configuration_of(table))),
        }
        return replaced(parts, {f"{name}/{DOCUMENT}": dumped(document)})
    if turn == 2:
        document["shape"] = [chance.choice((1, n, n + 1, 2 * n, 2**40)) for n in document["shape"]]
        return replaced(parts, {f"{name}/{DOCUMENT}": dumped(document)})
    if turn == 3:  # gone, or under another name
        other = chance.choice(("", "mlp/other", "occupancy/bits", "tables/level_2"))
        kept = [item for item in parts if not item[0].startswith(f"{name}/")]
        renamed = [
            (member.replace(name, other, 1), data)
            for member, data in parts
            if member.startswith(f"{name}/")
        ]
        return [*kept[:-1], *(renamed if other else []), kept[-1]]
    if turn == 4:
        root = json.loads(dict(parts)[DOCUMENT])
        header = root["attributes"]["fhash"]
        gone = chance.choice(("apart", "mask", "cross", "transform"))
        header["required_features"] = [f for f in header["required_features"] if f != gone]
        header["model"]["head"] = chance.choice(OTHERS)
        return replaced(parts, {DOCUMENT: dumped(root)})
    return _bytes_changed(chance, parts, name, document)


def _named_otherwise(chance: random.Random, configuration: dict[str, Any]) -> None:
    """Change the name of an array in the configuration of the table."""
    keys = [key for key in ("head", "mask") if isinstance(configuration.get(key), dict)]
    key = chance.choice(keys)
    others: tuple[Any, ...] = (
        "mlp/parameters",
        "occupancy/mask",
        TABLE,
        "../a",
        "x" * 9000,
        "",
        *OTHERS,
    )
    turn = chance.randrange(3)
    if turn == 0:
        configuration[key] = chance.choice(others)
    elif turn == 1:
        configuration[key]["array"] = chance.choice(others)
    else:
        del configuration[key]["array"]


def _codecs_of(document: dict[str, Any]) -> Any:
    """Return the codecs of an array, or of its inner chunks."""
    codecs = document["codecs"]
    return codecs[0]["configuration"]["codecs"] if is_sharded(document) else codecs


def _bytes_changed(
    chance: random.Random, parts: Parts, name: str, document: dict[str, Any]
) -> Parts:
    """Change a part itself: bytes of a head, or masks, which may also change places."""
    member, data = chance.choice([item for item in parts if item[0].startswith(f"{name}/c/")])
    sharding, present, chunks = inner_chunks(document, member, data)
    if len(chunks) > 1 and chance.random() < 0.4:
        chance.shuffle(chunks)
    else:
        at = chance.randrange(len(chunks))
        changed = chance.choice(
            (b"", b"\0", chance.randbytes(300), damaged(chance, chunks[at][:-4]))
        )
        chunks[at] = with_crc(changed)
    return replaced(parts, {member: shard_of(sharding, present, chunks)})


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {"apart": _apart}
