"""The edges of the volume's box in the picture: before the volume, behind it, on its outline."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.camera.clip import Body

__all__ = ["Edge", "edges", "outer_edges"]

Floats = npt.NDArray[np.float64]

ON_FACE = 1e-6
"""Distance of a corner from a face of a clipped box, in vertices, that is taken for rounding."""
NEAREST = 1e-4
"""Distance from a perspective camera at which edges are cut off, as a share of the diagonal."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Edge:
    """An edge of the box.

    Attributes:
        axis: 0, 1 or 2 for an edge along x, y or z; -1 for one of a clipped body.
        ends: pixels (2, 2), from the left and from the top, of the first vertex and of the last.
        fronts: number of its faces that look at the camera: 0 behind all of the volume, 1 on the
            outline, 2 before the volume.
        uncut: whether all of the edge lies before the camera, so that nothing is cut off.
    """

    axis: int
    ends: Floats
    fronts: int
    uncut: bool


def edges(rays: Rays, body: Body | None = None) -> list[Edge]:
    """Find those of the twelve edges that lie before the camera, at least in part.

    body: what a clip leaves of the box, whose edges are found instead; None without a clip.
    """
    if body is not None:
        return _edges_of_body(rays, body)
    bounds = rays.grid.bounds
    toward = (
        np.array([[1.0], [-1.0]]) * rays.forward
        if rays.parallel
        else np.stack([bounds[:, 0] - rays.eye, rays.eye - bounds[:, 1]])
    )
    looking = toward > 0  # (low or high face, axis)
    seen = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        for sides in itertools.product((0, 1), repeat=2):
            faces = list(zip(sides, others, strict=True))
            ends = np.empty((2, 3))
            ends[:, axis] = bounds[axis]
            for side, other in faces:
                ends[:, other] = bounds[other, side]
            clipped = _clipped(rays, ends)
            if clipped is not None:
                pixels, _ = rays.project(clipped)
                fronts = sum(bool(looking[face]) for face in faces)
                seen.append(Edge(axis=axis, ends=pixels, fronts=fronts, uncut=clipped is ends))
    return seen


def _edges_of_body(rays: Rays, body: Body) -> list[Edge]:
    """The edges of a clipped box before the camera: where two of its faces share two corners."""
    normals, offsets = body.half_spaces
    looking = normals @ rays.forward > 0 if rays.parallel else normals @ rays.eye + offsets < 0
    corners = body.corners
    on_face = np.abs(corners @ normals.T + offsets) < ON_FACE
    seen = []
    for one, other in itertools.combinations(range(len(normals)), 2):
        along = np.cross(normals[one], normals[other])
        shared = corners[on_face[:, one] & on_face[:, other]]
        if len(shared) < 2 or not along.any():
            continue
        order = np.argsort(shared @ along)
        ends = shared[order[[0, -1]]]
        clipped = _clipped(rays, ends) if np.abs(ends[1] - ends[0]).max() > ON_FACE else None
        if clipped is not None:
            pixels, _ = rays.project(clipped)
            fronts = int(looking[one]) + int(looking[other])
            seen.append(Edge(axis=-1, ends=pixels, fronts=fronts, uncut=clipped is ends))
    return seen


def outer_edges(rays: Rays) -> list[Edge]:
    """Choose the edge of each axis that its scale stands at.

    It is the lowest edge of the outline in the picture, and of equally low ones the leftmost. An
    axis without an edge that is seen whole, as from inside the volume, has none.
    """
    chosen = []
    for axis in range(3):
        outline = [
            edge for edge in edges(rays) if edge.axis == axis and edge.fronts == 1 and edge.uncut
        ]
        if outline:
            chosen.append(max(outline, key=_lowest_then_leftmost))
    return chosen


def _lowest_then_leftmost(edge: Edge) -> tuple[float, float]:
    return round(float(edge.ends[:, 1].max()), 3), -float(edge.ends[:, 0].min())


def _clipped(rays: Rays, ends: Floats) -> Floats | None:
    """Cut a line (2, 3) of index space off behind a perspective camera.

    The line itself if all of it is before the camera, None if nothing is.
    """
    if rays.parallel:
        return ends
    _, depth = rays.project(ends)
    nearest = NEAREST * float(np.linalg.norm(rays.grid.corners[:, 1] - rays.grid.corners[:, 0]))
    if np.all(depth >= nearest):
        return ends
    if np.all(depth < nearest):
        return None
    share = (nearest - depth[0]) / (depth[1] - depth[0])
    cut = ends.copy()
    cut[int(depth[1] < depth[0])] = ends[0] + share * (ends[1] - ends[0])
    return cut
