"""How an array is cut into chunks."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod


def slab_shape(shape: Sequence[int], itemsize: int, limit: int) -> tuple[int, ...]:
    """The chunk of an array of `shape` with at most `limit` bytes (and at least one value): all of it, or else slabs of equal thickness.

    Leading axes are cut first, to single positions before the next is touched.
    """
    chunk = list(shape)
    for axis, length in enumerate(shape):
        rest = itemsize * prod(chunk[:axis] + chunk[axis + 1 :])
        parts = -(-length // max(1, limit // max(1, rest)))
        chunk[axis] = -(-length // max(1, parts))
    return tuple(chunk)
