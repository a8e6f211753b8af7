"""Decoding at points between vertices, with the analytic gradient, with numpy alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.network import COLUMNS, PRODUCTS, DenseLayers, Floats, Network
from fhash_codec.paper.pointwise import PointwiseLayers
from fhash_formats.errors import InputError, RegionError
from fhash_formats.support.threads import share_out, usable_threads

AXES = ("key_index", "z", "y", "x")
CHUNK_POINTS = PRODUCTS * COLUMNS
SMALL_READ, LARGE_READ, READ_PER_POINT = 2**20, 2**25, 16
"""Vertices of the finest table: so many are always read at once, never more than so many, and between them so many per point."""


@dataclass(frozen=True)
class Patch:
    """A part of one level's table in memory, (t, z, y, x, E), and the vertex at which it begins."""

    values: npt.NDArray[Any]
    first: tuple[int, ...]


@overload
def sample_points(
    network: Network,
    key_index: npt.ArrayLike,
    z: npt.ArrayLike,
    y: npt.ArrayLike,
    x: npt.ArrayLike,
    *,
    gradient: Literal[False] = ...,
    threads: int | None = ...,
) -> Floats: ...


@overload
def sample_points(
    network: Network,
    key_index: npt.ArrayLike,
    z: npt.ArrayLike,
    y: npt.ArrayLike,
    x: npt.ArrayLike,
    *,
    gradient: Literal[True],
    threads: int | None = ...,
) -> tuple[Floats, Floats]: ...


def sample_points(
    network: Network,
    key_index: npt.ArrayLike,
    z: npt.ArrayLike,
    y: npt.ArrayLike,
    x: npt.ArrayLike,
    *,
    gradient: bool = False,
    threads: int | None = None,
) -> Floats | tuple[Floats, Floats]:
    """Normalised values float32 (n,) at n points; with `gradient` also float32 (n, 4), the derivatives by key index, z, y and x.

    key_index: (n,) in [0, key_frames - 1]; z, y, x: (n,) in vertices of the box, in [0, size - 1]; a single number stands for all.
    The derivatives are those of the model itself, through interpolation and network, per key frame and per vertex. On the border
    of two cells they are those of the cell after it, at the end of an axis those of the last cell, along an axis of one vertex 0;
    on a ReLU's kink those of its flat side. Points that lie close together are read together: a part of each table at a time.
    A point has the same bits whatever other points are given with it, in whatever order (pointwise.py).
    Raises RegionError for a point outside the box, InputError for arrays that do not fit together.
    """
    threads = usable_threads(threads)
    points = _points(network, (key_index, z, y, x))
    count = points.shape[1]
    values = np.empty(count, np.float32)
    slopes = np.empty((count, 4) if gradient else (0, 4), np.float32)

    for group in _groups(network, points, np.arange(count)):
        span = np.stack([points[:, group].min(axis=1), points[:, group].max(axis=1)], axis=1)
        patches = [_patch(network, level, span) for level in range(len(network.levels))]

        def work(
            chunks: Sequence[npt.NDArray[np.intp]], patches: Sequence[Patch] = patches
        ) -> None:
            for chunk in chunks:
                values[chunk], slope = _evaluate(network, patches, points[:, chunk], gradient)
                if slope is not None:
                    slopes[chunk] = slope.T

        share_out(
            work,
            [group[start : start + CHUNK_POINTS] for start in range(0, len(group), CHUNK_POINTS)],
            threads,
        )
    return (values, slopes) if gradient else values


def feature_slopes(network: Network, points: npt.NDArray[np.float64]) -> Floats:
    """Derivatives float32 (features, n) of the normalised value by each interpolated embedding at points (4, n) of the box, in order.

    Points that lie close together are read together: those of one call should.
    """
    span = np.stack([points.min(axis=1), points.max(axis=1)], axis=1)
    patches = [_patch(network, level, span) for level in range(len(network.levels))]
    slopes = np.empty((network.features, points.shape[1]), np.float32)
    for start in range(0, points.shape[1], CHUNK_POINTS):
        chunk = points[:, start : start + CHUNK_POINTS]
        count = chunk.shape[1]
        head = DenseLayers(network, count)
        for level, patch in enumerate(patches):
            before, after, _ = _locate(network, level, chunk)
            rows = slice(level * network.embedding_size, (level + 1) * network.embedding_size)
            head.inputs[rows, :count] = interpolate(
                _corners(patch, before, network.levels[level]), after, False
            )[0]
        head.run()
        slopes[:, start : start + count] = head.gradient()[:, :count]
    return slopes


def _evaluate(
    network: Network, patches: Sequence[Patch], points: npt.NDArray[np.float64], gradient: bool
) -> tuple[Floats, Floats | None]:
    """Values (n,) at points (4, n) within the patches and, if asked for, derivatives (4, n)."""
    size, count = network.embedding_size, points.shape[1]
    layers = PointwiseLayers(network, count)
    changes = np.zeros((4 if gradient else 0, len(layers.inputs) - 1, layers.inputs.shape[1]), "f4")
    for level, patch in enumerate(patches):
        rows = slice(level * size, (level + 1) * size)
        before, after, pace = _locate(network, level, points)
        corners = _corners(patch, before, network.levels[level])
        layers.inputs[rows, :count], across = interpolate(corners, after, gradient)
        for axis, change in enumerate(across):
            np.multiply(change, np.float32(pace[axis]), out=changes[axis, rows, :count])
    values = layers.run()[:count]
    return values, layers.slopes(changes)[:, :count] if gradient else None


def _points(network: Network, arrays: Sequence[npt.ArrayLike]) -> npt.NDArray[np.float64]:
    """The points as one array (4, n), checked."""
    columns = [np.asarray(array, dtype=np.float64) for array in arrays]
    try:
        points = np.stack(np.broadcast_arrays(*(np.atleast_1d(column) for column in columns)))
    except ValueError:
        points = np.empty(0)
    if points.ndim != 2:
        raise InputError(
            f"points have shapes {', '.join(str(c.shape) for c in columns)}; one length (n,) is needed for key_index, z, y and x"
        )
    for axis, column, size in zip(
        AXES, points, (network.key_frames, *network.box_size), strict=True
    ):
        outside = np.flatnonzero(~((column >= 0) & (column <= size - 1)))
        if len(outside):
            raise RegionError(
                f"point {outside[0]}: {axis} {column[outside[0]]:g} is outside 0..{size - 1}"
            )
    return points


def _locate(
    network: Network, level: int, points: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.int64], Floats, npt.NDArray[np.float64]]:
    """The corner before each point (4, n), the weight in [0, 1] of the corner after it (4, n), and corners per vertex (4,)."""
    corners = np.array(network.levels[level])[:, None]
    span = np.array([max(size - 1, 1) for size in (network.key_frames, *network.box_size)])[:, None]
    position = points * (corners - 1) / span
    before = np.minimum(position.astype(np.int64), np.maximum(corners - 2, 0))
    return before, (position - before).astype(np.float32), ((corners - 1) / span)[:, 0]


def _groups(
    network: Network, points: npt.NDArray[np.float64], chosen: npt.NDArray[np.intp]
) -> Iterator[npt.NDArray[np.intp]]:
    """Split points until the part of the finest table that a group spans is small, or well filled and not too large to be read at once."""
    if not len(chosen):
        return
    low, high = points[:, chosen].min(axis=1), points[:, chosen].max(axis=1)
    extent = np.floor(high) - np.floor(low) + 2
    if math.prod(extent) <= min(LARGE_READ, max(SMALL_READ, READ_PER_POINT * len(chosen))):
        yield chosen
        return
    axis = int(np.argmax(extent))
    below = points[axis, chosen] < np.floor((low[axis] + high[axis] + 1) / 2)
    yield from _groups(network, points, chosen[below])
    yield from _groups(network, points, chosen[~below])


def _patch(network: Network, level: int, span: npt.NDArray[np.float64]) -> Patch:
    """Read the part of a level that surrounds all points between the ends of a span (4, 2)."""
    first, last = _locate(network, level, span)[0].T.tolist()
    ends = (
        min(corner + 2, length) for corner, length in zip(last, network.levels[level], strict=True)
    )
    values = network.read(
        level, tuple(slice(start, stop) for start, stop in zip(first, ends, strict=True))
    )
    return Patch(np.ascontiguousarray(values), tuple(first))


def _corners(patch: Patch, before: npt.NDArray[np.int64], resolution: Sequence[int]) -> Floats:
    """The 16 corners around each point: float32 (t 2, z 2, y 2, x 2, E, n)."""
    shape = patch.values.shape
    strides = (math.prod(shape[1:4]), math.prod(shape[2:4]), shape[3], 1)
    index: npt.NDArray[np.int64] = np.zeros(before.shape[1], np.int64)
    for corner, first, stride in zip(before, patch.first, strides, strict=True):
        index += (corner - first) * stride
    # An axis of one vertex has no corner after it: both are the same.
    steps = [
        (0, stride if length > 1 else 0) for stride, length in zip(strides, resolution, strict=True)
    ]
    offsets = np.array(
        [t + z + y + x for t in steps[0] for z in steps[1] for y in steps[2] for x in steps[3]]
    )
    found = patch.values.reshape(-1, shape[4]).take(offsets[:, None] + index, axis=0, mode="clip")
    return np.ascontiguousarray(np.moveaxis(found, -1, 1), dtype=np.float32).reshape(
        2, 2, 2, 2, shape[4], -1
    )


def interpolate(
    corners: Floats, after: Iterable[Floats], gradient: bool
) -> tuple[Floats, list[Floats]]:
    """Corners, as (2, 2, 2, 2, E, n), to (E, n), linearly along the first axes in turn, one for each weight of the corner after it.

    With `gradient` also the change across the cell along each of these axes, in their order. Also for tensors of torch.
    """
    changes: list[Floats] = []
    for weight in after:
        changes = [_between(change, weight) for change in changes]
        if gradient:
            changes.append(corners[1] - corners[0])
        corners = _between(corners, weight)
    return corners, changes


def _between(pair: Floats, weight: Floats) -> Floats:
    result: Floats = pair[0] * (1 - weight) + pair[1] * weight
    return result
