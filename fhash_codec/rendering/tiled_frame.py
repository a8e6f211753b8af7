"""The decoded frame of a picture, at once or block by block, and the field of one for streams."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.native import ffi
from fhash_codec.rendering.bricks import (
    CORNERS,
    FARTHEST,
    SIDE,
    Bricks,
    Palette,
    extremes,
    finite,
    nearest,
    of_cells,
    reach_of,
    smoothed,
)
from fhash_codec.rendering.grid import Grid, Warp
from fhash_codec.rendering.march_task import (
    NUMPY,
    Array,
    Arrays,
    Frame,
    Task,
    Units,
    drawn_places,
    resampled,
)
from fhash_codec.volume import Volume
from fhash_formats.support.threads import in_threads
from fhash_formats.support.values import Mask, Single

BLOCK = 64
"""Vertices along a block's side, at least: decoding smaller ones alone takes longer than the rays'
way through them."""

Spans = list[tuple[int, int]]
"""First and end along z, y and x."""


class TiledFrame:
    """The values of one time step in a region, decoded block by block; safe for several threads.

    A block is a tile of the file, or a few neighbouring ones.

    Attributes:
        region: (z, y, x) of the domain that was asked for.
        frame: has any numbers where nothing is decoded yet.
        bricks: of the frame.
        decoded: bool (z, y, x) of blocks.
        starts: along z, y and x, the first vertex of each block in vertices of the frame, and the
            end of the last.
        lock: held while bricks change.
    """

    def __init__(
        self,
        volume: Volume,
        step: float,
        lod: int,
        region: Box,
        *,
        units: Units,
        warp: Warp | None,
        whole: bool,
    ) -> None:
        """Prepare a frame.

        Args:
            volume: an open container.
            step: of the series; fractional between two steps.
            lod: level of detail; every 2^lod-th vertex along each axis is decoded.
            region: (z, y, x) of the domain; its part within the feature bounding box is decoded.
            units: of the values of the frame.
            warp: of uneven axes, whose drawn vertices the frame has.
            whole: whether all of it is decoded at once.
        """
        self.region, self.lock, stride = region, Lock(), 1 << lod
        self._given, self._warp = (volume, step, lod, units), warp
        self._lattice = lattice = _lattice(volume, lod, region)
        drawn, self._at = zip(*drawn_places(lattice, stride, warp), strict=True)
        self.starts = []
        for at, own, (first, _), size in zip(
            self._at, lattice, volume.box, block_sizes(volume, lod), strict=True
        ):
            number = (own.start - first + np.floor(at) * stride) // size
            self.starts.append(np.array([0, *np.flatnonzero(np.diff(number)) + 1, len(at)]))
        self.decoded = np.full([len(starts) - 1 for starts in self.starts], whole)
        self._locks: defaultdict[tuple[int, ...], Lock] = defaultdict(Lock)
        shape = [len(at) for at in self._at]
        # Zeros take no memory before they are written to.
        values = self._part([(0, n) for n in shape]) if whole else np.zeros(shape, np.float32)
        z, y, x = (along.start for along in drawn)
        self.frame = Frame(values=values, first=(z, y, x), stride=stride)
        low, high = map(float, units.to(volume.value_range.ends))
        bricks = Bricks.of(self.frame) if whole else Bricks.unknown(values)
        self.bricks = replace(bricks, value_range=(low, high))

    @property
    def nbytes(self) -> int:
        """Bytes of the values."""
        return self.frame.values.nbytes

    @property
    def vertices(self) -> int:
        """Number of decoded vertices."""
        lengths = np.ix_(*map(np.diff, self.starts))
        return int(np.sum(self.decoded * lengths[0] * lengths[1] * lengths[2]))

    def covers(self, region: Box) -> bool:
        """Whether the frame is of this region or a larger one."""
        return all(
            low <= first and last <= high
            for (low, high), (first, last) in zip(self.region, region, strict=True)
        )

    def complete(self) -> None:
        """Decode all that is not decoded yet."""
        for blocks in _boxes(~self.decoded):
            self._decode(blocks)

    def layers(self, blocks: Mask) -> Iterator[tuple[int, int]]:
        """Layers of the frame, from the first to before the last, that some of its blocks have."""
        for number in np.flatnonzero(blocks.any(axis=(1, 2))):
            yield int(self.starts[0][number]), int(self.starts[0][number + 1])

    def decode(self, block: tuple[int, ...]) -> None:
        """Decode a block (z, y, x), if no thread has; wait for one that does."""
        with self.lock:
            turn = self._locks[block]
        with turn:
            if not self.decoded[block]:
                self._decode([(number, number + 1) for number in block])

    def _decode(self, blocks: Spans) -> None:
        """Decode blocks, and look at their bricks."""
        spans = [
            (int(starts[first]), int(starts[end]))
            for starts, (first, end) in zip(self.starts, blocks, strict=True)
        ]
        self.frame.values[_slices(spans)] = self._part(spans)
        touched = [
            (max(first - 1, 0) // SIDE, min((end - 1) // SIDE + 1, count))
            for (first, end), count in zip(spans, self.bricks.low.shape, strict=True)
        ]
        with self.lock:
            self.decoded[_slices(blocks)] = True
            values = self.frame.values[brick_vertices(touched)]
            low, high = extremes(values)
            if not finite(low, high):
                values[np.isinf(values)] = np.nan
                low, high = extremes(values)
            self.bricks.low[_slices(touched)], self.bricks.high[_slices(touched)] = low, high

    def _part(self, spans: Spans) -> Single:
        """The values of a part of the frame, decoded and resampled where axes are uneven."""
        volume, step, lod, units = self._given
        if volume.box.intersect(self.region) is None:
            return decoded_frame(volume, step, lod, self.region, units).values
        places = [at[first:end] for at, (first, end) in zip(self._at, spans, strict=True)]
        lows = [int(at[0]) for at in places]
        region = Box.of(
            (own[low], own[math.ceil(at[-1])] + 1)
            for own, low, at in zip(self._lattice, lows, places, strict=True)
        )
        values = decoded_frame(volume, step, lod, region, units).values
        return resampled(
            values, [at - low for at, low in zip(places, lows, strict=True)], self._warp
        )


def block_sizes(volume: Volume, lod: int) -> list[int]:
    """Vertices of the series along the sides (z, y, x) of a block."""
    return [chunk * -(-(BLOCK << lod) // chunk) for chunk in volume.chunks[1:]]


def _lattice(volume: Volume, lod: int, region: Box) -> list[range]:
    """The vertices (z, y, x) of a level in a region; one alone where none is in the box."""
    inner = volume.box.intersect(region)
    if inner is None:
        return [range(low, low + 1) for low, _ in volume.box]
    stride, vertices = 1 << lod, volume.lod_vertices(lod, inner)
    return [range(own[0], own[-1] + stride, stride) for own in vertices]


def _slices(spans: Spans) -> tuple[slice, ...]:
    return tuple(slice(*span) for span in spans)


def brick_vertices(bricks: Spans, margin: int = 0) -> tuple[slice, ...]:
    """The vertices of bricks, and a margin around them, as far as a frame has them."""
    return tuple(
        slice(max(SIDE * first - margin, 0), SIDE * end + 1 + margin) for first, end in bricks
    )


def _boxes(wanted: Mask, corner: tuple[int, ...] = (0, 0, 0)) -> Iterator[Spans]:
    """Boxes of an array that hold what is wanted and nothing else."""
    if wanted.all():
        yield [(first, first + n) for first, n in zip(corner, wanted.shape, strict=True)]
    elif wanted.any():
        axis = int(np.argmax(wanted.shape))
        half = wanted.shape[axis] // 2
        for start, part in zip((0, half), np.split(wanted, [half], axis), strict=True):
            yield from _boxes(part, tuple(n + start * (a == axis) for a, n in enumerate(corner)))


def _blocks_of(
    starts: npt.NDArray[np.int64], bricks: int, margin: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The first and the last block along an axis that each brick with a margin reaches."""
    first = SIDE * np.arange(bricks) - margin
    ends = np.maximum(first, 0), np.minimum(first + SIDE + 2 * margin, starts[-1] - 1)
    first, last = (np.searchsorted(starts, end, "right") - 1 for end in ends)
    return first, last


def _reached(
    first: npt.NDArray[np.int64], last: npt.NDArray[np.int64], bricks: npt.NDArray[np.int64]
) -> list[npt.NDArray[np.int64]]:
    """The blocks along an axis that bricks reach, as `_blocks_of` has them: arrays like theirs."""
    most = int((last - first).max())
    return [np.minimum(first[bricks] + n, last[bricks]) for n in range(most + 1)]


def decoded_frame(volume: Volume, step: float, lod: int, region: Box, units: Units) -> Frame:
    """Decode a region of the feature bounding box as a marcher takes it.

    Args:
        volume: an open container.
        step: of the series; fractional between two steps.
        lod: level of detail; every 2^lod-th vertex along each axis is decoded.
        region: (z, y, x) of the domain; only its part within the feature bounding box is decoded.
        units: of the values of the frame.
    """
    inner = volume.box.intersect(region)
    if inner is None:
        # Nothing of the feature is in the picture: one vertex without a value stands for it.
        nothing = np.full((1, 1, 1), np.nan, dtype=np.float32)
        return Frame(values=nothing, first=volume.box.first, stride=1 << lod)
    if lod == 0:
        return Frame(values=units.single(volume.read(step, inner)), first=inner.first)
    z, y, x = (vertices.start for vertices in volume.lod_vertices(lod, inner))
    before, after = int(np.floor(step)), int(np.ceil(step))
    values = volume.read_lod(before, lod, inner)
    if after != before:
        share = volume.key_times.key_index(step) - volume.key_times.key_index(before)
        values = values * (1 - share) + volume.read_lod(after, lod, inner) * share
    return Frame(values=units.single(values), first=(z, y, x), stride=1 << lod)


class Fetching:
    """The state of a march through a frame whose blocks are decoded when rays come to them.

    A brick is ready where all is decoded that a sample in it reads. Bricks that are not ready
    matter to every ray.

    Attributes:
        tiles: the frame.
        reach: vertices around a block that smoothed values depend on it in.
        fields: of `FhashMarch`, by name.
        error: what a block failed by, None if none did.
    """

    def __init__(
        self,
        tiles: TiledFrame,
        task: Task,
        *,
        margin: int,
        by: str,
        smoothing: tuple[float, float] | None,
    ) -> None:
        """Prepare a march.

        Args:
            tiles: the frame.
            task: what is marched.
            margin: vertices that a sample reads around its brick.
            by: what rays leap by: 'distance' or 'highest', '' for no leaps.
            smoothing: deviation and largest error of the values that shade, None for the frame's.
        """
        self.tiles, self._task, self._by, self._smoothing = tiles, task, by, smoothing
        self.reach = margin
        shape = tiles.bricks.low.shape
        self._first, self._last = zip(
            *(_blocks_of(starts, n, margin) for starts, n in zip(tiles.starts, shape, strict=True)),
            strict=True,
        )
        self._ready = np.zeros(shape, np.int32)
        self.error: BaseException | None = None
        # Callbacks live as long as their object.
        fetch = ffi.callback("FhashFetch", self._fetch, error=1)
        self.fields: dict[str, Any] = {"ready": self._ready, "fetch": fetch}
        if by == "distance":
            self.fields["distance"] = np.zeros(shape, np.int32)
        elif by == "highest":
            self.fields["highest"] = np.full(shape, np.inf, np.float32)
        if smoothing is not None:
            self.fields["smooth"] = np.zeros_like(tiles.frame.values)
        if tiles.decoded.any():
            self._update([(0, n) for n in shape])

    def fetch(self, bricks: npt.NDArray[np.int64]) -> None:
        """Decode what the samples in bricks read, numbers in a flat array, in several threads."""
        try:
            wanted = np.zeros(self.tiles.decoded.shape, bool)
            places = np.unravel_index(bricks, self._ready.shape)
            for blocks in product(*map(_reached, self._first, self._last, places)):
                wanted[blocks] = True
            list(in_threads(self.tiles.decode, list(zip(*np.nonzero(wanted), strict=True))))
            self._update([(0, n) for n in self.tiles.bricks.low.shape])
        except BaseException as error:  # it is raised again where the march ends
            self.error = error

    def _fetch(self, brick: int) -> int:
        """Decode what the samples in a brick read. Returns 1 where that failed, now or before."""
        if self.error is not None:
            return 1
        try:
            place = np.unravel_index(brick, self._ready.shape)
            ends = [
                (int(first[n]), int(last[n]))
                for first, last, n in zip(self._first, self._last, place, strict=True)
            ]
            blocks = list(product(*(range(first, last + 1) for first, last in ends)))
            new = [block for block in blocks if not self.tiles.decoded[block]]
            for block in blocks:
                self.tiles.decode(block)
            # Of bricks that read a new block; of this one where other threads have decoded all.
            ends = [(min(along), max(along)) for along in zip(*new, strict=True)]
            self._update(
                [
                    (int(np.searchsorted(last, low)), int(np.searchsorted(first, high, "right")))
                    for first, last, (low, high) in zip(self._first, self._last, ends, strict=True)
                ]
                if new
                else [(int(n), int(n) + 1) for n in place]
            )
        except BaseException as error:  # it is raised again where the march ends
            self.error = error
            return 1
        return 0

    def _update(self, bricks: Spans) -> None:
        """Look again at bricks, some of which have become ready."""
        part, tiles = _slices(bricks), self.tiles
        with tiles.lock:
            ready = tiles.decoded
            for axis, along in enumerate(part):
                first, last = self._first[axis][along], self._last[axis][along]
                ready = np.logical_and.reduce(
                    [
                        np.take(ready, np.minimum(first + n, last), axis)
                        for n in range(int(np.max(last - first)) + 1)
                    ]
                )
            found = replace(
                tiles.bricks,
                values=tiles.frame.values[brick_vertices(bricks)],
                low=tiles.bricks.low[part],
                high=tiles.bricks.high[part],
            )
            if self._by == "distance":
                # Beyond these bricks any may matter.
                distance = np.zeros([n + 2 for n in ready.shape], np.int32)
                inner = distance[1:-1, 1:-1, 1:-1]
                inner[ready & ~found.matters(self._task)] = FARTHEST
                nearest(distance)
                self.fields["distance"][part] = inner
            elif self._by == "highest":
                largest = found.high if self._task.projection == "maximum" else -found.low
                np.copyto(self.fields["highest"][part], largest, where=ready)
            if self._smoothing is not None:
                self._smooth(bricks)
        # Locked once more, so that no processor shows another thread the flags before the rest.
        with tiles.lock:
            self._ready[part] = ready

    def _smooth(self, bricks: Spans) -> None:
        """Smooth the values in bricks and one vertex around them."""
        assert self._smoothing is not None
        deviation, error = self._smoothing
        inner = brick_vertices(bricks, 1)
        outer = brick_vertices(bricks, 1 + reach_of(deviation))
        values = np.ascontiguousarray(self.tiles.frame.values[outer])
        inside = tuple(
            slice(a.start - b.start, a.stop - b.start) for a, b in zip(inner, outer, strict=True)
        )
        self.fields["smooth"][inner] = smoothed(values, deviation, error)[inside]


class FrameField:
    """A decoded frame, trilinear between its vertices.

    A place has no value where a vertex of weight around it has none.
    """

    def __init__(self, frame: Frame, bricks: Bricks, grid: Grid, arrays: Arrays = NUMPY) -> None:
        """Copy a frame to where the arrays are. bricks: of the frame. grid: of the domain."""
        self.arrays, self.bricks, self.frame, self._grid = arrays, bricks, frame, grid
        self.stride, first = frame.stride, np.array(frame.first[::-1], dtype=np.float64)
        counts = np.array(frame.values.shape[::-1])
        self.bounds, self.first = arrays.array(frame.bounds(grid)), arrays.array(first)
        self.vertices = arrays.array(
            np.stack([first, first + (counts - 1) * frame.stride], axis=-1)
        )
        self._last = arrays.array(counts - 1.0)
        self._last_cell = arrays.array(np.maximum(counts - 2.0, 0.0))
        self._jumps = (1, int(counts[0]), int(counts[0] * counts[1]))
        self._wide = [bool(count > 1) for count in counts]
        with arrays.guarded():
            self._values = arrays.array(bricks.values)
        self._flat = self._values.reshape(-1)

    def visible(self, palette: Palette) -> Array:
        """Cells (z, y, x) with a value that has an extinction."""
        arrays, xp = self.arrays, self.arrays.xp
        layers = max(1, arrays.batch // self._jumps[2])
        visible = []
        for start in range(0, max(len(self._values) - 1, 1), layers):
            values = self._values[start : start + layers + 1]
            low, high = (
                arrays.to_float64(of_cells(values, extreme)) for extreme in (xp.fmin, xp.fmax)
            )
            visible.append(palette.visible(low, high))
        return xp.concatenate(visible)

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        """Values (n,) at places (n, 3), as `Field` has them."""
        result = self.arrays.empty((len(places),))
        for start in range(0, len(places), self.arrays.batch):
            part = slice(start, start + self.arrays.batch)
            inside, low, share = self._located(places[part], self._last)
            if wanted is not None:
                inside &= wanted[part]
            # The corner after a place counts only where it has weight: a missing vertex beyond a
            # place on a vertex does not matter.
            jumps = [
                self.arrays.to_int64(share[:, axis] > 0) * jump
                for axis, jump in enumerate(self._jumps)
            ]
            corners = self._corners(low, jumps)
            along = corners[:, :, 0] + share[:, 0] * (corners[:, :, 1] - corners[:, :, 0])
            across = along[:, 0] + share[:, 1] * (along[:, 1] - along[:, 0])
            values = across[0] + share[:, 2] * (across[1] - across[0])
            result[start : start + len(values)] = self.arrays.xp.where(inside, values, np.nan)
        return result

    def slopes(self, places: Array) -> Array:
        """Derivatives as `Field` has them; between two cells those of the cell after the border."""
        xp = self.arrays.xp
        result = self.arrays.empty((len(places), 3))
        for start in range(0, len(places), self.arrays.batch):
            _, low, share = self._located(
                places[start : start + self.arrays.batch], self._last_cell
            )
            corners = self._corners(
                low,
                [jump if wide else 0 for jump, wide in zip(self._jumps, self._wide, strict=True)],
            )
            x, y, z = share.T
            by_x = corners[:, :, 1] - corners[:, :, 0]
            along = corners[:, :, 0] + x * by_x
            by_y = along[:, 1] - along[:, 0]
            across = along[:, 0] + y * by_y
            by_x = by_x[:, 0] + y * (by_x[:, 1] - by_x[:, 0])
            slopes = xp.stack(
                [
                    by_x[0] + z * (by_x[1] - by_x[0]),
                    by_y[0] + z * (by_y[1] - by_y[0]),
                    across[1] - across[0],
                ],
                axis=-1,
            )
            slopes = xp.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
            result[start : start + len(slopes)] = slopes / self.stride
        return result

    def smoothed(self, deviation: float, error: float) -> FrameField:
        """The frame with the values that shade."""
        values = self.bricks.smoothed(deviation, error)
        frame, bricks = replace(self.frame, values=values), replace(self.bricks, values=values)
        return FrameField(frame, bricks, self._grid, self.arrays)

    def _located(self, places: Array, last_before: Array) -> tuple[Array, Array, Array]:
        """Whether places lie within the bounds, and the vertices around them.

        last_before: (3,), the last vertex (x, y, z) that may be the one before a place.
        Returns a mask (n,), the numbers (n,) of the vertices before the places, and the weights
        (n, 3) of the vertices after them.
        """
        arrays, xp, last = self.arrays, self.arrays.xp, self._last
        inside = xp.all((places >= self.bounds[:, 0]) & (places <= self.bounds[:, 1]), axis=1)
        at = xp.clip((places - self.first) / self.stride, 0 * last, last)
        before = xp.minimum(xp.floor(at), last_before)
        x, y, z = arrays.to_int64(before).T
        return inside, x + y * self._jumps[1] + z * self._jumps[2], at - before

    def _corners(self, low: Array, jumps: list[Array] | list[int]) -> Array:
        """Values (z 2, y 2, x 2, n) around places.

        low: numbers (n,) of the vertices before the places.
        jumps: steps along x, y and z to the vertices after them, (n,) or one number for all.
        """
        corners = self.arrays.empty((2, 2, 2, len(low)))
        for corner in CORNERS:
            corners[corner] = self.arrays.xp.take(self._flat, low + _jump(corner, jumps))
        return corners


def _jump(corner: tuple[int, ...], jumps: list[Array] | list[int]) -> Array | int:
    """The step in a flat array to a corner (z, y, x); jumps: steps along x, y and z."""
    return sum(jump for up, jump in zip(corner[::-1], jumps, strict=True) if up)
