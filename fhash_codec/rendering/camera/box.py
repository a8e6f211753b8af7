"""The edges of the volume in the picture: which lie before it, which behind, and which make its outline."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Rays

__all__ = ["Edge", "edges", "outer_edges"]

Floats = npt.NDArray[np.float64]

NEAREST = 1e-4
"""Of the box's diagonal: what is nearer to a perspective camera is cut off an edge."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Edge:
    """One edge of the box.

    Attributes:
        axis: that it runs along, 0, 1 or 2 for x, y or z.
        ends: pixels (2, 2), from the left and from the top, of the first vertex and of the last.
        fronts: how many of its two faces look at the camera: 0 behind all of the volume, 1 the outline, 2 before it.
        whole: whether nothing is cut off because it reaches behind the camera.
    """

    axis: int
    ends: Floats
    fronts: int
    whole: bool


def edges(rays: Rays) -> list[Edge]:
    """Those of the twelve edges that reach before the camera."""
    bounds = rays.grid.bounds
    toward = (
        np.array([[1.0], [-1.0]]) * rays.forward
        if rays.parallel
        else np.stack([bounds[:, 0] - rays.eye, rays.eye - bounds[:, 1]])
    )
    looking = toward > 0  # (low or high face, axis)
    found = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        for sides in itertools.product((0, 1), repeat=2):
            ends = np.empty((2, 3))
            ends[:, axis] = bounds[axis]
            for other, side in zip(others, sides, strict=True):
                ends[:, other] = bounds[other, side]
            clipped = _clipped(rays, ends)
            if clipped is not None:
                fronts = sum(
                    bool(looking[side, other]) for other, side in zip(others, sides, strict=True)
                )
                pixels, _ = rays.project(clipped)
                found.append(Edge(axis=axis, ends=pixels, fronts=fronts, whole=clipped is ends))
    return found


def _clipped(rays: Rays, ends: Floats) -> Floats | None:
    """The part of a line (2, 3) of index space that is before a perspective camera, itself if all of it is."""
    if rays.parallel:
        return ends
    _, depth = rays.project(ends)
    least = NEAREST * float(np.linalg.norm(rays.grid.corners[:, 1] - rays.grid.corners[:, 0]))
    if np.all(depth >= least):
        return ends
    if np.all(depth < least):
        return None
    share = (least - depth[0]) / (depth[1] - depth[0])
    cut = ends.copy()
    cut[int(depth[1] < depth[0])] = ends[0] + share * (ends[1] - ends[0])
    return cut


def outer_edges(rays: Rays) -> list[Edge]:
    """The edge of each axis that its scale stands at: on the outline, the lowest in the picture, of equally low ones the leftmost.

    None for an axis that is not seen whole, as from inside the volume.
    """
    found = []
    for axis in range(3):
        outline = [
            edge for edge in edges(rays) if edge.axis == axis and edge.fronts == 1 and edge.whole
        ]
        if outline:
            found.append(
                max(
                    outline,
                    key=lambda edge: (
                        round(float(edge.ends[:, 1].max()), 3),
                        -float(edge.ends[:, 0].min()),
                    ),
                )
            )
    return found
