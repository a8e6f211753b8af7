"""Chunks of arrays: shapes of a bounded size, and the region that a chunk covers."""

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


def chunk_region(
    index: Sequence[int], chunk: Sequence[int], shape: Sequence[int]
) -> tuple[slice, ...]:
    """The region of an array that a chunk covers, cut at the array's end.

    Args:
        index: place of the chunk in the grid of chunks.
        chunk: shape of a full chunk.
        shape: of the array.
    """
    spans = zip(index, chunk, shape, strict=True)
    return tuple(slice(i * n, min((i + 1) * n, length)) for i, n, length in spans)
