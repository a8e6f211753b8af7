"""Mutations of parts of a series, and of files that grew.

All checksums are correct. A file that is neither is passed over.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from math import prod

import numpy as np
from containers import Parts, with_crc
from documents import DOCUMENT, FLOATS, LARGE, OTHERS, dumped, header_of, hostile, path_of, places
from mutated_payload import SPECIAL, NothingFitsError, coding, documents_of, replaced, tile_of
from mutated_plain import array_of_zeros
from numcodecs.zstd import compress, decompress

from fhash_formats.container.hierarchy import part_place

ERRORS = "parts/0.steps.errors"
TABLE = "tables/level_1"
WHOLE = (
    *(
        "tables/level_1",
        "coords/x",
        "coords/time",
        "missing/bits",
        "steps/errors",
        "auxiliary/wide",
    ),
    *("auxiliary/other", "occupancy/mask", "x", "whole/x"),
)
"""Names of arrays that the whole is said to have."""
NUMBERS = (*FLOATS, *SPECIAL, 1.7e308, -1.0, 2.0**63, 0.0)


def _part(chance: random.Random, parts: Parts) -> Parts:
    """Change what a part says of itself and of the whole."""
    root, _, header = header_of(parts)
    if "part" not in header:
        raise NothingFitsError
    part, turn = header["part"], chance.randrange(9)
    if turn == 0:
        key = chance.choice(("number", "of", "first", "steps", "size", "nonzero"))
        part[key] = chance.choice((0, 1, 2, 3, 5, 7, *LARGE, -1, part[key] + 1, part[key] - 1))
    elif turn == 1:
        part["ssim_steps"] = chance.choice(([], [0], [4, 4], [5], [-1], [0] * 70_000, 3, *OTHERS))
    elif turn == 2:
        part["source"] = chance.choice(({}, {"dimensions": []}, {"dimensions": ["t"]}, *OTHERS))
    elif turn == 3 and "source" in part:
        holder, key = chance.choice(list(places(part["source"])))
        holder[key] = hostile(chance, holder[key])
    elif turn == 4:
        header["model"]["gains"] = chance.choice(
            ([], [[]], [["a", 1]], [["a", 1, 2]] * 3, [{"what": "a", "bytes": 1}], *OTHERS)
        )
    elif turn == 5:
        bulk = chance.choice(({"range": [0, 1]}, {"range": []}, {"range": None}, {}, [1], "x", 3))
        header["quality"]["bulk"] = bulk
    elif turn == 6:
        header["model"]["parameters"] = chance.choice((1, 2, *LARGE[:12]))
    elif turn == 7:
        return _whole(chance, parts)
    else:
        holder, key = chance.choice(list(places(part)))
        holder[key] = hostile(chance, holder[key])
    return replaced(parts, {DOCUMENT: dumped(root)})


def _whole(chance: random.Random, parts: Parts) -> Parts:
    """Give a part arrays that the whole is said to have, small and large."""
    length = chance.choice((1, 3, 1 << 20, 1 << 22))
    name = f"whole/{chance.choice(WHOLE)}"
    kind = chance.choice(("float64", "uint8", "int64"))
    added = array_of_zeros(name, [length], kind, part_place(0, name))
    kept = [item for item in parts if item[0] != DOCUMENT]
    return [*dict([*added, *kept]).items(), (DOCUMENT, dict(parts)[DOCUMENT])]


def _errors(chance: random.Random, parts: Parts) -> Parts:
    """Change the sums of errors of a part, or the form of their array."""
    documents = documents_of(parts)
    if ERRORS not in documents:
        raise NothingFitsError
    document = documents[ERRORS]
    if chance.random() < 0.15:
        document["shape"] = chance.choice(([1, 10], [3, 10], [2, 9], [20], [2, 10, 1]))
        return replaced(parts, {f"{ERRORS}/{DOCUMENT}": dumped(document)})
    changed = {}
    for member, data in parts:
        if member.startswith(f"{ERRORS}/c/"):
            values = np.frombuffer(decompress(data[:-4]), document["data_type"]).copy()
            for _ in range(chance.choice((1, 1, 3, values.size))):
                values[chance.randrange(values.size)] = chance.choice(NUMBERS)
            changed[member] = with_crc(compress(values.tobytes(), 1))
    return replaced(parts, changed)


def _grown(chance: random.Random, parts: Parts) -> Parts:
    """Change what the next layers depend on: promise, range, figures, tiles, times, history."""
    root, _, header = header_of(parts)
    table = path_of(header, TABLE)
    document = documents_of(parts).get(table)
    growing = document is not None and coding(document) == "fhash.transform"
    if not growing or "max_error" not in header.get("config", {}) or "part" in header:
        raise NothingFitsError
    turn, quality = chance.randrange(10), header["quality"]
    if turn == 0:
        key = chance.choice(("max_error", "max_error_rel", "effort", "tile", "psnr", "seed"))
        header["config"][key] = chance.choice((*FLOATS, *OTHERS, 0, 1, 10**30, "1x1x1x1"))
    elif turn == 1:
        header["value_range"] = sorted(chance.choices((*FLOATS, 0.0, 1.0), k=2))
    elif turn == 2 and "steps" in quality:
        errors = quality["steps"]
        key = chance.choice(list(errors))
        errors[key] = chance.choice(
            ([], errors[key][:-1], [0] * 8, [None] * 8, [10**9] * 8, [-(10**9)] * 8, *OTHERS)
        )
    elif turn == 3:
        steps = header["domain"]["shape"][0]
        figures = chance.choices((0, 1, -1, -2, 30_000, -(2**31) + 1, 2**31 - 1), k=steps + 1)
        quality["steps"] = {"rmse": figures, "max_abs_error": figures[::-1]}
    elif turn == 4:
        shape = header["domain"]["shape"]
        shape[0] = chance.choice((1, 2, 3, 5, 6, 8))
        assert document is not None
        document["shape"][0] = shape[0]
        header["model"]["levels"][0][0] = shape[0]
    elif turn == 5:
        steps = header["domain"]["shape"][0]
        header.setdefault("coordinates", {})["time"] = chance.choice(
            (
                {"values": chance.choices((*FLOATS, 0, 1), k=steps)},
                {"values": [0] * steps},
                {"start": 1e308, "step": 1e308},
                {"start": 0, "step": -1},
                {"dtype": "float32", "start": 3e38, "step": 1e38},
            )
        )
    elif turn == 6:
        header["encoder"] = chance.choice(({}, {"version": "9"}, {"version": "9", "seed": 10**30}))
    elif turn == 7:
        header["model"]["parameters"] = chance.choice((1, *LARGE[:12]))
        header["model"]["gains"] = chance.choice(OTHERS)
        header["history"] = chance.choice(([], {}, {"epoch": [1] * 70_000}))
    elif turn == 8:
        return _beside(chance, parts)
    else:
        holder, key = chance.choice(list(places(quality))) if quality else (header, "quality")
        holder[key] = hostile(chance, holder[key])
    return replaced(parts, {f"{table}/{DOCUMENT}": dumped(document), DOCUMENT: dumped(root)})


def _beside(chance: random.Random, parts: Parts) -> Parts:
    """Add an array that a growing file would have to carry on."""
    names = ("extra", "steps/errors", "steps/figures", "auxiliary/a", "occupancy/bits", "coords/x")
    name, (_, _, header) = chance.choice(names), header_of(parts)
    tile = tile_of(documents_of(parts)[path_of(header, TABLE)])
    length = chance.choice((1, 7, prod(tile), 1 << 22))
    kind = chance.choice(("float64", "uint8"))
    path = name if name == "extra" else path_of(header, name)
    added = array_of_zeros(name, [length], kind, path)
    if path.startswith("parts/"):
        added = [(f"parts/{DOCUMENT}", b'{"zarr_format":3,"node_type":"group"}'), *added]
    kept = [item for item in parts if item[0] != DOCUMENT]
    return [*dict([*added, *kept]).items(), (DOCUMENT, dict(parts)[DOCUMENT])]


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "part": _part,
    "errors": _errors,
    "grown": _grown,
}
