"""Chunks of a view: about a megabyte, cut from tiles or joined of them.

A chunk is decoded for one request. A chunk of a few kilobytes costs a client more in requests than
in decoding; one of many megabytes makes it wait for values that it did not ask for. The container's
cache keeps decoded tiles, so that the chunks of one tile decode it once.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

__all__ = ["view_chunks"]

MOST_BYTES = 2 << 20
"""Bytes of a chunk, at most."""
FEW_BYTES = 256 << 10
"""Bytes up to which tiles are joined to one chunk."""

Shape4 = tuple[int, int, int, int]


def view_chunks(shape: Sequence[int], tile: Sequence[int], itemsize: int) -> Shape4:
    """The shape of chunks (t, z, y, x) of a view.

    A large tile is cut to fewer steps first, since most clients show one step at a time, then to
    blocks whose sides are alike, since slices along any axis are asked for. Small tiles are joined
    in space. Chunks begin where tiles do, if the feature bounding box begins at vertex 0 and a tile
    has sides that can be divided.

    Args:
        shape: vertices (t, z, y, x) of the array.
        tile: vertices (t, z, y, x) that are decoded together.
        itemsize: bytes of a value.
    """
    t, *space = (min(length, along) for length, along in zip(shape, tile, strict=True))
    single = [along >= length for length, along in zip(shape, tile, strict=True)]
    frame = itemsize * prod(space)
    steps = max(1, min(t, MOST_BYTES // frame))
    parts = -(-t // steps)
    t = -(-t // parts) if single[0] else max(n for n in range(1, steps + 1) if t % n == 0)
    while itemsize * prod(space) > MOST_BYTES and max(space) > 1:
        axis = space.index(max(space))
        space[axis] = _part(space[axis], whole=single[1 + axis])
    return _joined([t, *space], shape, itemsize)


def _part(length: int, *, whole: bool) -> int:
    """A half or a third of a side; the larger half where that does not divide it.

    whole: whether one tile is as long as the axis, so that no chunk can reach into another tile.
    """
    divisor = next((n for n in (2, 3) if length % n == 0), None)
    return -(-length // 2) if whole or divisor is None else length // divisor


def _joined(chunk: list[int], shape: Sequence[int], itemsize: int) -> Shape4:
    """The chunk with its sides doubled while it is small: the shortest in space first, t last."""
    while True:
        longer = [min(2 * side, length) for side, length in zip(chunk, shape, strict=True)]
        fitting = [
            axis
            for axis, side in enumerate(chunk)
            if side < longer[axis] and itemsize * prod(chunk) // side * longer[axis] <= FEW_BYTES
        ]
        if not fitting:
            t, z, y, x = chunk
            return t, z, y, x
        axis = min(fitting, key=lambda axis: (axis == 0, chunk[axis]))
        chunk[axis] = longer[axis]
