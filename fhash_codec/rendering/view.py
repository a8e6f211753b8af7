"""The volume in view: the body that a clip leaves, the vertices in view, the edges of the box."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid, Warp
from fhash_codec.rendering.scenes import Clip
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError
from fhash_formats.support.values import Double

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

    bounds: Double
    planes: Double

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

    @classmethod
    def whole(cls, grid: Grid) -> Body:
        """The body of all of a grid."""
        return cls(bounds=grid.bounds, planes=np.empty((0, 4)))

    @property
    def half_spaces(self) -> tuple[Double, Double]:
        """Normals (n, 3) inwards and offsets (n,) of all faces.

        Places whose product with the normal plus the offset is at least 0 are inside. The first six
        are those of the box: the low faces along x, y and z, then the high ones.
        """
        normals = np.concatenate([np.eye(3), -np.eye(3), self.planes[:, :3]])
        offsets = np.concatenate([-self.bounds[:, 0], self.bounds[:, 1], -self.planes[:, 3]])
        return normals, offsets

    @property
    def corners(self) -> Double:
        """The corners (n, 3) of the body; some may be there several times."""
        return corners_of(*self.half_spaces, 1e-9 * max(1.0, float(np.abs(self.bounds).max())))

    @property
    def extent(self) -> Double:
        """The smallest box (3, 2), x, y, z, around the body."""
        corners = self.corners
        return np.stack([corners.min(axis=0), corners.max(axis=0)], axis=-1)

    def holds(self, places: Double) -> npt.NDArray[np.bool_]:
        """Whether places (..., 3) of index space lie in the body or on its faces."""
        normals, offsets = self.half_spaces
        return np.asarray(np.all(places @ normals.T + offsets >= -SNAP, axis=-1))


def corners_of(normals: Double, offsets: Double, tolerance: float) -> Double:
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


def region_in_view(rays: Rays, volume: Volume, body: Body | None = None, margin: int = 0) -> Box:
    """Find the region (z, y, x) of vertices around what is in view, widened to whole chunks.

    The region is all of the domain, or of what a clip leaves of it, where that is not much more,
    and one vertex where nothing of the volume is in view.

    Args:
        rays: of the picture.
        volume: an open container.
        body: what a clip leaves; None without one.
        margin: vertices around a clipped part that its samples need, too.
    """
    domain = region_of_body(volume, body, rays.grid.warp, margin)
    # Cameras at the ends of float64 overflow.
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        seen = _seen(rays, body)
    if seen is None:
        return Box.of_shape((1, 1, 1))
    region = _chunks_around(seen, volume, rays.grid.warp, 0 if body is None else margin)
    share = np.prod(region.shape) / np.prod(domain.shape)
    return domain if share > MAX_PART else region


def region_of_body(volume: Volume, body: Body | None, warp: Warp | None, margin: int = 0) -> Box:
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


def _chunks_around(extent: Double, volume: Volume, warp: Warp | None, margin: int) -> Box:
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


def _seen(rays: Rays, body: Body | None) -> Double | None:
    """Bounds (3, 2) of the part of the box that is in view, x, y, z in vertices; None if none is.

    The part is convex and bounded by the planes of the box, of a clip and of the view.
    """
    body = Body.whole(rays.grid) if body is None else body
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


def _view_planes(rays: Rays) -> tuple[list[Double], list[float]]:
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
        places: (2, 3), x, y, z, of the same in index space.
        fronts: number of its faces that look at the camera: 0 behind all of the volume, 1 on the
            outline, 2 before the volume.
        uncut: whether all of the edge lies before the camera, so that nothing is cut off.
    """

    axis: int
    ends: Double
    places: Double
    fronts: int
    uncut: bool


def edges(rays: Rays, body: Body | None = None) -> list[Edge]:
    """Find the edges that lie before the camera, at least in part: where two faces share corners.

    body: what a clip leaves of the box, whose edges are found; None without a clip.
    """
    whole = Body.whole(rays.grid) if body is None else body
    normals, offsets = whole.half_spaces
    looking = normals @ rays.forward > 0 if rays.parallel else normals @ rays.eye + offsets < 0
    corners = whole.corners
    on_face = np.abs(corners @ normals.T + offsets) < ON_FACE
    seen = []
    for one, other in itertools.combinations(range(len(normals)), 2):
        along = np.cross(normals[one], normals[other])
        if body is None:  # from the first vertex of its axis to the last
            along = np.abs(along)
        shared = corners[on_face[:, one] & on_face[:, other]]
        if len(shared) < 2 or not along.any():
            continue
        order = np.argsort(shared @ along)
        ends = shared[order[[0, -1]]]
        clipped = _clipped(rays, ends) if np.abs(ends[1] - ends[0]).max() > ON_FACE else None
        if clipped is not None:
            axis = int(along.argmax()) if body is None else -1
            pixels, _ = rays.project(clipped)
            fronts = int(looking[one]) + int(looking[other])
            seen.append(
                Edge(axis=axis, ends=pixels, places=clipped, fronts=fronts, uncut=clipped is ends)
            )
    return seen


def outer_edges(rays: Rays) -> list[Edge]:
    """Choose the edge of each axis that its scale stands at.

    It is the lowest edge of the outline in the picture, and of equally low ones the leftmost. An
    axis without an edge that is seen whole, as from inside the volume, has none.
    """
    outline = [edge for edge in edges(rays) if edge.fronts == 1 and edge.uncut]
    by_axis = ([edge for edge in outline if edge.axis == axis] for axis in range(3))
    return [max(some, key=_lowest_then_leftmost) for some in by_axis if some]


def _lowest_then_leftmost(edge: Edge) -> tuple[float, float]:
    return round(float(edge.ends[:, 1].max()), 3), -float(edge.ends[:, 0].min())


def _clipped(rays: Rays, ends: Double) -> Double | None:
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
