"""The part of the drawn box that a clip leaves: a convex body within a box and behind planes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.scene.scene import Clip
from fhash_formats.errors import InputError

__all__ = ["Body", "corners_of"]

Floats = npt.NDArray[np.float64]

SNAP = 1e-6
"""Distance from a vertex, in vertices, at which a clip's end is taken for the vertex: coordinates
of people have few digits.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """The part of the drawn box that is shown, in index space.

    Attributes:
        bounds: float64 (3, 2), x, y, z, the box; all of it lies in the drawn box.
        planes: float64 (n, 4): a place (x, y, z) is kept where its product with the first three
            numbers is at least the fourth. They are normals of length 1.
    """

    bounds: Floats
    planes: Floats

    @classmethod
    def of(cls, clip: Clip, grid: Grid) -> Body:
        """The body that a clip leaves of a grid; raises InputError if that is nothing."""
        scale = np.array(grid.scale)
        origin, spacing = grid.origin / scale, grid.spacing / scale
        bounds = np.array(
            [
                _cut(grid, axis, getattr(clip, name), float(origin[axis]), float(spacing[axis]))
                for axis, name in enumerate("xyz")
            ]
        )
        planes = []
        for plane in clip.planes:
            normal = np.array(plane.normal)
            # Scaled first: products of the largest numbers are beyond float64.
            largest = float(np.abs(normal).max())
            normal = normal / largest
            if plane.point is not None:
                distance = float(normal @ (np.array(plane.point) - origin))
            else:
                assert plane.offset is not None
                distance = plane.offset / largest - float(normal @ origin)
            along = normal * spacing
            length = float(np.linalg.norm(along))
            planes.append([*(along / length), distance / length])
        body = cls(bounds=bounds, planes=np.array(planes, dtype=np.float64).reshape(-1, 4))
        if not len(body.corners):
            raise InputError(
                f"the clip planes leave nothing of the volume, which has {_extent_text(grid)}"
            )
        return body

    @property
    def half_spaces(self) -> tuple[Floats, Floats]:
        """Normals (n, 3) inwards and offsets (n,) of all faces.

        Places whose product with the normal plus the offset is at least 0 are inside. The first six
        are those of the box: the low faces along x, y and z, then the high ones.
        """
        normals = np.concatenate([np.eye(3), -np.eye(3), self.planes[:, :3]])
        offsets = np.concatenate([-self.bounds[:, 0], self.bounds[:, 1], -self.planes[:, 3]])
        return normals, offsets

    @property
    def corners(self) -> Floats:
        """The corners (n, 3) of the body; some may be there several times."""
        return corners_of(*self.half_spaces, 1e-9 * max(1.0, float(np.abs(self.bounds).max())))

    @property
    def extent(self) -> Floats:
        """The smallest box (3, 2), x, y, z, around the body."""
        corners = self.corners
        return np.stack([corners.min(axis=0), corners.max(axis=0)], axis=-1)

    def holds(self, places: Floats) -> npt.NDArray[np.bool_]:
        """Whether places (..., 3) of index space lie in the body or on its faces."""
        normals, offsets = self.half_spaces
        return np.asarray(np.all(places @ normals.T + offsets >= -SNAP, axis=-1))


def corners_of(normals: Floats, offsets: Floats, tolerance: float) -> Floats:
    """The corners (m, 3) of a convex body: where three faces meet and no other cuts them off.

    Args:
        normals: (n, 3), inwards, of length 1.
        offsets: (n,); places whose product with the normal plus the offset is at least 0 are kept.
        tolerance: distance of a corner outside a face that is taken for rounding.
    """
    threes = np.array(list(itertools.combinations(range(len(normals)), 3)))
    threes = threes[np.abs(np.linalg.det(normals[threes])) >= 1e-12]
    points = np.linalg.solve(normals[threes], -offsets[threes][..., None])[..., 0]
    return np.asarray(points[np.all(points @ normals.T + offsets >= -tolerance, axis=1)])


def _cut(
    grid: Grid,
    axis: int,
    ends: tuple[float | None, float | None] | None,
    origin: float,
    spacing: float,
) -> tuple[float, float]:
    """The interval of an axis, in vertices, between two positions; raises InputError for none.

    An axis of one vertex is kept whole where the vertex lies between them.
    """
    low, high = grid.bounds[axis]
    places = [None if end is None else (end - origin) / spacing for end in (ends or (None, None))]
    places = [
        round(place) if place is not None and abs(place - round(place)) < SNAP else place
        for place in places
    ]
    first, last = places if spacing > 0 else places[::-1]
    start, stop = low if first is None else first, high if last is None else last
    within = start <= 0 <= stop if grid.counts[axis] == 1 else start <= high and stop >= low
    if not within:
        assert ends is not None
        given = " to ".join("the end" if end is None else f"{end:g}" for end in ends)
        raise InputError(
            f"clip: {'xyz'[axis]} {given} leaves nothing of the volume, "
            f"which has {_extent_text(grid)}"
        )
    if grid.counts[axis] == 1:
        return float(low), float(high)
    return float(max(low, start)), float(min(high, stop))


def _extent_text(grid: Grid) -> str:
    """The positions of the first and the last vertex of each axis, for messages."""
    scale = np.array(grid.scale)
    first = grid.origin / scale
    last = first + (np.array(grid.counts) - 1) * grid.spacing / scale
    return ", ".join(
        f"{name} {min(ends):g} to {max(ends):g}"
        for name, ends in zip("xyz", zip(first, last, strict=True), strict=True)
    )
