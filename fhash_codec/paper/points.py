"""Decoding at points between vertices, with the analytic gradient.

The native library evaluates the points (native_points.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Literal, overload

import numpy as np
import numpy.typing as npt

from fhash_codec.native import network as native
from fhash_codec.paper.native_points import NativePoints
from fhash_codec.paper.network import MAX_GRADIENT_SAMPLES, DenseLayers, Floats, Network
from fhash_codec.paper.point_tables import Patch, PointTables, locate
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
    bits whatever other points are given with it, in whatever order (native_points.py). Where all
    points share one time, the tables are interpolated in time once.

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
    columns, count = _columns((key_index, z, y, x))
    _check(network, columns)
    values = np.empty(count, np.float32)
    slopes = np.empty((count, 4), np.float32) if gradient else None
    for group in _groups(columns, np.arange(count)):
        whole = len(group) == count
        places = [_chosen(column, group) for column in columns]
        tables = PointTables.read(network, *_extremes(places))
        sampler = PointSampler(tables, None if gradient else _one_time(tables, places, len(group)))
        if whole:
            sampler.sample(places, values, slopes, threads)
            continue
        some = np.empty(len(group), np.float32)
        some_slopes = np.empty((len(group), 4), np.float32) if gradient else None
        sampler.sample(places, some, some_slopes, threads)
        values[group] = some
        if slopes is not None:
            slopes[group] = some_slopes
    return values if slopes is None else (values, slopes)


class PointSampler:
    """Tables in memory, ready to be sampled at points; for many calls on the same tables."""

    def __init__(self, tables: PointTables, key_index: float | None = None) -> None:
        """Take over tables.

        Args:
            tables: parts of the tables around the points to come.
            key_index: the time of all points, at which the tables are interpolated once. The
                points' own time is then 0, and their derivative by time.
        """
        points = NativePoints(native.library(), tables)
        self._native = points if key_index is None else points.at(key_index)

    def sample(
        self,
        columns: Sequence[npt.NDArray[np.float64]],
        values: Floats,
        slopes: Floats | None,
        threads: int,
    ) -> None:
        """Write the normalised values and, unless `slopes` is None, the derivatives at points.

        Args:
            columns: key index, z, y and x of the points, each (n,) or (1,) for all, in the box.
            values: float32 (n,), to be written.
            slopes: float32 (n, 4), to be written, or None.
            threads: number of threads.
        """

        def evaluate(chunks: Sequence[slice]) -> None:
            for chunk in chunks:
                places = [column[chunk] if len(column) > 1 else column for column in columns]
                some = None if slopes is None else slopes[chunk]
                self._native.evaluate(places, values[chunk], some)

        starts = range(0, len(values), CHUNK_POINTS)
        share_out(evaluate, [slice(start, start + CHUNK_POINTS) for start in starts], threads)


def input_slopes(network: Network, points: npt.NDArray[np.float64]) -> Floats:
    """Return the derivatives float32 (inputs, n) of the value by each input of the network.

    The inputs are the interpolated embeddings, in the order of `Network`. The value is normalised.
    A part of each table that surrounds all points is read at once, so points of one call should lie
    close together.

    Args:
        network: the trained network.
        points: positions (4, n), key index, z, y and x, inside the box.
    """
    tables = PointTables.read(network, points.min(axis=1), points.max(axis=1))
    slopes = np.empty((network.inputs, points.shape[1]), np.float32)
    for start in range(0, points.shape[1], CHUNK_POINTS):
        chunk = points[:, start : start + CHUNK_POINTS]
        layers = DenseLayers(network, chunk.shape[1])
        _encode(tables, chunk, layers.inputs)
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


def _encode(tables: PointTables, points: npt.NDArray[np.float64], inputs: Floats) -> None:
    """Write the interpolated embeddings at points (4, n) into the first n columns of `inputs`."""
    size, count = tables.network.embedding_size, points.shape[1]
    for level, (patch, resolution) in enumerate(zip(tables.patches, tables.levels, strict=True)):
        before, after_weights, _ = locate(tables.sizes, resolution, points)
        corners = _corners(patch, before, resolution)
        rows = slice(level * size, (level + 1) * size)
        inputs[rows, :count] = interpolate(corners, after_weights, gradient=False)[0]


def _columns(arrays: Sequence[npt.ArrayLike]) -> tuple[list[npt.NDArray[np.float64]], int]:
    """Return coordinates as arrays (n,), or (1,) where one stands for all points, and n."""
    columns = [np.atleast_1d(np.asarray(array, dtype=np.float64)) for array in arrays]
    lengths = {len(column) for column in columns if np.ndim(column) == 1} - {1}
    if any(column.ndim != 1 for column in columns) or len(lengths) > 1:
        raise InputError(
            f"points have shapes {', '.join(str(np.shape(array)) for array in arrays)}; "
            "one length (n,) is needed for key_index, z, y and x"
        )
    return columns, lengths.pop() if lengths else 1


def _check(network: Network, columns: Sequence[npt.NDArray[np.float64]]) -> None:
    """Raise RegionError for the first point that is outside the box."""
    for axis, column, size in zip(
        AXES, columns, (network.key_frames, *network.box_size), strict=True
    ):
        # A number that is none makes both ends none.
        if len(column) and not (column.min() >= 0 and column.max() <= size - 1):
            outside = np.flatnonzero(~((column >= 0) & (column <= size - 1)))
            raise RegionError(
                f"point {outside[0]}: {axis} {column[outside[0]]:g} is outside 0..{size - 1}"
            )


def _chosen(
    column: npt.NDArray[np.float64], chosen: npt.NDArray[np.intp]
) -> npt.NDArray[np.float64]:
    """Return a coordinate of chosen points, in ascending order; one number stands for all."""
    return column if len(column) in (1, len(chosen)) else column[chosen]


def _extremes(columns: Sequence[npt.NDArray[np.float64]]) -> tuple[list[float], list[float]]:
    """Return the smallest and the largest of each coordinate."""
    return [float(c.min()) for c in columns], [float(c.max()) for c in columns]


def _one_time(
    tables: PointTables, columns: Sequence[npt.NDArray[np.float64]], count: int
) -> float | None:
    """Return the time that all points share, if interpolating the tables there once pays."""
    times = columns[0]
    if tables.vertices > READ_PER_POINT * count or times.min() != times.max():
        return None
    return float(times[0])


def _groups(
    columns: Sequence[npt.NDArray[np.float64]], chosen: npt.NDArray[np.intp]
) -> Iterator[npt.NDArray[np.intp]]:
    """Split chosen points into groups that each span a part of the finest table fit to be read.

    A part is fit if it is small, or if it holds many points and is not too large.
    """
    if not len(chosen):
        return
    low, high = np.array(_extremes([_chosen(column, chosen) for column in columns]))
    extent = np.floor(high) - np.floor(low) + 2
    if math.prod(extent) <= min(LARGE_READ, max(SMALL_READ, READ_PER_POINT * len(chosen))):
        yield chosen
        return
    axis = int(np.argmax(extent))
    below = columns[axis][chosen] < np.floor((low[axis] + high[axis] + 1) / 2)
    yield from _groups(columns, chosen[below])
    yield from _groups(columns, chosen[~below])


def _corners(patch: Patch, before: npt.NDArray[np.int64], resolution: Sequence[int]) -> Floats:
    """Return the 16 corners around each point, float32 (t 2, z 2, y 2, x 2, E, n)."""
    strides = patch.strides
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
    embeddings = patch.embeddings(offsets[:, None] + index)
    return np.ascontiguousarray(np.moveaxis(embeddings, -1, 1), dtype=np.float32).reshape(
        2, 2, 2, 2, patch.values.shape[4], -1
    )
