"""The even grid of vertices that a volume is drawn on, in physical coordinates."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.axes import Axis, Warp, downward, drawn_counts, proportions
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Coordinate

__all__ = ["Grid"]

Floats = npt.NDArray[np.float64]
Vector = tuple[float, float, float]

MAX_AXES_RATIO = 1e14
"""Largest ratio of the longest axis to the shortest vertex spacing.

The eye is a few times as far away as the axis is long, and there float64 tells apart 0.1 spacings.
"""
LINE = 1 / 32
"""Thickness of a line of vertices, as a share of its length, at least."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Grid:
    """The even grid of vertices that is drawn.

    An axis of one vertex has the mean spacing of the others and reaches half of it to both sides.
    A line of vertices is at least LINE of its length thick.

    Attributes:
        counts: drawn vertices along x, y, z.
        origin: physical position (x, y, z) of the first vertex, stretched by `scale`.
        spacing: between two vertices (x, y, z), stretched; negative where coordinates descend.
        scale: factors by which the axes (x, y, z) are stretched, negative for depths.
        warp: where the drawn vertices lie among those of the series; None where they are the same.
        coarseness: largest distance of two vertices of the series, in drawn vertices, x, y, z.
    """

    counts: tuple[int, int, int]
    origin: Floats
    spacing: Floats
    scale: Vector = (1.0, 1.0, 1.0)
    warp: Warp | None = None
    coarseness: Vector = (1.0, 1.0, 1.0)

    @classmethod
    def of(cls, coords: Mapping[str, Coordinate], scale: Vector | None = None) -> Grid:
        """Make the grid of a volume's coordinates.

        Uneven coordinates are drawn where they lie, on a finer grid. Values that ascend downwards,
        such as depths, are drawn downwards. Coordinates that are no positions are spread evenly,
        with an FhashWarning.

        Args:
            coords: by axis.
            scale: factors by which the axes are stretched. If None, axes have the lengths of their
                coordinates, except an axis in other units than most have: its length cannot be
                compared, so its vertices are drawn as far apart as those of the others.

        Raises InputError where axes have lengths too different to place rays.
        """
        axes = [Axis.of(coords[axis]) for axis in "xyz"]
        for name, axis in zip("xyz", axes, strict=True):
            if axis.problem:
                warnings.warn(
                    f"the coordinates {coords[name].name!r} of {name} {axis.problem}",
                    FhashWarning,
                    stacklevel=2,
                )
        mean = np.array([axis.spacing for axis in axes])
        factors = (
            proportions([coords[axis] for axis in "xyz"], np.abs(mean))
            if scale is None
            else np.array(scale, dtype=np.float64)
        )
        single = np.isnan(mean)
        mean[single] = _thickness(np.abs(mean * factors), axes) / factors[single]
        factors = np.where([downward(coords[axis]) for axis in "xyz"], -factors, factors)
        series_counts = [len(axis.values) for axis in axes]
        counts = drawn_counts(axes)
        finer = np.array(
            [
                max(count - 1, 1) / max(own - 1, 1)
                for count, own in zip(counts, series_counts, strict=True)
            ]
        )
        spacing = mean * factors / finer
        _check_lengths(spacing, counts)
        uneven = not all(axis.even for axis in axes)
        places = [
            None if axis.even else axis.places(n) for axis, n in zip(axes, counts, strict=True)
        ]
        return cls(
            counts=(counts[0], counts[1], counts[2]),
            origin=np.array([axis.values[0] for axis in axes]) * factors,
            spacing=spacing,
            scale=(float(factors[0]), float(factors[1]), float(factors[2])),
            warp=Warp(
                counts=(series_counts[0], series_counts[1], series_counts[2]),
                places=(places[0], places[1], places[2]),
            )
            if uneven
            else None,
            coarseness=(
                float(finer[0] * axes[0].coarsest),
                float(finer[1] * axes[1].coarsest),
                float(finer[2] * axes[2].coarsest),
            ),
        )

    @property
    def flat(self) -> bool:
        """Whether an axis has one vertex, so that a plane, a line or a point is drawn."""
        return 1 in self.counts

    @property
    def thinnest(self) -> tuple[int, float]:
        """Vertices of the axis with the fewest, and its length in mean vertex spacings."""
        count = min(self.series_counts)
        lengths = np.abs(self.spacing) * np.diff(self.bounds, axis=1)[:, 0] / self.series_spacing
        axes = [axis for axis in range(3) if self.series_counts[axis] == count]
        return count, float(min(lengths[axes]))

    @property
    def series_counts(self) -> tuple[int, int, int]:
        """Vertices of the series along x, y, z."""
        return self.counts if self.warp is None else self.warp.counts

    @property
    def series_spacing(self) -> float:
        """The mean distance between vertices of the series: the geometric mean over the axes."""
        finer = _finer(self.counts, self.series_counts)
        return float(np.exp(np.mean(np.log(np.abs(self.spacing) * finer))))

    @property
    def vertex_spacing(self) -> float:
        """The distance between vertices as one length: the geometric mean over the axes."""
        return float(np.exp(np.mean(np.log(np.abs(self.spacing)))))

    @property
    def bounds(self) -> Floats:
        """The box that is drawn in index space: float64 (3, 2), x, y, z."""
        return np.array(
            [[-0.5, 0.5] if count == 1 else [0.0, count - 1.0] for count in self.counts]
        )

    @property
    def corners(self) -> Floats:
        """The drawn box in physical coordinates (3, 2); descending on descending axes."""
        return self.origin[:, None] + self.bounds * self.spacing[:, None]


def _finer(counts: Sequence[int], series_counts: Sequence[int]) -> list[float]:
    """Factors by which the drawn vertices of each axis are finer than those of the series."""
    return [
        max(count - 1, 1) / max(own - 1, 1)
        for count, own in zip(counts, series_counts, strict=True)
    ]


def _thickness(spacing: Floats, axes: Sequence[Axis]) -> float:
    """The thickness of axes of one vertex; spacing: mean ones (3,), stretched, NaN for one vertex.

    It is the mean spacing of the other axes, 1 without any.
    """
    extended = ~np.isnan(spacing)
    if not extended.any():
        return 1.0
    thickness = float(np.mean(spacing[extended]))
    if np.count_nonzero(extended) == 1:
        longest = max(len(axis.values) for axis in axes)
        thickness = max(thickness, LINE * thickness * (longest - 1))
    return thickness


def _check_lengths(spacing: Floats, counts: Sequence[int]) -> None:
    """Raise InputError where one axis is too long for the vertex spacing of another."""
    longest = float(np.max(np.abs(spacing) * counts))
    shortest = float(np.min(np.abs(spacing)))
    if longest > MAX_AXES_RATIO * shortest:
        raise InputError(
            f"the longest axis of the volume is {longest:.3g}, and vertices of the shortest are "
            f"{shortest:.3g} apart: no ray can be placed that finely, at most "
            f"{MAX_AXES_RATIO:.0e} times; stretch the axes with 'scale'"
        )
