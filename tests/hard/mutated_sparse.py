"""Mutations of tables of needed vertices alone.

All checksums are correct. A file without what a kind changes is passed over.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from math import prod
from typing import Any

from containers import Parts
from documents import DOCUMENT, LARGE, OTHERS, dumped, header_of, hostile, path_of, places
from mutated_payload import NothingFitsError, documents_of, replaced
from mutated_plain import array_of_zeros

NAMES = ("parts/0.tables.level_1", "parts/0.tables.level_2")


def _header(parts: Parts) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Return what `header_of` gives for a file of sparse tables."""
    root, top, header = header_of(parts)
    if "sparse" not in header["model"]:
        raise NothingFitsError
    return root, top, header


def _sparse(chance: random.Random, parts: Parts) -> Parts:
    """Change what says which vertices a table has: header, counts, levels, features."""
    root, top, header = _header(parts)
    model, turn = header["model"], chance.randrange(7)
    if turn < 3:
        return _counts(chance, parts)
    if turn == 3:
        kinds = ("coreset", "fringe", "all", *OTHERS)
        model["sparse"] = chance.choice(kinds)
        if chance.random() < 0.2:
            del model["sparse"]
    elif turn == 4:
        names = ([], ["sparse-tables"] * 2, ["sparse-tables", "transform"], ["transform"])
        top["required_features"] = chance.choice(names)
        model["tables"] = chance.choice(("float16", "float32", "uint8", "transform"))
    elif turn == 5:
        levels = model["levels"]
        turned = [level[::-1] for level in levels]
        model["levels"] = chance.choice(
            (levels[:1], levels[:-1], [*levels, levels[-1]], levels[::-1], turned, levels[:1] * 3)
        )
    else:
        holder, key = chance.choice(list(places(model)))
        holder[key] = hostile(chance, holder[key])
    return replaced(parts, {DOCUMENT: dumped(root)})


def _counts(chance: random.Random, parts: Parts) -> Parts:
    """Change the counts of a table, often so that their sum stays."""
    name = chance.choice(NAMES)
    document = documents_of(parts)[name]
    counts = document["attributes"]["counts"]
    turn = chance.randrange(6)
    if turn < 2:
        a, b = chance.randrange(len(counts)), chance.randrange(len(counts))
        moved = chance.choice((1, counts[a], -1))
        counts[a] -= moved
        counts[b] += moved
    elif turn == 2:
        counts[chance.randrange(len(counts))] = chance.choice((*LARGE, *OTHERS, -1, 0, 1.5))
    elif turn == 3:
        document["attributes"]["counts"] = chance.choice(
            ([], counts[1:], [*counts, 0], counts[::-1], *OTHERS)
        )
    elif turn == 4:
        del document["attributes"]["counts"]
    else:
        document["shape"] = [sum(counts) + chance.choice((-1, 1, 1 << 40)), document["shape"][1]]
    return replaced(parts, {f"{name}/{DOCUMENT}": dumped(document)})


def _giant_sparse(chance: random.Random, parts: Parts) -> Parts:
    """Declare a giant volume in a file of a few kilobytes that has few or all of its vertices."""
    root, _, header = _header(parts)
    shape = [1, 1, 1, 1]
    vertices = 1 << chance.choice((16, 18, 20, 22, 24))
    while prod(shape) < vertices:
        shape[chance.randrange(1, 4)] *= 2
    header["quality"].pop("steps", None)
    header["domain"]["shape"] = shape
    header["feature_bounding_box"] = [[0, n] for n in shape[1:]]
    header["model"].update(levels=[shape], embedding_size=1, hidden_layers=0, tables="float16")
    bits = -(-prod(shape) // 8)
    rows = chance.choice((1, 8, vertices))
    arrays: list[tuple[str, list[int], str]] = [
        ("tables/level_1", [rows, 1], "float16"),
        ("mlp/weight_1", [1, 1], "float32"),
        ("mlp/bias_1", [1], "float32"),
        ("key_frames", [1], "int64"),
        ("occupancy/bits", [len(header["features"]), 1, bits], "uint8"),
        *(
            (f"coords/{axis}", [n], "float64")
            for axis, n in zip(("time", "z", "y", "x"), shape, strict=True)
        ),
    ]
    gone = ("parts/", *(f"{name}/" for name in header["dimensions"]))
    kept = [(name, data) for name, data in parts if not name.startswith(gone) and name != DOCUMENT]
    kept.append((f"parts/{DOCUMENT}", dumped({"zarr_format": 3, "node_type": "group"})))
    for name, lengths, dtype in arrays:
        kept += array_of_zeros(name, lengths, dtype, path_of(header, name))
    table = documents_of(kept)[NAMES[0]]
    table["attributes"] = {"counts": [rows]}
    return replaced([*kept, (DOCUMENT, dumped(root))], {f"{NAMES[0]}/{DOCUMENT}": dumped(table)})


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "sparse": _sparse,
    "sparse giant": _giant_sparse,
}
