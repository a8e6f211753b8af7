"""Deterministic mutations of the golden containers: the same number always makes the same file.

There are two sorts. A damaged file is the result of an accident, which its checksums reveal. A
sealed file is the work of an attacker: all checksums and the digest are correct, so the mutation
reaches the code behind them. A sealed file may even be sound.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mutated_documents
import mutated_giants
import mutated_tiles
import mutated_zip
from containers import Parts, pack, unpack
from documents import Documents, NothingFitsError

GOLDENS = Path(__file__).parents[1] / "golden"
NEWEST = (
    "compact-clip",
    "compact-labels",
    "compact-counts",
    "compact-classes",
    "compact-linear",
    "compact-many-labels",
)
"""Goldens that take turns most evenly, with clipped values and with labels in turns: every kind
soon meets both."""


@dataclass(frozen=True, kw_only=True)
class Mutation:
    """One mutated file.

    Attributes:
        number: number of the mutation.
        golden: name of the golden that was mutated.
        kind: kind of the mutation.
        sealed: whether all checksums are correct.
        data: bytes of the file.
    """

    number: int
    golden: str
    kind: str
    sealed: bool
    data: bytes


@cache
def goldens() -> dict[str, tuple[bytes, Parts]]:
    """Return bytes and members of each golden by name, in the order of their turns."""
    others = [path.stem for path in sorted(GOLDENS.glob("*.fhz")) if path.stem not in NEWEST]
    names = []
    for number, name in enumerate(NEWEST):
        low, high = (n * len(others) // len(NEWEST) for n in (number, number + 1))
        names += [name, *others[low:high]]
    files = ((name, (GOLDENS / f"{name}.fhz").read_bytes()) for name in names)
    return {name: (data, unpack(data)) for name, data in files}


def mutation(number: int) -> Mutation:
    """Return the mutation of a number from 0 on; kinds and goldens take turns.

    A golden without what a kind changes is passed over for any other one.
    """
    names, kinds = list(goldens()), list(KINDS)
    turn, place = divmod(number, len(kinds))
    first = names.pop((turn + place) % len(names))
    for name in (first, *random.Random(number).sample(names, len(names))):
        try:
            return _mutation(number, name, kinds[place])
        except NothingFitsError:
            continue
    raise AssertionError(f"no golden has what {kinds[place]} changes")


def _mutation(number: int, golden: str, kind: str) -> Mutation:
    chance = random.Random(number)
    data, parts = goldens()[golden]
    if kind in OF_ONE and len(Documents(parts).headers) > 1:
        raise NothingFitsError
    if kind in DAMAGES:
        return Mutation(
            number=number, golden=golden, kind=kind, sealed=False, data=DAMAGES[kind](chance, data)
        )
    return Mutation(
        number=number, golden=golden, kind=kind, sealed=True, data=SEALED[kind](chance, parts)
    )


def _flip(chance: random.Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(chance.choice((1, 1, 1, 2, 8, 64))):
        changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def _cut(chance: random.Random, data: bytes) -> bytes:
    at = chance.randrange(len(data))
    return data[:at] if chance.random() < 0.7 else data[at:]


def _piece(chance: random.Random, data: bytes, most: int = 4096) -> tuple[int, int]:
    at = chance.randrange(len(data))
    return at, min(len(data), at + chance.randrange(1, most))


def _removed(chance: random.Random, data: bytes) -> bytes:
    low, high = _piece(chance, data)
    return data[:low] + data[high:]


def _doubled(chance: random.Random, data: bytes) -> bytes:
    low, high = _piece(chance, data)
    return data[:high] + data[low:]


def _swapped(chance: random.Random, data: bytes) -> bytes:
    a, b, c, d = sorted(chance.sample(range(len(data) + 1), 4))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _overwritten(chance: random.Random, data: bytes) -> bytes:
    low, high = _piece(chance, data, 512)
    new = bytes(high - low) if chance.random() < 0.5 else chance.randbytes(high - low)
    return data[:low] + new + data[high:]


def _surrounded(chance: random.Random, data: bytes) -> bytes:
    extra = chance.randbytes(chance.randrange(1, 300))
    return data + extra if chance.random() < 0.5 else extra + data


def _spliced(chance: random.Random, data: bytes) -> bytes:
    other, _ = chance.choice(list(goldens().values()))
    return data[: chance.randrange(len(data))] + other[chance.randrange(len(other)) :]


DAMAGES: dict[str, Callable[[random.Random, bytes], bytes]] = {
    "flipped": _flip,
    "cut": _cut,
    "removed": _removed,
    "doubled": _doubled,
    "swapped": _swapped,
    "overwritten": _overwritten,
    "surrounded": _surrounded,
    "spliced": _spliced,
}


def _packed(
    change: Callable[[random.Random, Parts], Parts],
) -> Callable[[random.Random, Parts], bytes]:
    """Return a change of members as a change of the file."""
    return lambda chance, parts: pack(change(chance, parts))


SEALED: dict[str, Callable[[random.Random, Parts], bytes]] = {
    **mutated_zip.KINDS,
    **{
        name: _packed(change)
        for module in (mutated_documents, mutated_tiles, mutated_giants)
        for name, change in module.KINDS.items()
    },
}
KINDS = (*DAMAGES, *SEALED)
PLAIN_KINDS = frozenset(("plain", "plain numbers", "plain giant", "occupancy"))
"""Kinds that change plain files, or arrays of occupancy, only."""
PARTIAL = PLAIN_KINDS | {
    *("sparse", "sparse giant", "source", "source giant"),
    *("part", "errors", "grown", "index", "mlp"),
}
"""Kinds that pass over goldens without what they change."""
SAME = frozenset(("together",))
"""Kinds of sealed files that hold what their golden does."""
OF_ONE = PLAIN_KINDS | {"length", "giant", "clip", "integers", "grown", "sparse", "sparse giant"}
"""Kinds that change files of one variable only."""
