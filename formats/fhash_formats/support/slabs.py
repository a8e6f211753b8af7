"""Chunk shapes of a bounded size."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod


def slab_shape(shape: Sequence[int], itemsize: int, limit: int) -> tuple[int, ...]:
    """The shape of chunks with at most `limit` bytes, but at least one value.

    An array within the limit is one chunk. A larger one is cut into slabs of equal thickness.
    Leading axes are cut first, down to single positions before the next axis is cut.

    Args:
        shape: of the array.
        itemsize: bytes of a value.
        limit: bytes of a chunk.
    """
    chunk = list(shape)
    for axis, length in enumerate(shape):
        layer_bytes = itemsize * prod(chunk[:axis] + chunk[axis + 1 :])
        slabs = -(-length // max(1, limit // max(1, layer_bytes)))
        chunk[axis] = -(-length // max(1, slabs))
    return tuple(chunk)
