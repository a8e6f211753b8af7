"""Documents of a container and hostile values for them."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterator
from typing import Any

from fhash_formats.container.header import POSITIONS, TABLE
from fhash_formats.container.hierarchy import part_place

DOCUMENT = "zarr.json"
"""End of the names of metadata documents; alone, the name of the root's."""
LARGE = (
    *(
        2**16,
        2**20,
        2**24,
        2**28,
        2**31 - 1,
        2**31,
        2**32,
        2**40,
        2**53 + 1,
        2**60,
        2**62,
        2**63 - 1,
        2**63,
        2**64 - 1,
        2**64,
    ),
    *(10**30, 10**400),
)
NUMBERS: tuple[Any, ...] = (0, 1, 2, 3, 5, 7, 10, 11, 64, -1, -(2**60), -(2**63), *LARGE)
FLOATS = (
    0.5,
    -0.5,
    -0.0,
    1.5,
    1e-12,
    1e308,
    -1e308,
    1.7976931348623157e308,
    2.3e-308,
    5e-324,
    3.4e38,
    -3.4e38,
    1e-45,
    1e39,
    1e16,
)
SPECIAL = (math.nan, math.inf, -math.inf)
OTHERS: tuple[Any, ...] = (
    *(
        True,
        False,
        None,
        "",
        "x",
        "9/7",
        "klt",
        "\x00",
        "../x",
        "1",
        "\ud7ff",
        "\n",
        "NaN",
        "x" * 70_000,
        [],
        [0],
        [[]],
        {},
        {"a": 1},
    ),
    *([1] * 70_000, [None] * 5, {"must_understand": False}, {str(n): n for n in range(3000)}),
)


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
    turn = chance.random()
    if isinstance(old, int) and not isinstance(old, bool) and turn < 0.6:
        return chance.choice(
            (
                *NUMBERS,
                old + 1,
                old - 1,
                -old,
                2 * old,
                old * old + 1 if old < 2**80 else 0,
                float(old) if old < 2**80 else 1e300,
            )
        )
    if isinstance(old, float) and turn < 0.6:
        return chance.choice(
            (
                *FLOATS,
                *SPECIAL,
                -old,
                old * 1e6,
                old * 1e-6,
                old * 1e30,
                int(old) if math.isfinite(old) else 0,
            )
        )
    if isinstance(old, list) and old and turn < 0.6:
        return chance.choice(
            (
                old[:-1],
                [*old, old[-1]],
                old[::-1],
                [*old] * 2,
                [old],
                [old[0]] * len(old),
                [],
                sorted(old, key=str),
            )
        )
    if isinstance(old, str) and turn < 0.4:
        return chance.choice((old[:-1], old + "x", old.upper(), old * 2, old[::-1]))
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


def dumped(values: Any) -> bytes:
    """Return the values as JSON."""
    return json.dumps(values).encode()


def header_of(parts: list[tuple[str, bytes]]) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """Return the root document, its attribute `fhash`, and the header of the first variable."""
    root = json.loads(dict(parts)[DOCUMENT])
    top = root["attributes"]["fhash"]
    return root, top, top["variables"][0]


def path_of(header: dict[str, Any], name: str) -> str:
    """Return the path of an array of the first variable in a sound file."""
    if name == TABLE:
        return str(header.get("array", part_place(0, name)))
    if name.startswith("coords/"):
        return str(header["dimensions"][POSITIONS.index(name.removeprefix("coords/"))])
    return part_place(0, name)
