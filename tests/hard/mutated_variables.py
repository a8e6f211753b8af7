"""Mutations of variables: their number, names, places and what they share.

All checksums are correct. Some kinds pass over files of one variable.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from copy import deepcopy
from typing import Any

from containers import Parts
from documents import DOCUMENT, LARGE, OTHERS, dumped, hostile, places
from mutated_payload import NothingFitsError, documents_of, replaced

NODES = (
    *(
        "u",
        "v",
        "time",
        "x",
        "parts",
        "tables",
        "zarr.json",
        "",
        "a.b",
        "a/b",
        "__u",
        "x" * 101,
    ),
    *("consolidated_metadata", "coords", "auxiliary", "U"),
)
"""Names of arrays: of others, of groups, and those that are not allowed."""
SHARED = (
    *("auxiliary/lat", "auxiliary/lon", "auxiliary/none", "tables/level_1", "coords/x", "../u"),
    *("auxiliary/", "", "occupancy/bits"),
)
"""Internal names of arrays that a variable may say to share."""
Root = dict[str, Any]


def root_of(parts: Parts) -> tuple[Root, list[dict[str, Any]]]:
    """Return the root document, and the headers of its variables."""
    root = json.loads(dict(parts)[DOCUMENT])
    listed: list[dict[str, Any]] = root["attributes"]["fhash"]["variables"]
    return root, listed


def is_several(parts: Parts) -> bool:
    """Whether a sound file holds several variables."""
    return len(root_of(parts)[1]) > 1


def consolidated(parts: Parts) -> Parts:
    """Return the file with the documents as they are in its consolidated metadata."""
    documents = {
        name.removesuffix(f"/{DOCUMENT}"): json.loads(data)
        for name, data in parts
        if name.endswith(f"/{DOCUMENT}")
    }
    root = json.loads(dict(parts)[DOCUMENT])
    if not isinstance(root, dict) or "consolidated_metadata" not in root:
        return parts
    root["consolidated_metadata"] = {
        "kind": "inline",
        "must_understand": False,
        "metadata": documents,
    }
    return replaced(parts, {DOCUMENT: dumped(root)})


def _variables(chance: random.Random, parts: Parts) -> Parts:
    """Change the list of variables: keys of one, their number and order, those of the root."""
    root, listed = root_of(parts)
    header, turn = chance.choice(listed), chance.randrange(9)
    top = root["attributes"]["fhash"]
    if turn == 0:
        key = chance.choice(("name", "array"))
        header[key] = chance.choice(
            (*NODES, *(other.get(key) for other in listed), hostile(chance, "u"))
        )
    elif turn == 1:
        names = chance.choice(listed)["dimensions"]
        header["dimensions"] = chance.choice(
            (
                names,
                names[::-1],
                names[:3],
                [*names, "w"],
                [names[0]] * 4,
                chance.choices(NODES, k=4),
            )
        )
    elif turn == 2:
        chance.shuffle(listed)
        del listed[chance.randrange(1, len(listed) + 1) :]
    elif turn == 3:
        listed.append(deepcopy(header))
        for key in ("name", "array"):
            listed[-1][key] = chance.choice(("again", header.get(key)))
    elif turn == 4:
        features = top["required_features"]
        top["required_features"] = chance.choice(
            ([], features[1:], features[:1], [*features, "novelty"], features * 9, ["plain"], 3)
        )
    elif turn == 5:
        other = chance.choice(listed)
        key = chance.choice(list(header))
        header[key] = deepcopy(other.get(key))
    elif turn == 6:
        holder, key = chance.choice(list(places(header)))
        holder[key] = hostile(chance, holder[key])
    elif turn == 7:
        top["variables"] = chance.choice(([], {}, None, listed[0], [[]], [None], listed * 2))
    else:
        key = chance.choice(list(top))
        top[key] = hostile(chance, top[key])
    return replaced(parts, {DOCUMENT: dumped(root)})


def _shares(chance: random.Random, parts: Parts) -> Parts:
    """Change which arrays a variable shares, or the shared array."""
    root, listed = root_of(parts)
    header = chance.choice(listed)
    numbers = range(-1, len(listed) + 1)
    if chance.random() < 0.6:
        header["shares"] = {
            chance.choice(SHARED): chance.choice((*[*numbers] * 20, *NODES, None, 1.0, True, []))
            for _ in range(chance.choice((1, 1, 2)))
        }
    else:
        header["shares"] = chance.choice(OTHERS)
    if chance.random() < 0.3:
        source = chance.choice([other.get("source") for other in listed])
        header["source"] = deepcopy(source)
    return replaced(parts, {DOCUMENT: dumped(root)})


def _places(chance: random.Random, parts: Parts) -> Parts:
    """Put an array at another place: among the parts, at the root, to another variable."""
    _, listed = root_of(parts)
    names = [name for name in documents_of(parts) if name]
    name, number = chance.choice(names), chance.randrange(len(listed) + 1)
    node = str(listed[0].get("array", "u"))
    other = chance.choice(
        (
            *(
                f"parts/{number}.{end}"
                for end in ("tables.level_1", "coords.x", "key_frames", "", "..")
            ),
            *(
                f"parts/{chance.choice(NODES)}.mlp.bias_1",
                f"{node}_2",
                f"parts/{number}",
                "extra/a",
            ),
            *(chance.choice(names), chance.choice(NODES)),
        )
    )
    copied = chance.random() < 0.4
    changed: dict[str, bytes] = {}
    for member, data in parts:
        mine = member.startswith(f"{name}/")
        if mine:
            changed[f"{other}{member[len(name) :]}"] = data
        if copied or not mine:
            changed.setdefault(member, data)
    root_document = changed.pop(DOCUMENT)
    return [*changed.items(), (DOCUMENT, root_document)]


def _consolidated(chance: random.Random, parts: Parts) -> Parts:
    """Change the copies of the documents in the root, or the original of one."""
    root, _ = root_of(parts)
    if "consolidated_metadata" not in root:
        raise NothingFitsError
    turn = chance.randrange(4)
    if turn == 0:
        holder, key = chance.choice(list(places(root["consolidated_metadata"])))
        holder[key] = hostile(chance, holder[key])
    elif turn == 1:
        metadata = root["consolidated_metadata"]["metadata"]
        metadata[chance.choice((*NODES, "parts/u.a"))] = chance.choice(list(metadata.values()))
    elif turn == 2:
        root["consolidated_metadata"] = chance.choice(OTHERS)
    else:
        del root["consolidated_metadata"]
    return replaced(parts, {DOCUMENT: dumped(root)})


def _many(chance: random.Random, parts: Parts) -> Parts:
    """Declare hundreds of variables, on one grid or each on its own, and long lists."""
    root, listed = root_of(parts)
    header = min(listed, key=lambda one: len(json.dumps(one)))
    own = listed.index(header)
    count, own_grid = chance.choice((30, 200, 700)), chance.random() < 0.4
    axis = chance.randrange(4)
    grid, table = header["dimensions"][axis], header.get("array", "u")
    below = [
        (name, data)
        for name, data in parts
        if name.startswith((f"{table}/", f"parts/{own}.")) and name != DOCUMENT
    ]
    positions = [(name, data) for name, data in parts if name.startswith(f"{grid}/")]
    added: Parts = []
    for number in range(count):
        node = f"n{number}"
        copy = {**header, "name": node, **({"array": node} if "array" in header else {})}
        if own_grid:
            copy["dimensions"] = [*header["dimensions"]]
            copy["dimensions"][axis] = f"g{number}"
            added += [(name.replace(grid, f"g{number}", 1), data) for name, data in positions]
        listed.append(copy)
        added += [
            (
                name.replace(f"/{own}.", f"/{len(listed) - 1}.", 1)
                if name.startswith("parts/")
                else name.replace(f"{table}/", f"{node}/", 1),
                data,
            )
            for name, data in below
        ]
    if chance.random() < 0.3:
        features = root["attributes"]["fhash"]["required_features"]
        features[:0] = ["transform"] * chance.choice((1000, 200_000))
    if chance.random() < 0.3:
        group = b'{"zarr_format":3,"node_type":"group"}'
        added = [*((f"e{number}/{DOCUMENT}", group) for number in range(3000)), *added]
    kept = [(name, data) for name, data in parts if name != DOCUMENT]
    return [*dict([*added, *kept]).items(), (DOCUMENT, dumped(root))]


def _large(chance: random.Random, parts: Parts) -> Parts:
    """Change a length in all documents of a file, so that they agree."""
    root, listed = root_of(parts)
    axis = chance.randrange(4)
    old = chance.choice(listed)["domain"]["shape"][axis]
    new = chance.choice((1, old + 1, 2 * old, 100, *LARGE[:8]))
    for header in listed:
        header["quality"].pop("steps", None)
    changed = {}
    for name, data in parts:
        values = root if name == DOCUMENT else json.loads(data) if name.endswith(DOCUMENT) else None
        if values is None:
            continue
        for holder, key in list(places(values)):
            if type(holder[key]) is int and holder[key] == old and isinstance(holder, list):
                holder[key] = new
        changed[name] = dumped(values)
    return replaced(parts, changed)


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "variables": _variables,
    "shares": _shares,
    "places": _places,
    "consolidated": _consolidated,
    "many variables": _many,
    "variables length": _large,
}
