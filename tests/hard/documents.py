"""Documents of a container, hostile values for them, and rules that say what takes which."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Iterator, Sequence
from math import prod
from typing import Any

import numpy as np
from containers import Parts, with_crc
from numcodecs.zstd import compress, decompress

from fhash_formats.container.header import TABLE
from fhash_formats.container.hierarchy import path_of

DOCUMENT = "zarr.json"
"""End of the names of metadata documents; alone, the name of the root's."""
GROUP = b'{"zarr_format":3,"node_type":"group"}'
LARGE = (
    *(2**n for n in (16, 20, 24, 28, 31, 32, 40, 60, 62, 63, 64)),
    *(2**31 - 1, 2**53 + 1, 2**63 - 1, 2**64 - 1, 10**30, 10**400),
)
NUMBERS: tuple[Any, ...] = (0, 1, 2, 3, 5, 7, 10, 11, 64, -1, -(2**60), -(2**63), *LARGE)
FLOATS = (
    *(0.5, -0.5, -0.0, 1.5, 1e-12, 1e308, -1e308, 1.7976931348623157e308, 2.3e-308, 5e-324),
    *(3.4e38, -3.4e38, 1e-45, 1e39, 1e16),
)
SPECIAL = (math.nan, math.inf, -math.inf)
OTHERS: tuple[Any, ...] = (
    *(True, False, None, [], [0], [[]], {}, {"a": 1}, {"must_understand": False}),
    *("", "x", "9/7", "klt", "\x00", "../x", "1", "\ud7ff", "\n", "NaN", "x" * 70_000),
    *([1] * 70_000, [None] * 5, {str(n): n for n in range(3000)}),
)


class NothingFitsError(LookupError):
    """Raised for a file without what a mutation changes."""


def _nest(depth: int) -> Any:
    """Return dicts and lists that are nested in turns."""
    value: Any = 1
    for level in range(depth):
        value = [value] if level % 2 else {"a": value}
    return value


def hostile(chance: random.Random, old: Any) -> Any:
    """Return a value in place of another one.

    It mostly has the same type, because other types are refused at once.
    """
    near: Sequence[Any] = ()
    if isinstance(old, int) and not isinstance(old, bool):
        large = old >= 2**80
        near = (*NUMBERS, old + 1, old - 1, -old, 2 * old, 0 if large else old * old + 1)
        near = (*near, 1e300 if large else float(old))
    elif isinstance(old, float):
        near = (*FLOATS, *SPECIAL, -old, old * 1e6, old * 1e-6, old * 1e30)
        near = (*near, int(old) if math.isfinite(old) else 0)
    elif isinstance(old, list) and old:
        near = (old[:-1], [*old, old[-1]], old[::-1], old * 2, [old], [old[0]] * len(old), [])
        near = (*near, sorted(old, key=str))
    elif isinstance(old, str):
        near = (old[:-1], old + "x", old.upper(), old * 2, old[::-1])
    if near and chance.random() < (0.4 if isinstance(old, str) else 0.6):
        return chance.choice(near)
    return chance.choice(
        (*OTHERS, *NUMBERS, *FLOATS, *SPECIAL, _nest(chance.choice((10, 60, 70, 400))))
    )


Place = tuple[Any, Any]
"""A dict or list, and a key or index in it."""


def places(value: Any) -> Iterator[Place]:
    """Yield the place of every value of a document."""
    for key in (
        value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    ):
        yield value, key
        yield from places(value[key])


GONE = object()
"""Value of a rule that removes the key."""
Rule = tuple[str, Sequence[Any] | Callable[[random.Random, Any], Any]]
"""Places where a document changes, and what may stand there: values, or a function of the old one.

Words of a path are keys; `*` is any key or index, `a|b` one of two, `**` any place below."""


def put(chance: random.Random, top: Any, rules: Sequence[Rule]) -> None:
    """Change a document by one of some rules; raises NothingFitsError where none finds its path."""
    for path, values in chance.choices(rules, k=40):
        *way, last = path.split(".")
        try:
            holder = top
            for word in way:
                holder = holder[_key(chance, holder, word)]
            if last == "**":
                holder, key = chance.choice(list(places(holder)))
            else:
                key = _key(chance, holder, last)
            if isinstance(holder, list) and key >= len(holder):
                continue
            old = holder.get(key) if isinstance(holder, dict) else holder[key]
            new = values(chance, old) if callable(values) else chance.choice(values)
        except (LookupError, TypeError):  # not in this document
            continue
        if new is GONE:
            holder.pop(key, None)
        else:
            holder[key] = new
        return
    raise NothingFitsError


def _key(chance: random.Random, holder: Any, word: str) -> Any:
    if word == "*":
        return chance.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    word = chance.choice(word.split("|"))
    return int(word) if isinstance(holder, list) else word


def dumped(values: Any) -> bytes:
    """Return the values as JSON."""
    return json.dumps(values).encode()


def replaced(parts: Parts, new: dict[str, bytes]) -> Parts:
    return [(name, new.get(name, data)) for name, data in parts]


def without(parts: Parts, *beginnings: str) -> Parts:
    """Return the members whose names have none of some beginnings."""
    return [(name, data) for name, data in parts if not name.startswith(beginnings)]


def groups_of(parts: Parts) -> dict[str, bytes]:
    """Return the documents of the groups in which the nodes of a file lie, but for the root."""
    names = [name.split("/")[:-2] for name, _ in parts if name.endswith(f"/{DOCUMENT}")]
    return {
        "/".join([*folders[:depth], DOCUMENT]): GROUP
        for folders in names
        for depth in range(1, len(folders) + 1)
    }


def added(parts: Parts, new: Parts, root: Any = None) -> Parts:
    """Return a file with further members before those that it has, and groups for their documents;
    the root's document is last."""
    every = {**groups_of(new), **dict(new), **dict(parts)}
    document = every.pop(DOCUMENT, b"")
    return [*every.items(), (DOCUMENT, document if root is None else dumped(root))]


class Documents:
    """The documents of a sound file, to be changed.

    Attributes:
        root: document of the root; `top` is its attribute `fhash`.
        headers: of the variables; `header` is the first one.
        arrays: documents of arrays by their paths; `table` is the path of the first variable's.
    """

    def __init__(self, parts: Parts) -> None:
        self.parts = parts
        self.root: dict[str, Any] = json.loads(dict(parts)[DOCUMENT])
        self.top: dict[str, Any] = self.root["attributes"]["fhash"]
        self.headers: list[dict[str, Any]] = self.top["variables"]
        self.header = self.headers[0]
        documents = ((name, json.loads(data)) for name, data in parts if name.endswith(DOCUMENT))
        self.arrays: dict[str, dict[str, Any]] = {
            name.rpartition("/")[0]: values
            for name, values in documents
            if values["node_type"] == "array"
        }
        self.table = path_of(self.header, TABLE)

    def members(self, name: str) -> list[str]:
        """Return the names of the chunks of an array; of one of tiles, those of its index."""
        return [member for member, _ in self.parts if member.startswith(f"{name}/c/")]

    def values(self, member: str) -> np.ndarray[Any, Any]:
        """Return the values of a chunk of an ordinary array, or of the index of one of tiles."""
        dtype = self.arrays[member[: member.rindex("/c/")]]["data_type"]
        return np.frombuffer(decompress(dict(self.parts)[member][:-4]), dtype).copy()

    def packed(self, new: dict[str, bytes] | None = None) -> Parts:
        """Return the file with the documents as they are now, and some other chunks."""
        documents = {f"{name}/{DOCUMENT}": dumped(values) for name, values in self.arrays.items()}
        return replaced(self.parts, {**documents, DOCUMENT: dumped(self.root), **(new or {})})


def is_plain(file: Documents) -> bool:
    """Whether a sound file is a plain one."""
    return "plain" in file.top["required_features"]


def stored(values: np.ndarray[Any, Any]) -> bytes:
    """Return a chunk of an ordinary array."""
    return with_crc(compress(values.tobytes(), 1))


def array_of_zeros(name: str, shape: list[int], dtype: str, path: str = "") -> Parts:
    """Return the members of an array of one chunk; key frames ascend.

    path: in the file; the name by default.
    """
    ascending = name == "key_frames"
    values = np.arange(prod(shape), dtype=dtype) if ascending else np.zeros(prod(shape), dtype)
    if name == "occupancy":
        values[:] = 255
    little = {} if dtype == "uint8" else {"configuration": {"endian": "little"}}
    document = {
        "zarr_format": 3, "node_type": "array", "shape": shape, "data_type": dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": shape}},
        "chunk_key_encoding": {"name": "default"},
        "fill_value": 0 if np.dtype(dtype).kind in "iu" else 0.0,
        "codecs": [
            {"name": "bytes", **little},
            {"name": "zstd", "configuration": {"level": 1, "checksum": False}},
            {"name": "crc32c"},
        ],
    }  # fmt: skip
    chunk = f"{path or name}/c/" + "/".join("0" * len(shape))
    return [(f"{path or name}/{DOCUMENT}", dumped(document)), (chunk, stored(values))]


def header_of(parts: Parts) -> Any:
    """Return the header of the first variable."""
    return Documents(parts).header
