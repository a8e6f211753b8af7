"""Fields that streamed samples are read from, such as the network of a file, and their rays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.model import PaperModel, PointSampler, PointTables
from fhash_codec.paper.network import Network
from fhash_codec.rendering.bricks import CORNERS, SIDE, Bricks, Palette, of_cells
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Warp
from fhash_codec.rendering.march_task import (
    GRADES,
    NUMPY,
    Array,
    Arrays,
    Grading,
    Task,
    Units,
)
from fhash_codec.rendering.network_frame import possible_bricks, span_extremes
from fhash_codec.volume import Volume
from fhash_formats.support.threads import usable_threads


class Inference(Protocol):
    """A network at places (n, 3), float64, x, y, z in vertices of its box, within the box."""

    def values(self, places: Array) -> Array:
        """Normalised values, float32 (n,)."""
        ...

    def slopes(self, places: Array) -> Array:
        """Derivatives by x, y and z per vertex, float32 (n, 3), as `sample_points` has them."""
        ...


def inference_in(arrays: Arrays, network: Network, key: float) -> Inference:
    """Inference for places in arrays: fused kernels on a device, or the host, with a warning."""
    if arrays.device is not None:
        # Only tensors have a device, so torch is here.
        from fhash_codec.paper.engines.fused.engine import start_points

        fused = start_points(network, key, arrays.device)
        if fused is not None:
            return fused
    return HostInference(network, key, arrays)


class HostInference:
    """Inference on the host, in several threads, for places in any arrays (paper/model.py).

    The value of a place has the same bits whatever other places are evaluated with it; so it has by
    fused kernels.

    The tables of the whole box are held in memory. They are interpolated in time once, since a
    picture has one key index.
    """

    def __init__(self, network: Network, key: float, arrays: Arrays) -> None:
        self._arrays = arrays
        self.sampler = PointSampler(PointTables.of_box(network, key), key)

    def values(self, places: Array) -> Array:
        return self._arrays.array(self._sampled(places, None))

    def slopes(self, places: Array) -> Array:
        slopes = np.empty((len(places), 4), np.float32)
        self._sampled(places, slopes)
        return self._arrays.array(slopes[:, :0:-1])

    def _sampled(self, places: Array, slopes: Array | None) -> Array:
        """Values (n,) at places; derivatives by t, z, y and x (n, 4) go into `slopes`."""
        values = np.empty(len(places), np.float32)
        x, y, z = self._arrays.host(places).T
        self.sampler.sample((np.zeros(1), z, y, x), values, slopes, usable_threads())
        return values


class Field(Protocol):
    """Values anywhere in the domain, in arrays of `arrays`.

    Places (n, 3), float64, are x, y, z in vertices of the domain.
    """

    @property
    def arrays(self) -> Arrays:
        """The arrays that places and values are in."""
        ...

    @property
    def bounds(self) -> Array:
        """The box (3, 2), x, y, z, beyond which nothing has a value."""
        ...

    @property
    def vertices(self) -> Array:
        """The box (3, 2), x, y, z, from the first vertex to the last."""
        ...

    @property
    def bricks(self) -> Bricks:
        """Bricks with values at least as far apart as those of the field."""
        ...

    @property
    def first(self) -> Array:
        """The place (3,), x, y, z, at which the first brick and the first cell begin."""
        ...

    @property
    def stride(self) -> int:
        """Vertices of the domain along the side of a cell."""
        ...

    def visible(self, palette: Palette) -> Array:
        """Cells (z, y, x), the first at `first`, in which a sample could have an opacity.

        A few more may be among them.
        """
        ...

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        """Values, float64 (n,), NaN where there is none, and where none is wanted.

        wanted: bool (n,). A device may wait in order to compute no others; without it a device
            computes all and does not wait.
        """
        ...

    def slopes(self, places: Array) -> Array:
        """Derivatives by x, y and z per vertex, float64 (n, 3), 0 where there are none."""
        ...

    def smoothed(self, deviation: float, error: float) -> Field | None:
        """The field that shades where the noise of coding is smoothed; None where nothing is.

        deviation: of a Gaussian, in vertices. error: largest difference of a smoothed value.
        """
        ...


def central_slopes(field: Field, places: Array, own: Field) -> Array:
    """Slopes (n, 3) at places (n, 3) by central differences.

    They are over one vertex before and behind along each axis, clamped to those of the field. Where
    one of the two has no value, the slope of `own` along that axis stands.
    """
    arrays, xp, (low, high) = field.arrays, field.arrays.xp, field.vertices.T
    away = float(field.stride)
    slopes = arrays.empty((len(places), 3))
    for axis in range(3):
        ends = []
        for offset in (-away, away):
            moved = arrays.copy(places)
            moved[:, axis] = xp.clip(
                xp.clip(places[:, axis], low[axis], high[axis]) + offset, low[axis], high[axis]
            )
            ends.append(field.values(moved))
        slopes[:, axis] = (ends[1] - ends[0]) / (2 * away)
    (missing,) = arrays.nonzero(xp.any(xp.isnan(slopes), axis=1))
    if len(missing):
        slopes[missing] = xp.where(
            xp.isnan(slopes[missing]), own.slopes(places[missing]), slopes[missing]
        )
    return slopes


class CoresetField:
    """The box of a coreset, for fields that have values within the coreset alone.

    A place has a value where all vertices of weight around it are in the coreset. Which one is not
    known before the field is evaluated: any value of the range, with a margin.
    """

    stride = 1

    def __init__(
        self,
        in_coreset: npt.NDArray[np.bool_],
        first: npt.ArrayLike,
        flat: npt.ArrayLike,
        ends: tuple[float, float],
        arrays: Arrays,
    ) -> None:
        """Prepare a box.

        Args:
            in_coreset: bool (z, y, x), its vertices.
            first: (3,), x, y, z, the first of them in vertices of the domain.
            flat: bool (3,), x, y, z, axes along which the domain has one vertex.
            ends: of the range of values.
            arrays: that places and values are in.
        """
        self.arrays = arrays
        counts = np.array(in_coreset.shape[::-1])
        low = np.array(first, np.float64)
        vertices = np.stack([low, low + counts - 1], axis=-1)
        widened = np.where(np.array(flat)[:, None], [-0.5, 0.5], 0.0)
        self.first, self.vertices = arrays.array(low), arrays.array(vertices)
        self.bounds = arrays.array(vertices + widened)
        self._last, self._flat = arrays.array(counts - 1.0), arrays.array(flat)
        self._jumps = (1, int(counts[0]), int(counts[0] * counts[1]))
        with arrays.guarded():
            self._in_coreset = arrays.array(in_coreset)
        mask = np.where(in_coreset, np.float32(1), np.float32(np.nan))
        self.bricks = possible_bricks(mask, *ends)

    def visible(self, palette: Palette) -> Array:
        """Cells with a vertex of the coreset: their values are not known before evaluation."""
        return of_cells(self._in_coreset, self.arrays.xp.logical_or)

    def smoothed(self, deviation: float, error: float) -> None:
        """Nothing: networks are smooth."""

    def inside(self, places: Array) -> tuple[Array, Array]:
        """Places (n, 3) in vertices of the box, clipped to it, and whether they have a value."""
        arrays, xp, last = self.arrays, self.arrays.xp, self._last
        at = xp.where(self._flat, 0.0, places - self.first)
        inside = xp.all((at >= 0) & (at <= last), axis=1)
        at = xp.clip(at, 0 * last, last)
        low = arrays.to_int64(at)
        first = low[:, 0] + low[:, 1] * self._jumps[1] + low[:, 2] * self._jumps[2]
        jumps = [
            arrays.to_int64(at[:, axis] > low[:, axis]) * jump
            for axis, jump in enumerate(self._jumps)
        ]
        in_coreset = self._in_coreset.reshape(-1)
        for corner in CORNERS:
            jump = sum(step for up, step in zip(corner[::-1], jumps, strict=True) if up)
            inside &= xp.take(in_coreset, first + jump)
        return at, inside


class NetworkField(CoresetField):
    """The published network of a file, evaluated at every place.

    Between vertices it has values of its own.
    """

    def __init__(self, volume: Volume, step: float, units: Units, arrays: Arrays = NUMPY) -> None:
        model = volume._model
        assert isinstance(model, PaperModel), "a plan marches through no other file"
        self._low, self._high = (
            float(end) for end in units.to([volume.value_range.low, volume.value_range.high])
        )
        super().__init__(
            np.ascontiguousarray(volume.occupancy(step, volume.box)),
            [low for low, _ in reversed(volume.box)],
            np.array(volume.shape[:0:-1]) == 1,
            (self._low, self._high),
            arrays,
        )
        with arrays.guarded():
            self._inference = inference_in(arrays, model.network, volume.key_times.key_index(step))

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        arrays, (at, inside) = self.arrays, self.inside(places)
        result = arrays.full(len(places), np.nan)
        if wanted is None:
            some = arrays.candidates(inside)
        else:
            (some,) = arrays.nonzero(inside & wanted)
        if len(at := at[some]):
            unit = arrays.xp.clip(arrays.to_float64(self._inference.values(at)), 0.0, 1.0)
            values = self._low + unit * (self._high - self._low)
            result[some] = arrays.kept(inside[some], values, np.nan)
        return result

    def slopes(self, places: Array) -> Array:
        """Derivatives as `Field` has them, analytic, through interpolation and network."""
        arrays, (at, inside) = self.arrays, self.inside(places)
        result, some = arrays.full((len(places), 3), 0.0), arrays.candidates(inside)
        if len(at := at[some]):
            slopes = arrays.to_float64(self._inference.slopes(at)) * (self._high - self._low)
            slopes = arrays.xp.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
            result[some] = arrays.kept(inside[some], slopes, 0.0)
        return result


class WarpedField:
    """A field on the even grid that is drawn, of a field on the uneven axes of the series.

    Between two drawn vertices places run linearly. Bricks and cells take in all that they touch.
    """

    stride = 1

    def __init__(self, field: Field, warp: Warp) -> None:
        """Stand between a marcher and a field."""
        self._field, self.arrays = field, field.arrays
        arrays = field.arrays
        counts = [
            own if places is None else len(places)
            for own, places in zip(warp.counts, warp.places, strict=True)
        ]
        self._places = [
            np.arange(count, dtype=np.float64) if places is None else places
            for count, places in zip(counts, warp.places, strict=True)
        ]
        self._tables = [None if places is None else arrays.array(places) for places in warp.places]
        ends, inner = (arrays.host(box) for box in (field.bounds, field.vertices))
        self.bounds = arrays.array(np.stack([self._drawn(end) for end in ends.T], axis=-1))
        self.vertices = arrays.array(np.stack([self._drawn(end) for end in inner.T], axis=-1))
        self._origin = np.floor(arrays.host(self.vertices)[:, 0]).astype(np.int64)
        self._last = np.ceil(arrays.host(self.vertices)[:, 1]).astype(np.int64)
        self.first = arrays.array(self._origin.astype(np.float64))
        low, high, first = field.bricks.low, field.bricks.high, arrays.host(field.first)
        # Bricks of drawn cells have the extreme values of all bricks that they touch.
        for axis, number in ((0, 2), (1, 1), (2, 0)):
            begin, end = self._touched(number, SIDE, low.shape[axis], float(first[number]))
            low = span_extremes(low, begin, end, axis, np.minimum)
            high = span_extremes(high, begin, end, axis, np.maximum)
        self.bricks = replace(field.bricks, low=low, high=high)

    def _drawn(self, places: Array) -> Array:
        """Places (3,) of the series in drawn vertices, beyond the ends as far beyond."""
        return np.array(
            [
                at if table is None else np.interp(at, own, np.arange(len(own)))
                for at, own, table in zip(places, self._places, self._tables, strict=True)
            ],
            dtype=np.float64,
        )

    def _touched(
        self, number: int, side: int, blocks: int, first: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """First and last block of the series that each block of drawn cells touches.

        number: axis, 0 for x. side: cells of a block. blocks: of the series. first: where they
        begin.
        """
        origin, last = int(self._origin[number]), int(self._last[number])
        starts = np.arange(origin, max(last, origin + 1), side)
        stops = np.minimum(starts + side, last)
        own = self._places[number]
        ends = [own[np.clip(at, 0, len(own) - 1)] - first for at in (starts, stops)]
        begin = np.floor(ends[0] / side - 1e-9)
        end = np.floor(ends[1] / side + 1e-9)
        return (
            np.clip(begin, 0, blocks - 1).astype(np.int64),
            np.clip(end, 0, blocks - 1).astype(np.int64),
        )

    def visible(self, palette: Palette) -> Array:
        """Drawn cells (z, y, x) that touch a visible cell of the series."""
        seen = self.arrays.host(self._field.visible(palette))
        first = self.arrays.host(self._field.first)
        for axis, number in ((0, 2), (1, 1), (2, 0)):
            begin, end = self._touched(number, 1, seen.shape[axis], float(first[number]))
            seen = span_extremes(seen, begin, end, axis, np.logical_or)
        return self.arrays.array(seen)

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        """Values (n,) at places (n, 3) in drawn vertices, NaN where there is none."""
        return self._field.values(self._moved(places)[0], wanted)

    def slopes(self, places: Array) -> Array:
        """Derivatives (n, 3) by x, y and z per drawn vertex, 0 where there are none."""
        moved, rates = self._moved(places)
        return self._field.slopes(moved) * rates

    def smoothed(self, deviation: float, error: float) -> Field | None:
        """Nothing: networks, which alone are warped here, are smooth."""
        return None

    def _moved(self, places: Array) -> tuple[Array, Array]:
        """Places (n, 3) in vertices of the series, and vertices of it per drawn vertex (n, 3)."""
        arrays, xp = self.arrays, self.arrays.xp
        moved, rates = arrays.copy(places), arrays.full(places.shape, 1.0)
        for axis, table in enumerate(self._tables):
            if table is None:
                continue
            at = xp.clip(places[:, axis], 0.0, float(len(table) - 1))
            before = arrays.to_int64(xp.clip(xp.floor(at), 0.0, float(max(len(table) - 2, 0))))
            low = xp.take(table, before)
            rate = xp.take(table, before + 1) - low
            moved[:, axis] = low + (at - arrays.to_float64(before)) * rate
            rates[:, axis] = rate
        return moved, rates


ENDLESS = 2.0**62
"""A number of samples that no ray reaches."""
NEAR = 1e-7
"""Largest distance from a face, in vertices, that is taken for rounding. Rounding moves a place by
less, even where the camera is far away.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Beams:
    """The samples of many rays.

    Sample k of a ray lies at origin + k * pace, or at the nearest place to that at which the field
    has values; where planes cut the box, none lies behind the place where its ray leaves. Places
    between samples have fractions of k. All attributes but `step` and `cut` are arrays of `arrays`,
    float64 unless said otherwise.

    Attributes:
        origin: (n, 3), place of sample 0, x, y, z in vertices of the domain.
        pace: (n, 3), from one sample to the next.
        begin, end: int64 (n,), the samples between which the field can have values, half-open.
        entered, leaving: (n,), where the ray enters and leaves the bounds of the field, in samples.
        last: int64 (n,), the last sample of the whole path.
        rest: (n,), length of the last sample's step, in steps.
        depth: (n,), of sample 0 from the eye, in units of the coordinates.
        along: (n, 3), unit vectors in physical directions.
        step: length from one sample to the next, in units of the coordinates.
        bounds: (3, 2), box in which the field has values.
        inside: (3, 2), the same box, but for faces that a clip makes within the field: behind one
            lies a cell that is not seen, and no sample takes its gradient.
        cut: whether planes cut the box.
    """

    arrays: Arrays
    origin: Array
    pace: Array
    begin: Array
    end: Array
    entered: Array
    leaving: Array
    last: Array
    rest: Array
    depth: Array
    along: Array
    step: float
    bounds: Array
    inside: Array
    cut: bool = False

    @classmethod
    def of(cls, task: Task, within: Array, rows: range, arrays: Arrays = NUMPY) -> Beams:
        """The rays of rows of the picture; the rays of a pixel follow one another.

        within: box (3, 2) in which the field has values.
        """
        xp = arrays.xp
        (width, _), rays_of_pixel = task.rays.size, task.antialiasing**2
        number = rows.start * width * rays_of_pixel + arrays.range(
            len(rows) * width * rays_of_pixel
        )
        eye, direction = _lines(task.rays, number, task.antialiasing, arrays)
        spacing = arrays.array(task.rays.grid.spacing)
        box = arrays.array(task.bounds)
        low = xp.maximum(within[:, 0], box[:, 0])
        # Where nothing is left, nothing, and no box that is turned over.
        high = xp.maximum(xp.minimum(within[:, 1], box[:, 1]), low)
        inner = xp.maximum(xp.where(high < within[:, 1], high - NEAR / 2, high), low)
        inside = xp.stack([low, inner], axis=1)
        within = xp.stack([low, high], axis=1)
        path = _paths(eye, direction, box, within, arrays.array(task.planes), arrays)
        steps = (path.leave - path.enter) / task.step
        count = xp.ceil(xp.clip(steps, None, ENDLESS))
        share = shares(number, arrays) if task.jitter else arrays.full(len(number), 0.5)
        depth = path.enter + share * task.step
        entered, leaving = (
            (place - path.enter) / task.step - share for place in (path.first, path.stop)
        )
        begin = xp.where(path.first > path.enter, xp.ceil(entered), 0.0)
        end = xp.where(path.stop < path.leave, xp.floor(leaving) + 1, count)
        none = 0 * count
        return cls(
            arrays=arrays,
            origin=eye + depth[:, None] * direction,
            pace=direction * task.step,
            begin=arrays.to_int64(xp.clip(begin, none, count)),
            end=arrays.to_int64(xp.where(path.hit, xp.clip(end, none, count), 0.0)),
            entered=entered,
            leaving=leaving,
            last=arrays.to_int64(count) - 1,
            rest=steps - (count - 1),
            depth=depth,
            along=direction * spacing,
            step=task.step,
            bounds=within,
            inside=inside,
            cut=len(task.planes) > 0,
        )

    def places(self, rays: Array, at: Array) -> Array:
        """Places (n, ..., 3) at samples (n, ...) of rays (n,), clipped to the field's bounds."""
        extra = (1,) * (at.ndim - 1)
        origin, pace = (ends[rays].reshape(-1, *extra, 3) for ends in (self.origin, self.pace))
        if self.cut:
            at = self.arrays.xp.minimum(
                self.arrays.to_float64(at), self.leaving[rays].reshape(-1, *extra)
            )
        return self.arrays.xp.clip(
            origin + at[..., None] * pace, self.inside[:, 0], self.inside[:, 1]
        )

    def borders(self, rays: Array, at: Array) -> Array:
        """`places` for the samples at which rays enter or leave, snapped onto the faces.

        Otherwise rounding decides whether a ray meets an isosurface that coincides with a face.
        """
        xp, places = self.arrays.xp, self.places(rays, at)
        for face in (self.bounds[:, 0], self.bounds[:, 1]):
            places = xp.where(xp.abs(places - face) < NEAR, face, places)
        return places


def _lines(rays: Rays, number: Array, side: int, arrays: Arrays) -> tuple[Array, Array]:
    """Origins (n, 3) of rays and directions (n, 3) of unit length in the coordinates.

    number: int64 (n,), numbers of the rays: pixel by pixel, side * side rays for each.
    """
    xp, (width, height), rays_of_pixel = arrays.xp, rays.size, side * side
    pixel, within = number // rays_of_pixel, number % rays_of_pixel
    column = arrays.to_float64(pixel % width) + (arrays.to_float64(within % side) + 0.5) / side
    row = arrays.to_float64(pixel // width) + (arrays.to_float64(within // side) + 0.5) / side
    u, w = 2 * column / width - 1, 1 - 2 * row / height
    right, up, forward, eye, spacing = (
        arrays.array(vector)
        for vector in (rays.right, rays.up, rays.forward, rays.eye, rays.grid.spacing)
    )
    across = u[:, None] * right + w[:, None] * up
    eye, direction = (
        (eye + across, forward + 0 * across)
        if rays.parallel
        else (eye + 0 * across, forward + across)
    )
    return eye, direction / xp.sqrt(xp.sum((direction * spacing) ** 2, axis=1))[:, None]


class _Paths(NamedTuple):
    """Paths of rays, each (n,), as lengths in the coordinates from the rays' origins.

    enter, leave: where the drawn box begins and ends; 0 for rays that do not hit.
    first, stop: where the part of it begins and ends in which the field has values.
    hit: whether there is such a part.
    """

    enter: Array
    leave: Array
    first: Array
    stop: Array
    hit: Array


def _paths(
    eye: Array, direction: Array, box: Array, within: Array, planes: Array, arrays: Arrays
) -> _Paths:
    """The paths of rays through the drawn box and the field's box (3, 2) within it.

    planes: (n, 4), which cut the box.
    """
    xp = arrays.xp
    enter, leave = slab(eye, direction, box, arrays)
    for plane in planes:
        enter, leave = _half_space(eye, direction, plane, enter, leave, arrays)
    first, stop = slab(eye, direction, within, arrays)
    hit = (leave > enter) & (stop > first)
    first, stop = xp.maximum(first, enter), xp.minimum(stop, leave)
    enter, leave, first, stop = (xp.where(hit, end, 0.0) for end in (enter, leave, first, stop))
    return _Paths(enter, leave, first, stop, hit)


def _half_space(
    eye: Array, direction: Array, plane: Array, enter: Array, leave: Array, arrays: Arrays
) -> tuple[Array, Array]:
    """Narrow paths of rays to one side of a plane (4,)."""
    xp, endless = arrays.xp, arrays.full((), np.inf)
    distance = plane[3] - xp.sum(eye * plane[:3], axis=1)
    approach = xp.sum(direction * plane[:3], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = distance / approach
    behind = xp.where(distance > 0, endless, -endless)  # where the ray does not approach
    first = xp.where(approach > 0, at, xp.where(approach < 0, -endless, behind))
    return xp.maximum(enter, first), xp.minimum(leave, xp.where(approach < 0, at, endless))


def slab(origin: Array, direction: Array, bounds: Array, arrays: Arrays) -> tuple[Array, Array]:
    """Entry and exit of rays (n, 3) at a box (3, 2), in lengths of their direction.

    A ray that misses the box leaves it before it enters.
    """
    xp = arrays.xp
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = ((bounds[:, side] - origin) / direction for side in (0, 1))
    inside = (origin >= bounds[:, 0]) & (origin <= bounds[:, 1])
    flat = direction == 0  # along a face: inside or not, without a division
    endless = arrays.full((), np.inf)
    low = xp.where(flat, xp.where(inside, -endless, endless), xp.minimum(near, far))
    high = xp.where(flat, xp.where(inside, endless, -endless), xp.maximum(near, far))
    return xp.clip(xp.amax(low, axis=1), 0.0, None), xp.amin(high, axis=1)


def shares(numbers: Array, arrays: Arrays) -> Array:
    """A share 0..1 for each number: the hash lowbias32 of C. Wellons (public domain)."""
    x = numbers & 0xFFFFFFFF
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        # What overflows int64 is above the 32 bits that count.
        x = ((x ^ (x >> shift)) * factor) & 0xFFFFFFFF
    x = x ^ (x >> 16)
    return (arrays.to_float64(x) + 0.5) / 2.0**32


@dataclass(frozen=True, kw_only=True, eq=False)
class Leaping:
    """The bricks that matter, and how far away they are.

    Attributes:
        distance: int64 (z, y, x), of each brick to the nearest that matters, in bricks, a diagonal
            step counted as one.
        last: (3,), number (x, y, z) of the last brick.
        first: (3,), place (x, y, z) at which the first brick begins.
        side: side of a brick, in vertices of the domain.
    """

    arrays: Arrays
    distance: Array
    last: Array
    first: Array
    side: float

    @classmethod
    def of(cls, field: Field, task: Task) -> Leaping:
        """Leaping for a task: over bricks without a visible value and without a surface.

        task: with the table that samples take.
        """
        arrays, distance = field.arrays, field.bricks.distance(task)
        last = arrays.array(np.array(distance.shape[::-1]) - 1.0)
        return cls(
            arrays=arrays,
            distance=arrays.array(distance, "int64"),
            last=last,
            first=field.first,
            side=float(SIDE * field.stride),
        )

    def matters(self, places: Array) -> Array:
        """Whether places (..., 3) lie in bricks that matter."""
        return self.distance[self._bricks(places)[1]] == 0

    def leap(
        self, origin: Array, pace: Array, sample: Array, end: Array, going: Array
    ) -> tuple[Array, Array | int]:
        """The next sample (n,) of each ray, from `sample` on, in a brick that matters, or `end`.

        Also returns the number of leaps that it took.

        origin: places (n, 3) of the samples 0. pace: (n, 3), from one sample to the next.
        going: bool (n,), rays that leap, all of those that the host picked; others stay.
        """
        arrays, xp = self.arrays, self.arrays.xp
        sample = arrays.copy(sample)
        pending = arrays.range(len(sample))
        leaps: Array | int = 0
        while len(pending):
            for _ in range(arrays.leaps):
                brick, index = self._bricks(
                    origin[pending] + sample[pending][:, None] * pace[pending]
                )
                away = self.distance[index]
                leaping = (away > 0) & going
                some = arrays.candidates(leaping)
                pending, brick, away = pending[some], brick[some], away[some][:, None]
                going = leaping[some]
                onward = xp.maximum(
                    self._beyond(origin[pending], pace[pending], brick, away), sample[pending] + 1
                )
                sample[pending] = arrays.kept(
                    going, xp.minimum(onward, end[pending]), sample[pending]
                )
                leaps += xp.count_nonzero(going)
                going = going & (sample[pending] < end[pending])
            (left,) = arrays.nonzero(going)
            pending, going = pending[left], going[left]
        return sample, leaps

    def _beyond(self, start: Array, step: Array, brick: Array, away: Array) -> Array:
        """The first sample (n,) of each ray beyond the cube of bricks in which none matters.

        start: places (n, 3) of the samples 0. step: (n, 3), from one sample to the next.
        brick: numbers (n, 3) of the bricks in the middle of the cubes.
        away: (n, 1), distances of these bricks to the nearest that matters.
        """
        xp = self.arrays.xp
        # The faces of the cube towards which the ray goes.
        face = (
            self.arrays.to_float64(xp.where(step > 0, brick + away, brick - away + 1)) * self.side
            + self.first
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = xp.clip(
                xp.amin(xp.where(step == 0, np.inf, (face - start) / step), axis=1), None, ENDLESS
            )
        return self.arrays.to_int64(xp.floor(reach)) + 1

    def _bricks(self, places: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        """Numbers (..., 3), x, y, z, of the bricks at places, and their index (z, y, x)."""
        at = self.arrays.xp.floor((places - self.first) / self.side)
        brick = self.arrays.to_int64(self.arrays.xp.clip(at, 0 * self.last, self.last))
        return brick, (brick[..., 2], brick[..., 1], brick[..., 0])


class Factors:
    """The factors of a `Grading`, as a function of places in a field."""

    def __init__(self, field: Field, task: Task, grading: Grading) -> None:
        arrays = field.arrays
        self._field, self._arrays = field, arrays
        self._central = task.lighting is not None and task.lighting.central
        self._spacing = arrays.array(task.rays.grid.spacing)
        self._scale = GRADES / grading.top
        self._factors = arrays.array(np.append(grading.factors, grading.factors[-1]), "float64")

    def __call__(self, places: Array) -> Array:
        """Factors (n,) of the extinction at places (n, 3) of the domain."""
        xp = self._arrays.xp
        slopes = (
            central_slopes(self._field, places, self._field)
            if self._central
            else self._field.slopes(places)
        ) / self._spacing
        entry = xp.clip(xp.sqrt(xp.sum(slopes * slopes, axis=1)) * self._scale, 0.0, float(GRADES))
        before = self._arrays.to_int64(entry)
        low, high = xp.take(self._factors, before), xp.take(self._factors, before + 1)
        return low + (entry - self._arrays.to_float64(before)) * (high - low)
