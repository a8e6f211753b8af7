"""Basic indexing as numpy has it, for what is decoded and not in memory: a volume or a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import prod
from types import EllipsisType

import numpy as np

from fhash_codec.coreset.boxes import Box, Sizes, Spans
from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import AXES

MAX_LOD = 10
"""Coarsest level of detail: every 1024th vertex."""

BLOCK = 1 << 18
"""Most vertices of several steps that are read together; they take a few MiB in all forms."""

Index = int | slice | EllipsisType
"""One part of an index."""


def expand_index(
    index: Index | tuple[Index, ...], axes: Sequence[str] = AXES, what: str = "a volume"
) -> list[int | slice]:
    """One integer or slice per axis: full slices replace `...` and missing axes.

    axes: names of the axes. what: what is indexed, for messages.

    Raises RegionError for other kinds of indices, and for too many parts.
    """
    parts = list(index) if isinstance(index, tuple) else [index]
    for part in parts:
        if part is not Ellipsis and (
            isinstance(part, bool) or not isinstance(part, int | np.integer | slice)
        ):
            raise RegionError(
                f"{what} is indexed by integers, slices and '...', "
                f"not by {type(part).__name__}; take np.asarray of it for more"
            )
    ellipses = [number for number, part in enumerate(parts) if part is Ellipsis]
    if len(ellipses) > 1 or len(parts) - len(ellipses) > len(axes):
        names = ", ".join(axes)
        raise RegionError(
            f"{what} has {len(axes)} axes ({names}); the index has {len(parts)} parts"
        )
    at = ellipses[0] if ellipses else len(parts)
    fill = [slice(None)] * (len(axes) - len(parts) + len(ellipses))
    expanded = [*parts[:at], *fill, *parts[at + len(ellipses) :]]
    return [part for part in expanded if part is not Ellipsis]


def index_ranges(
    parts: Sequence[int | slice], shape: Sequence[int], axes: Sequence[str] = AXES
) -> list[range]:
    """The positions along each axis that an expanded index names.

    Raises RegionError for an integer outside its axis.
    """
    return [
        _positions(part, length, axis)
        for part, length, axis in zip(parts, shape, axes, strict=True)
    ]


def _positions(part: int | slice, length: int, axis: str) -> range:
    if isinstance(part, slice):
        return range(length)[part]
    if not -length <= part < length:
        raise RegionError(f"index {part} is outside axis {axis} of {length}")
    return range(part % length, part % length + 1)


def slice_of(positions: range, first: int) -> slice:
    """The slice that takes positions of an axis from an array that begins at `first` of it."""
    start, stop = positions.start - first, positions.stop - first
    # A stop before the first position would count from the end.
    return slice(start, stop if stop >= 0 else None, positions.step)


def step_blocks(steps: range, shape: Sizes) -> Iterator[tuple[slice, range]]:
    """Cut steps into neighbouring ones that are read together, so that a block stays small.

    steps: of any stride. shape: (z, y, x) of one frame. Yields places in `steps`, and the steps
    there, which follow one another.
    """
    many = max(1, BLOCK // prod(shape)) if steps.step == 1 else 1
    for place in range(0, len(steps), many):
        together = steps[place : place + many]
        alone = together if len(together) > 1 else range(together[0], together[0] + 1)
        yield slice(place, place + len(together)), alone


def checked_region(region: Spans | None, shape: Sequence[int], path: str) -> Box:
    """The box of a region in vertices (z, y, x) of a domain; the whole domain for None.

    Raises RegionError, naming the path, for a region that is empty or outside the domain.
    """
    if region is None:
        return Box.of_shape(shape)
    for axis, (low, high), length in zip(AXES[1:], region, shape, strict=True):
        if not 0 <= low < high <= length:
            raise RegionError(
                f"{path}: region {low}:{high} of axis {axis} is empty or outside 0:{length}"
            )
    return Box.of(region)


def coarse_vertices(box: Box, region: Box, lod: int, path: str) -> tuple[range, range, range]:
    """Every 2^lod-th vertex (z, y, x) of the feature bounding box that lies in a region.

    Raises InputError for another level of detail than 0 to MAX_LOD, RegionError, naming the path,
    for a region without such a vertex.
    """
    if isinstance(lod, bool) or not isinstance(lod, int | np.integer) or not 0 <= lod <= MAX_LOD:
        raise InputError(f"lod is {lod}; allowed: 0 to {MAX_LOD}")
    every = 1 << int(lod)
    vertices = []
    for axis, (first, end), (low, high) in zip(AXES[1:], box, region, strict=True):
        start = first + -(-max(low - first, 0) // every) * every
        along = range(start, min(high, end), every)
        if not along:
            raise RegionError(
                f"{path}: region {low}:{high} of axis {axis} holds no vertex of level of "
                f"detail {lod}, every {every}. from {first} to {end - 1}"
            )
        vertices.append(along)
    z, y, x = vertices
    return z, y, x


def shared_part(box: Box, region: Box) -> tuple[Box, Box] | None:
    """The vertices that a region shares with a box; None if there are none.

    They are returned twice: in vertices of the region, and in vertices of the box.
    """
    common = box.intersect(region)
    if common is None:
        return None
    in_region = common.shift(-first for first in region.first)
    return in_region, common.shift(-first for first in box.first)
