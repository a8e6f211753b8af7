"""The part of a volume that is in view, and the size of a pixel there."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.rendering.camera.axes import Warp
from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.camera.clip import Body, corners_of
from fhash_codec.volume import Volume

__all__ = ["part_in_view", "part_of_body", "pixel_vertices"]

Floats = npt.NDArray[np.float64]

MAX_PART = 0.5
"""Largest share of the volume that is decoded alone; above it all is, for the next pictures."""


def pixel_vertices(rays: Rays) -> float:
    """Measure a pixel in vertices of the series, where the volume is nearest; 0 inside the volume.

    Side of the pixel, axis of the volume and place along it are those of the smallest number.
    """
    bounds = rays.grid.bounds
    across = np.abs(rays.right) * 2 / rays.size[0], np.abs(rays.up) * 2 / rays.size[1]
    lengths = [float(np.linalg.norm(side * rays.grid.spacing)) for side in across]
    width = min(lengths) / float(np.max(np.abs(rays.grid.spacing) * rays.grid.coarseness))
    if rays.parallel:
        return width
    nearest = np.clip(rays.eye, bounds[:, 0], bounds[:, 1])
    # The distance of the box along the direction of view: `forward` has a physical length of 1.
    corners = np.array(list(itertools.product(*bounds)))
    depth = float(
        np.min((corners - rays.eye) * rays.grid.spacing @ (rays.forward * rays.grid.spacing))
    )
    return 0.0 if np.array_equal(nearest, rays.eye) else width * max(depth, 0.0)


def part_in_view(rays: Rays, volume: Volume, body: Body | None = None, margin: int = 0) -> Box:
    """Find the region (z, y, x) of vertices around what is in view, widened to whole chunks.

    The region is all of the domain, or of what a clip leaves of it, where that is not much more,
    and one vertex where nothing of the volume is in view.

    Args:
        rays: of the picture.
        volume: an open container.
        body: what a clip leaves; None without one.
        margin: vertices around a clipped part that its samples need, too.
    """
    domain = part_of_body(volume, body, rays.grid.warp, margin)
    # Cameras at the ends of float64 overflow.
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        seen = _seen(rays, body)
    if seen is None:
        return Box.of_shape((1, 1, 1))
    region = _chunks_around(seen, volume, rays.grid.warp, 0 if body is None else margin)
    share = np.prod(region.shape) / np.prod(domain.shape)
    return domain if share > MAX_PART else region


def part_of_body(volume: Volume, body: Body | None, warp: Warp | None, margin: int = 0) -> Box:
    """Find the region (z, y, x) around what a clip leaves, widened to whole chunks.

    Without a clip it is the domain.

    Args:
        volume: an open container.
        body: what a clip leaves; None without one.
        warp: from the even grid of the picture to the vertices of the series, None if that is even.
        margin: vertices around a clipped part that its samples need, too.
    """
    domain = Box.of_shape(volume.shape[1:])
    if body is None:
        return domain
    return _chunks_around(body.extent, volume, warp, margin)


def _chunks_around(extent: Floats, volume: Volume, warp: Warp | None, margin: int) -> Box:
    """The region (z, y, x) of the chunks around places (3, 2), x, y, z, and a margin."""
    if warp is not None:
        extent = np.stack([warp.to_series(axis, ends) for axis, ends in enumerate(extent)])
    region = []
    for low, high, length, chunk, (first, _) in zip(
        *extent[::-1].T, volume.shape[1:], volume.chunks[1:], volume.box, strict=True
    ):
        start = min(max(int(np.floor(low)) - margin, 0), length - 1)
        stop = min(int(np.ceil(high)) + 1 + margin, length)
        # Chunks begin at the feature bounding box.
        start = max(first + (start - first) // chunk * chunk, 0)
        stop = min(first - (first - stop) // chunk * chunk, length)
        region.append((start, max(stop, start + 1)))
    return Box.of(region)


def _seen(rays: Rays, body: Body | None) -> Floats | None:
    """Bounds (3, 2) of the part of the box that is in view, x, y, z in vertices; None if none is.

    The part is convex and bounded by the planes of the box, of a clip and of the view.
    """
    body = Body(bounds=rays.grid.bounds, planes=np.empty((0, 4))) if body is None else body
    bounds = body.bounds
    side_normals, side_offsets = _view_planes(rays)
    faces, distances = body.half_spaces
    normals = np.array([*faces, *side_normals])
    offsets = np.array([*distances, *side_offsets])
    if not (np.isfinite(normals).all() and np.isfinite(offsets).all()):
        return bounds
    tolerance = 1e-9 * float(np.abs(bounds).max() + np.abs(rays.eye).max())
    corners = list(corners_of(normals, offsets, tolerance))
    if not rays.parallel and np.all(faces @ rays.eye + distances >= 0):
        corners.append(rays.eye)
    if not corners:
        return None
    return np.stack([np.min(corners, axis=0), np.max(corners, axis=0)], axis=-1)


def _view_planes(rays: Rays) -> tuple[list[Floats], list[float]]:
    """The planes through the four edges of the picture: unit normals (3,) inwards, and offsets."""
    normals, offsets = [], []
    for side, other in ((rays.right, rays.up), (rays.up, rays.right)):
        for sign in (1.0, -1.0):
            # A plane contains the other direction and the ray at the picture's edge.
            along = rays.forward if rays.parallel else rays.forward + sign * side
            normal = np.cross(along, other)
            # Scaled first, since the squares of the largest scales are beyond float64.
            normal = normal / np.abs(normal).max()
            normal = normal / np.linalg.norm(normal)
            normal = -normal if normal @ side * sign > 0 else normal
            place = rays.eye + sign * side if rays.parallel else rays.eye
            normals.append(normal)
            offsets.append(-float(normal @ place))
    return normals, offsets
