"""Decoding at points between vertices, with the analytic gradient, with numpy alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.network import MAX_GRADIENT_SAMPLES, DenseLayers, Floats, Network
from fhash_codec.paper.pointwise import PointwiseLayers
from fhash_formats.errors import InputError, RegionError
from fhash_formats.support.threads import share_out, usable_threads

AXES = ("key_index", "z", "y", "x")
"""Names of the coordinates of a point, in order."""
CHUNK_POINTS = MAX_GRADIENT_SAMPLES
"""Points that one thread evaluates at a time."""
SMALL_READ = 2**20
"""Vertices of the finest table that a group of points may always span."""
LARGE_READ = 2**25
"""Vertices of the finest table that a group of points may never exceed."""
READ_PER_POINT = 16
"""Vertices of the finest table per point that a group may span between those two limits."""


@dataclass(frozen=True)
class Patch:
    """A part of one level's table in memory.

    Attributes:
        values: embeddings (t, z, y, x, E).
        first: vertex (t, z, y, x) of the level at which the part begins.
    """

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
    """Return the normalised values float32 (n,) at n points.

    With `gradient`, also return the derivatives float32 (n, 4) by key index, z, y and x, per key
    frame and per vertex. They are those of the model itself, through interpolation and layers:

    * On the border of two cells they are those of the cell after it; at the end of an axis, those
      of the last cell.
    * Along an axis of one vertex they are 0.
    * On a ReLU's kink they are those of its flat side.

    Points that lie close together share one read of a part of each table. A point has the same
    bits whatever other points are given with it, in whatever order (pointwise.py).

    Args:
        network: the trained network.
        key_index: times (n,) in [0, key_frames - 1].
        z, y, x: positions (n,) in vertices of the box, in [0, size - 1]. A single number stands for
            all points.
        gradient: whether to return the derivatives.
        threads: number of threads; None for one per processor.

    Raises:
        RegionError: a point is outside the box.
        InputError: the lengths of the arrays do not fit together.
    """
    threads = usable_threads(threads)
    points = _points(network, (key_index, z, y, x))
    count = points.shape[1]
    values = np.empty(count, np.float32)
    slopes = np.empty((count, 4) if gradient else (0, 4), np.float32)

    for group in _groups(network, points, np.arange(count)):
        patches = _patches(network, points[:, group])

        def evaluate(
            chunks: Sequence[npt.NDArray[np.intp]], patches: Sequence[Patch] = patches
        ) -> None:
            for chunk in chunks:
                values[chunk], chunk_slopes = _evaluate(
                    network, patches, points[:, chunk], gradient
                )
                if chunk_slopes is not None:
                    slopes[chunk] = chunk_slopes.T

        share_out(
            evaluate,
            [group[start : start + CHUNK_POINTS] for start in range(0, len(group), CHUNK_POINTS)],
            threads,
        )
    return (values, slopes) if gradient else values


def input_slopes(network: Network, points: npt.NDArray[np.float64]) -> Floats:
    """Return the derivatives float32 (inputs, n) of the value by each input of the network.

    The inputs are the interpolated embeddings, in the order of `Network`. The value is normalised.
    A part of each table that surrounds all points is read at once, so points of one call should lie
    close together.

    Args:
        network: the trained network.
        points: positions (4, n), key index, z, y and x, inside the box.
    """
    patches = _patches(network, points)
    slopes = np.empty((network.inputs, points.shape[1]), np.float32)
    for start in range(0, points.shape[1], CHUNK_POINTS):
        chunk = points[:, start : start + CHUNK_POINTS]
        layers = DenseLayers(network, chunk.shape[1])
        _encode(network, patches, chunk, layers.inputs)
        layers.run()
        slopes[:, start : start + chunk.shape[1]] = layers.gradient()[:, : chunk.shape[1]]
    return slopes


def interpolate(
    corners: Floats, after_weights: Iterable[Floats], gradient: bool
) -> tuple[Floats, list[Floats]]:
    """Interpolate corners (2, 2, ..., E, n) to (E, n), linearly along the leading axes in turn.

    The arrays may also be tensors of torch.

    Args:
        corners: embeddings of the corners of a cell, with one leading axis of length 2 for each
            weight.
        after_weights: for each leading axis, the weight of the corner after the point.
        gradient: whether to return the changes.

    Returns:
        The embeddings and, with `gradient`, their changes across the cell along each of these axes.
    """
    changes: list[Floats] = []
    for weight in after_weights:
        changes = [_between(change, weight) for change in changes]
        if gradient:
            changes.append(corners[1] - corners[0])
        corners = _between(corners, weight)
    return corners, changes


def _between(pair: Floats, after_weight: Floats) -> Floats:
    """Interpolate linearly between the two items of a pair."""
    result: Floats = pair[0] * (1 - after_weight) + pair[1] * after_weight
    return result


def _evaluate(
    network: Network, patches: Sequence[Patch], points: npt.NDArray[np.float64], gradient: bool
) -> tuple[Floats, Floats | None]:
    """Return values (n,) and, with `gradient`, derivatives (4, n) at points (4, n) in patches."""
    count = points.shape[1]
    layers = PointwiseLayers(network, count)
    slopes = _encode(network, patches, points, layers.inputs, gradient=gradient)
    values = layers.run()[:count]
    if not gradient:
        return values, None
    return values, layers.slopes(slopes)[:, :count]


def _encode(
    network: Network,
    patches: Sequence[Patch],
    points: npt.NDArray[np.float64],
    inputs: Floats,
    *,
    gradient: bool = False,
) -> Floats:
    """Write the interpolated embeddings at points (4, n) into the first n columns of `inputs`.

    Return their derivatives (4, inputs, columns) by the position; with `gradient` unset, none.
    """
    size, count = network.embedding_size, points.shape[1]
    slopes = np.zeros((4 if gradient else 0, network.inputs, inputs.shape[1]), np.float32)
    for level, patch in enumerate(patches):
        rows = slice(level * size, (level + 1) * size)
        before, after_weights, pace = _locate(network, level, points)
        corners = _corners(patch, before, network.levels[level])
        inputs[rows, :count], changes = interpolate(corners, after_weights, gradient)
        for axis, change in enumerate(changes):
            np.multiply(change, np.float32(pace[axis]), out=slopes[axis, rows, :count])
    return slopes


def _points(network: Network, arrays: Sequence[npt.ArrayLike]) -> npt.NDArray[np.float64]:
    """Return the points as one array (4, n) after checking them."""
    columns = [np.asarray(array, dtype=np.float64) for array in arrays]
    try:
        points = np.stack(np.broadcast_arrays(*(np.atleast_1d(column) for column in columns)))
    except ValueError:
        points = np.empty(0)
    if points.ndim != 2:
        raise InputError(
            f"points have shapes {', '.join(str(column.shape) for column in columns)}; "
            "one length (n,) is needed for key_index, z, y and x"
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
    """Find the cells of a level around points (4, n).

    Returns:
        The corner before each point (4, n), the weight in [0, 1] of the corner after it (4, n), and
        the corners per vertex of the box along each axis (4,).
    """
    corners = np.array(network.levels[level])[:, None]
    span = np.array([max(size - 1, 1) for size in (network.key_frames, *network.box_size)])[:, None]
    position = points * (corners - 1) / span
    before = np.minimum(position.astype(np.int64), np.maximum(corners - 2, 0))
    return before, (position - before).astype(np.float32), ((corners - 1) / span)[:, 0]


def _groups(
    network: Network, points: npt.NDArray[np.float64], chosen: npt.NDArray[np.intp]
) -> Iterator[npt.NDArray[np.intp]]:
    """Split chosen points into groups that each span a part of the finest table fit to be read.

    A part is fit if it is small, or if it holds many points and is not too large.
    """
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


def _patches(network: Network, points: npt.NDArray[np.float64]) -> list[Patch]:
    """Read the part of each level that surrounds all of some points (4, n)."""
    span = np.stack([points.min(axis=1), points.max(axis=1)], axis=1)
    return [_patch(network, level, span) for level in range(len(network.levels))]


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
    """Return the 16 corners around each point, float32 (t 2, z 2, y 2, x 2, E, n)."""
    shape = patch.values.shape
    strides = (math.prod(shape[1:4]), math.prod(shape[2:4]), shape[3], 1)
    index: npt.NDArray[np.int64] = np.zeros(before.shape[1], np.int64)
    for corner, first, stride in zip(before, patch.first, strides, strict=True):
        index += (corner - first) * stride
    # An axis of one vertex has no corner after it: both corners are the same.
    t_offsets, z_offsets, y_offsets, x_offsets = [
        (0, stride if length > 1 else 0) for stride, length in zip(strides, resolution, strict=True)
    ]
    offsets = np.array(
        [t + z + y + x for t in t_offsets for z in z_offsets for y in y_offsets for x in x_offsets]
    )
    embeddings = patch.values.reshape(-1, shape[4]).take(
        offsets[:, None] + index, axis=0, mode="clip"
    )
    return np.ascontiguousarray(np.moveaxis(embeddings, -1, 1), dtype=np.float32).reshape(
        2, 2, 2, 2, shape[4], -1
    )
