"""Chunks of arrays: shapes of a bounded size, and the regions that they cover."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

from fhash_formats.errors import RegionError


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


def common_part(
    index: Sequence[int], chunk: Sequence[int], bounds: Sequence[tuple[int, int]]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """The part that a region shares with a chunk: its slices in the region, and in the chunk.

    Args:
        index: place of the chunk in the grid of chunks.
        chunk: shape of a full chunk.
        bounds: first vertex and end of the region along each axis; the region and the chunk meet.
    """
    in_region, in_chunk = [], []
    for i, n, (start, stop) in zip(index, chunk, bounds, strict=True):
        low, high = max(start, i * n), min(stop, (i + 1) * n)
        in_region.append(slice(low - start, high - start))
        in_chunk.append(slice(low - i * n, high - i * n))
    return tuple(in_region), tuple(in_chunk)


def region_bounds(
    region: Sequence[slice], shape: Sequence[int], what: str
) -> list[tuple[int, int]]:
    """First vertex and end along each axis of a region of slices.

    what: the array, for messages. Raises RegionError for a region that is not in the shape.
    """
    if len(region) != len(shape):
        raise RegionError(f"{what}: a region of {len(region)} axes; the array has {len(shape)}")
    bounds = []
    for axis, (span, length) in enumerate(zip(region, shape, strict=True)):
        start = 0 if span.start is None else int(span.start)
        stop = length if span.stop is None else int(span.stop)
        if span.step not in (None, 1) or not 0 <= start <= stop <= length:
            raise RegionError(
                f"{what}: {span} on axis {axis}; slices without step within 0..{length} are allowed"
            )
        bounds.append((start, stop))
    return bounds
