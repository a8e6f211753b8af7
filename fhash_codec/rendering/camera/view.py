"""What of a volume lies in the picture, and how large a pixel is there."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.volume import Volume

__all__ = ["part_in_view", "pixel_vertices"]

Floats = npt.NDArray[np.float64]

WHOLE = 0.5
"""Share of the volume from which on all of it is decoded: the next picture may look at the rest."""


def pixel_vertices(rays: Rays) -> float:
    """Width of a pixel in vertices where the volume is nearest to the camera, along the axis along which it is smallest; 0 inside."""
    bounds = rays.grid.bounds
    across = (
        np.minimum(np.abs(rays.right) * 2 / rays.size[0], np.inf),
        np.abs(rays.up) * 2 / rays.size[1],
    )
    lengths = [float(np.linalg.norm(part * rays.grid.spacing)) for part in across]
    width = min(lengths) / float(np.max(np.abs(rays.grid.spacing)))
    if rays.parallel:
        return width
    nearest = np.clip(rays.eye, bounds[:, 0], bounds[:, 1])
    # The distance of the nearest plane across the view: forward has a physical length of 1.
    corners = np.array(list(itertools.product(*bounds)))
    depth = float(
        np.min((corners - rays.eye) * rays.grid.spacing @ (rays.forward * rays.grid.spacing))
    )
    return 0.0 if np.array_equal(nearest, rays.eye) else width * max(depth, 0.0)


def part_in_view(rays: Rays, volume: Volume) -> Box:
    """The region (z, y, x) of vertices around what the picture shows, widened to whole chunks; all where that is not much more.

    One vertex where the picture shows nothing of the volume.
    """
    everything = Box.of_shape(volume.shape[1:])
    with np.errstate(
        over="ignore", divide="ignore", invalid="ignore"
    ):  # of cameras at the ends of float64
        seen = _seen(rays)
    if seen is None:
        return Box.of_shape((1, 1, 1))
    found = []
    for low, high, length, chunk, (first, _) in zip(
        *seen[::-1].T, volume.shape[1:], volume.chunks[1:], volume.box, strict=True
    ):
        start, stop = max(int(np.floor(low)), 0), min(int(np.ceil(high)) + 1, length)
        # Chunks begin at the feature bounding box.
        start = max(first + (start - first) // chunk * chunk, 0)
        stop = min(first - (first - stop) // chunk * chunk, length)
        found.append((start, max(stop, start + 1)))
    share = np.prod([stop - start for start, stop in found]) / np.prod(volume.shape[1:])
    return everything if share > WHOLE else Box.of(found)


def _seen(rays: Rays) -> Floats | None:
    """Bounds (3, 2), x, y, z in vertices, of the part of the box that is in the picture; None where there is none.

    The part is convex, of at most ten planes: its corners are the places where three of them meet and none of the others cuts off.
    """
    bounds = rays.grid.bounds
    normals = [*np.eye(3), *-np.eye(3)]
    offsets = [*-bounds[:, 0], *bounds[:, 1]]
    middle = rays.forward
    for side, other in ((rays.right, rays.up), (rays.up, rays.right)):
        for sign in (1.0, -1.0):
            # A plane holds the other direction and the ray at the picture's edge; the rest of the picture is on its inner side.
            along = middle if rays.parallel else middle + sign * side
            normal = np.cross(along, other)
            normal = (
                normal / np.abs(normal).max()
            )  # first, since the squares of the largest scales go beyond float64
            normal = normal / np.linalg.norm(normal)
            normal = -normal if normal @ side * sign > 0 else normal
            place = rays.eye + sign * side if rays.parallel else rays.eye
            normals.append(normal)
            offsets.append(-float(normal @ place))
    normal, offset = np.array(normals), np.array(offsets)
    if not (np.isfinite(normal).all() and np.isfinite(offset).all()):
        return bounds
    tolerance = 1e-9 * float(np.abs(bounds).max() + np.abs(rays.eye).max())
    threes = np.array(list(itertools.combinations(range(len(normal)), 3)))
    threes = threes[np.abs(np.linalg.det(normal[threes])) >= 1e-12]
    places = np.linalg.solve(normal[threes], -offset[threes][..., None])[..., 0]
    corners = list(places[np.all(places @ normal.T + offset >= -tolerance, axis=1)])
    if not rays.parallel and np.all((rays.eye >= bounds[:, 0]) & (rays.eye <= bounds[:, 1])):
        corners.append(rays.eye)
    return (
        np.stack([np.min(corners, axis=0), np.max(corners, axis=0)], axis=-1) if corners else None
    )
