"""Points between vertices: which have a value, given the coreset around them, and the values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box, Spans
from fhash_codec.coreset.key_frames import KeyTimes
from fhash_codec.volume_model import VolumeModel

Positions = npt.NDArray[np.float64]
"""Positions (n,) of points along one axis."""

Mask = npt.NDArray[np.bool_]


class Series(Protocol):
    """A volume, as far as sampling asks it: where it has values, and how its time runs."""

    @property
    def box(self) -> Box:
        """The feature bounding box."""
        ...

    @property
    def key_times(self) -> KeyTimes:
        """The map from steps to key indices."""
        ...

    def occupancy(self, t: float, region: Spans | None = None) -> Mask:
        """The vertices (z, y, x) of a region of the domain that are in the coreset at a step."""
        ...


def sampled(
    series: Series,
    model: VolumeModel,
    steps: Positions,
    space: Sequence[Positions],
    *,
    gradient: bool,
) -> tuple[Positions, Positions | None]:
    """Values (n,) at points, NaN where there is none, and derivatives (n, 4) by t, z, y and x.

    steps: of the points. space: positions z, y and x of the points, in vertices of the domain.
    gradient: whether derivatives are asked for; None is returned for them otherwise.
    """
    keys = series.key_times.key_indices(steps)
    inside = interpolable(series.box, steps, keys, space, series.occupancy)
    values = np.full(inside.shape, np.nan)
    slopes = np.full((*inside.shape, 4), np.nan) if gradient else None
    if inside.any():
        local = [
            (position - first)[inside]
            for position, first in zip(space, series.box.first, strict=True)
        ]
        if slopes is None:
            values[inside] = model.sample(keys[inside], local)
        else:
            values[inside], slopes[inside] = model.sample_with_gradient(keys[inside], local)
            slopes[inside, 0] *= series.key_times.keys_per_step(steps[inside])
    return values, slopes


def interpolable(
    box: Box,
    steps: Positions,
    keys: Positions,
    space: Sequence[Positions],
    occupancy: Callable[[float, Box], Mask],
) -> Mask:
    """Mask (n,) of the points whose cell vertices of weight above 0 are all in the coreset.

    box: the feature bounding box; points outside it have no value.
    steps, keys: times of the points, in steps and as key indices.
    space: positions z, y and x of the points, in vertices of the domain.
    occupancy: the vertices (z, y, x) of a region of the domain that are in the coreset at a step.
    """
    inside: Mask = np.all(
        [
            (position >= first) & (position <= end - 1)
            for position, (first, end) in zip(space, box, strict=True)
        ],
        axis=0,
    )
    for step, group in _groups_of_one_occupancy(steps, keys):
        chosen = np.flatnonzero(inside & group)
        if chosen.size:
            inside[chosen] = _cells_occupied([p[chosen] for p in space], step, occupancy)
    return inside


def _groups_of_one_occupancy(steps: Positions, keys: Positions) -> Iterator[tuple[float, Mask]]:
    """Points between the same steps and the same key frames: a step of theirs, and their mask."""
    between = np.stack([np.floor(steps), np.ceil(steps), np.floor(keys), np.ceil(keys)])
    if len(steps) and (between == between[:, :1]).all():
        yield float(steps[0]), np.ones(len(steps), np.bool_)
        return
    _, first, group = np.unique(between, axis=1, return_index=True, return_inverse=True)
    for number, point in enumerate(first):
        yield steps[point], group == number


def _cells_occupied(
    space: Sequence[Positions], step: float, occupancy: Callable[[float, Box], Mask]
) -> Mask:
    """Mask (n,) of the points whose cell is in the coreset.

    On a face of a cell the lower and the upper vertex are the same: vertices without weight do not
    matter.
    """
    lower = [np.floor(position).astype(np.int64) for position in space]
    upper = [np.ceil(position).astype(np.int64) for position in space]
    region = Box.of(
        (int(low.min()), int(high.max()) + 1) for low, high in zip(lower, upper, strict=True)
    )
    occupied = occupancy(step, region)
    complete = np.ones(space[0].shape, dtype=bool)
    if occupied.all():
        return complete
    for corner in np.ndindex(2, 2, 2):
        vertex = tuple(
            (high if is_upper else low) - first
            for is_upper, low, high, first in zip(corner, lower, upper, region.first, strict=True)
        )
        complete &= occupied[vertex]
    return complete
