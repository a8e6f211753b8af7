"""Quality of decoded frames against their source: errors over all and over the bulk, SSIM."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import pairwise, product
from math import prod
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.measure.errors import (
    BulkQuality,
    Errors,
    StepErrors,
    range_and_sum,
)
from fhash_codec.measure.value_range import ValueRange, pieces, power_of_two
from fhash_codec.native import pointer
from fhash_codec.progress import Progress, attribute, silent
from fhash_formats.errors import InputError
from fhash_formats.series import step_blocks
from fhash_formats.support.threads import share_out, usable_threads
from fhash_formats.support.values import Double, Mask, Values

SIGMA = 1.5
"""Standard deviation of the Gaussian window, in vertices."""

RADIUS = 5
"""Vertices of the window on either side of its middle."""

WINDOW = 2 * RADIUS + 1
"""Vertices of the window along each axis."""

K1 = 0.01
"""Constant of the mean, as a fraction of the range (Wang et al. 2004)."""

K2 = 0.03
"""Constant of the variance, as a fraction of the range (Wang et al. 2004)."""

TILE = (64, 32, 64)
"""Vertices (z, y, x) that native code (fhash_codec/native/quality.cpp) compares at once."""

BUDGET = 2**25
"""Vertices of all steps that are measured together, by default."""

LEAST_VERTICES = 1 << 15
"""Vertices of a frame whose SSIM takes as long as all that is done once for a frame."""

_NOT_FINITE = "SSIM: decoded values are not finite where they are compared"

Tile = tuple[tuple[int, int], ...]
"""Half-open spans of vertices along z, y and x."""


def ssim(
    original: npt.NDArray[Any],
    decoded: npt.NDArray[Any],
    data_range: float,
    mask: Mask | None = None,
    *,
    threads: int | None = None,
) -> tuple[float, int]:
    """Sum of the local similarity of two frames, and the number of vertices in the sum.

    Their quotient is the mean SSIM.

    original, decoded: frames (z, y, x) of one shape.
    data_range: of the series, in data units; 0 or an infinite one has no SSIM and gives (0.0, 0).
    mask: vertices (z, y, x) to be measured. A mask of all True is no mask.
    threads: `usable_threads()` if None.

    Without a mask, the outer 5 vertices of every axis of at least 11 are left out, as scikit-image
    does; a shorter axis is measured whole, and an axis of one vertex gives the SSIM of the plane.
    With a mask, only its vertices are counted, and both frames take the original's value outside
    it. Borders are mirrored (scipy's
    'reflect'). Vertices whose original is not finite are not counted, and both frames take the mean
    of the original there. Raises InputError for frames of different shapes, and for decoded values
    that are not finite at a vertex that is compared.
    """
    if (
        original.ndim != 3
        or original.shape != decoded.shape
        or (mask is not None and mask.shape != original.shape)
    ):
        raise InputError(
            f"SSIM: the original is {original.shape}, the decoded {decoded.shape}; "
            "frames (z, y, x) of one shape are needed"
        )
    if not 0 < data_range < math.inf:
        return 0.0, 0
    if mask is not None and mask.all():
        mask = None
    margins = [RADIUS if mask is None and size >= WINDOW else 0 for size in original.shape]
    frames = _Frames(original, decoded, data_range, mask)
    spans = zip(margins, original.shape, TILE, strict=True)
    tiles = list(product(*(_cuts(margin, size - margin, limit) for margin, size, limit in spans)))
    results: dict[Tile, tuple[float, int]] = {}

    def work(share: Sequence[Tile]) -> None:
        for tile in share:
            results[tile] = frames.similarity(tile)

    share_out(work, tiles, usable_threads(threads))
    totals, counts = zip(*results.values(), strict=True)
    return math.fsum(totals), sum(counts)


def ssim_steps(steps: int, vertices_per_step: int, budget: int = BUDGET) -> list[int]:
    """Evenly spaced steps, ends included, with at most `budget` vertices together.

    At least one step is measured: the middle one. Small frames count as of LEAST_VERTICES.
    """
    return even_steps(steps, max(1, min(steps, budget // max(vertices_per_step, LEAST_VERTICES))))


def even_steps(steps: int, count: int) -> list[int]:
    """Some of all steps, evenly spaced, ends included; the middle one for a count of 1."""
    if count == 1:
        return [steps // 2]
    return [(2 * number * (steps - 1) + count - 1) // (2 * (count - 1)) for number in range(count)]


class _Frames:
    """Two frames to compare, scaled by a power of two near the range and shifted by the mean.

    Their squares then stay small and exact.
    """

    def __init__(
        self,
        original: npt.NDArray[Any],
        decoded: npt.NDArray[Any],
        data_range: float,
        mask: Mask | None,
    ) -> None:
        self.scale = np.float64(power_of_two(data_range))
        self.c1, self.c2 = (K1 * data_range * self.scale) ** 2, (K2 * data_range * self.scale) ** 2
        narrow = decoded.dtype == np.float32 and (
            original.dtype == np.float32 or original.dtype.itemsize <= 2
        )
        kind = np.float32 if narrow else np.float64
        self.original, self.decoded = (
            np.ascontiguousarray(frame, dtype=kind) for frame in (original, decoded)
        )
        self.mask = None if mask is None else np.ascontiguousarray(mask)
        count, total = 0, 0.0
        for piece in pieces(self.original):
            piece_count, _, _, piece_total = range_and_sum(piece, float(self.scale))
            count, total = count + piece_count, total + piece_total
        self.mean = np.float64(total / count if count else 0.0)

    def similarity(self, tile: Tile) -> tuple[float, int]:
        """Sum of the similarity over a tile, and the number of vertices in the sum."""
        function = getattr(native.library(), f"fhash_ssim_f{8 * self.original.dtype.itemsize}")
        total = native.ffi.new("double *")
        numbers = (self.scale, self.mean, self.c1, self.c2, *_weights()[RADIUS:])
        count = function(
            *map(pointer, (self.original, self.decoded, self.mask)),
            self.original.shape,
            [end for span in tile for end in span],
            numbers,
            total,
        )
        if count == -1:
            raise InputError(_NOT_FINITE)
        if count < 0:
            raise MemoryError(f"no memory to compare the frames' tile {tile}")
        return total[0], count


def _cuts(start: int, stop: int, limit: int) -> list[tuple[int, int]]:
    """Spans of at most `limit` vertices that split an axis evenly."""
    count = -(-(stop - start) // limit)
    ends = [start + (stop - start) * number // count for number in range(count + 1)]
    return list(pairwise(ends))


@lru_cache(maxsize=1)
def _weights() -> Double:
    """The Gaussian window along one axis (WINDOW,); its sum is 1."""
    weights = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
    normalised: Double = weights / weights.sum()
    return normalised


@dataclass(frozen=True, kw_only=True)
class BetweenQuality:
    """PSNR in dB over parts of the coreset; None if a part is empty or its error is 0."""

    psnr_key_frames: Annotated[float | None, "at the steps that are key frames"]
    psnr: Annotated[float | None, "at the other steps"]
    psnr_linear: Annotated[float | None, "there, of the source interpolated linearly"]
    psnr_fringe: Annotated[float | None, "there, where only one of the key frames around is kept"]
    psnr_fringe_linear: Annotated[float | None, "there, of the interpolated source"]
    fringe_fraction: Annotated[float, "share of these vertices at those steps"]


class Neighbours(NamedTuple):
    """The key frames around a step that is none.

    Attributes:
        before, after: frames (z, y, x) of the source at the two key frames.
        after_weight: weight in [0, 1] of the later one in a linear interpolation.
        fringe: vertices (z, y, x) in the coreset of only one of the two.
    """

    before: Values
    after: Values
    after_weight: float
    fringe: Mask

    def interpolated(self) -> npt.NDArray[np.float64]:
        """The source at the step by linear interpolation, float64 (z, y, x)."""
        weight = self.after_weight
        if weight == 0:
            return self.before.astype(np.float64)
        # Values near the ends of float64 overflow in no product, since both weights are below 1.
        with np.errstate(invalid="ignore"):
            before, after = self.before.astype(np.float64), self.after.astype(np.float64)
            return (1 - weight) * before + weight * after


NeighboursOf = Callable[[int], Neighbours | None]
"""Step -> its neighbours; None for a key frame."""


def neighbours_of(
    key_frames: tuple[int, ...],
    key_index: Callable[[float], float],
    read: Callable[[int], Values],
    occupancy: Callable[[float], Mask],
) -> NeighboursOf:
    """A function that gives the neighbours of a step, with the frames of two key frames held.

    key_frames: the steps that are key frames, ascending.
    key_index: step -> key index, as `KeyTimes.key_index`.
    read, occupancy: step -> frame of the source, and -> mask (z, y, x) of the coreset.
    """
    held = lru_cache(maxsize=2)(lambda step: (read(step), occupancy(step)))

    def neighbours(step: int) -> Neighbours | None:
        if step in key_frames:
            return None
        index = key_index(step)
        first = int(index)
        before, in_before = held(key_frames[first])
        after, in_after = held(key_frames[min(first + 1, len(key_frames) - 1)])
        if index == first:  # before the first key frame, or after the last one
            return Neighbours(before, before, 0.0, np.zeros_like(in_before))
        return Neighbours(before, after, index - first, in_before ^ in_after)

    return neighbours


class BetweenSums(NamedTuple):
    """Scaled differences of one step that is no key frame.

    Attributes:
        linear: of the interpolated source, over the coreset.
        fringe, fringe_linear: over the fringe, of decoded values and of the interpolated source.
    """

    linear: Double
    fringe: Double
    fringe_linear: Double


class BetweenErrors:
    """Errors of a series at key frames and between them, step by step."""

    def __init__(self, data_range: float) -> None:
        self._key_frames, self._between, self._linear, self._fringe, self._fringe_linear = (
            Errors(data_range) for _ in range(5)
        )

    def compare(
        self, step: int, original: Values, decoded: Values, mask: Mask, neighbours: Neighbours
    ) -> BetweenSums:
        """The differences of a step that is no key frame, for `add`; safe in any thread.

        original, decoded, mask: values, and vertices of the coreset (1, z, y, x).
        """
        linear = neighbours.interpolated()[None]
        # The source may have no finite value at a key frame where it has one at the step.
        known = mask & np.isfinite(linear)
        fringe = mask & neighbours.fringe
        original_wide = original.astype(np.float64)
        return BetweenSums(
            linear=self._linear.compare(step, original_wide, linear, known),
            fringe=self._fringe.compare(step, original, decoded, fringe),
            fringe_linear=self._fringe_linear.compare(
                step, original_wide, linear, known & neighbours.fringe
            ),
        )

    def add(self, coreset: Double, between: BetweenSums | None) -> None:
        """Add a step, or several key frames, for which `between` is None."""
        if between is None:
            self._key_frames.take(coreset)
            return
        self._between.take(coreset)
        self._linear.take(between.linear)
        self._fringe.take(between.fringe)
        self._fringe_linear.take(between.fringe_linear)

    def quality(self) -> BetweenQuality | None:
        """The figures of all steps added; None without a step between key frames."""
        if not self._between.sums:
            return None
        return BetweenQuality(
            psnr_key_frames=self._key_frames.psnr,
            psnr=self._between.psnr,
            psnr_linear=self._linear.psnr,
            psnr_fringe=self._fringe.psnr,
            psnr_fringe_linear=self._fringe_linear.psnr,
            fringe_fraction=self._fringe.count / max(self._between.count, 1),
        )


FRAMES_HELD = 8
"""Frames of each series in memory at a time while they are compared, at most."""

VERTICES_HELD = 1 << 24
"""Vertices of these frames together, at most; a single larger frame is allowed."""


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Figures of a series; None if no vertex is counted or a figure has no finite value."""

    psnr: Annotated[float | None, "dB over the coreset of all steps"]
    rmse: Annotated[float | None, "over the coreset of all steps"]
    max_abs_error: Annotated[float | None, "over the coreset of all steps"]
    bulk: Annotated[BulkQuality | None, "over the middle 98 % of the values; null without such"]
    ssim: Annotated[float | None, "mean over the coreset of the measured steps"]
    ssim_window: Annotated[dict[str, Any], "sigma and window in vertices, range and steps"]
    psnr_domain: Annotated[float | None, "dB over all, background outside the coreset"]
    rmse_domain: Annotated[float | None, "likewise"]
    max_abs_error_domain: Annotated[float | None, "likewise"]
    per_step: Annotated[list[StepErrors], "figures over the coreset of each step"]
    between: Annotated[BetweenQuality | None, "null if every step is a key frame"] = None

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        values = {**vars(self)}
        for name in ("bulk", "between"):
            values[name] = None if values[name] is None else asdict(values[name])
        if self.bulk is not None:
            values["bulk"]["range"] = list(self.bulk.range)
        return values


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Comparison of neighbouring steps.

    Attributes:
        stop: the step after the last one.
        coreset, domain: scaled differences over the coreset, and over all vertices, of each step:
            (t, 5), see `step_sums`.
        similarity: what `ssim` returns for each step, (t, 2); 0 where it is not measured.
        seconds, ssim_seconds: of the comparison, and of the SSIM alone, in its thread.
        between: differences of the interpolated source, of one step; None for key frames.
    """

    stop: int
    coreset: Double
    domain: Double
    similarity: Double
    between: BetweenSums | None
    seconds: float
    ssim_seconds: float


class Comparer:
    """Comparison of decoded steps with the original, a few steps at a time in threads.

    The figures are added up in the order of the steps, whatever the number of threads.
    """

    def __init__(
        self,
        data_range: float,
        background: float,
        bulk: ValueRange | None = None,
        observe: Callable[[Comparison], None] = lambda comparison: None,
    ) -> None:
        """Begin without steps.

        data_range: of the original series, in data units.
        background: decoded value outside the coreset for the figures over the domain.
        bulk: of the original series (`find_bulk`); no figures of it if None.
        observe: called with each step that is added.
        """
        self.coreset, self.domain = Errors(data_range, bulk), Errors(data_range)
        self._observe = observe
        self.between = BetweenErrors(data_range)
        self.similarity, self.similar_vertices = 0.0, 0
        # Of all threads together: reading, decoding and comparing, and the SSIM alone.
        self.seconds, self.ssim_seconds = 0.0, 0.0
        self._background = background

    def compare(
        self,
        steps: range,
        original: Values,
        decoded: Values,
        neighbours: Neighbours | None,
        *,
        measured: Collection[int],
        threads: int,
    ) -> Comparison:
        """Compare neighbouring steps (t, z, y, x); safe in any thread.

        neighbours: the key frames around the only step; None for key frames.
        measured: steps whose SSIM is measured. threads: of the SSIM.

        Raises InputError for frames of different shapes.
        """
        begun, first = time.perf_counter(), steps.start
        if original.shape != decoded.shape:
            raise InputError(
                f"step {first}: the original is {original.shape[1:]}, the decoded "
                f"{decoded.shape[1:]}; they must be of one shape"
            )
        in_coreset = np.isfinite(decoded)
        mask = None if in_coreset.all() else in_coreset
        coreset = domain = self.coreset.compare(first, original, decoded, mask)
        if mask is not None:
            filled = np.where(mask, decoded, decoded.dtype.type(self._background))
            domain = self.domain.compare(first, original, filled)
        similarity, ssim_begun = np.zeros((len(steps), 2)), time.perf_counter()
        for place in (step - first for step in steps if step in measured):
            frames = original[place], decoded[place]
            one = None if mask is None else mask[place]
            similarity[place] = ssim(*frames, self.coreset.data_range, one, threads=threads)
        ssim_seconds = time.perf_counter() - ssim_begun
        between = None
        if neighbours is not None:
            between = self.between.compare(first, original, decoded, in_coreset, neighbours)
        return Comparison(
            stop=steps.stop,
            coreset=coreset,
            domain=domain,
            similarity=similarity,
            between=between,
            seconds=time.perf_counter() - begun,
            ssim_seconds=ssim_seconds,
        )

    def add(self, comparison: Comparison) -> None:
        """Add steps to the figures of the series; the steps come in order."""
        self.coreset.take(comparison.coreset)
        self.domain.take(comparison.domain)
        self.between.add(comparison.coreset, comparison.between)
        for total, vertices in comparison.similarity.tolist():
            self.similarity += total
            self.similar_vertices += int(vertices)
        self.seconds += comparison.seconds
        self.ssim_seconds += comparison.ssim_seconds
        self._observe(comparison)

    def tell_ssim(self, steps: int, elapsed: float) -> None:
        """Record the stage of the SSIM: its share of all work, in seconds of the clock.

        steps: number of measured steps. elapsed: seconds of the whole measurement.
        """
        if not steps:
            return
        share = self.ssim_seconds / max(self.seconds, 1e-9)
        attribute("ssim", f"likeness of {steps} steps, for the reports", share * elapsed)

    def quality(self, measured: list[int]) -> Quality:
        """The figures of all steps added; `measured` are the steps whose SSIM is."""
        coreset, domain = self.coreset, self.domain
        data_range = coreset.data_range
        return Quality(
            psnr=coreset.psnr,
            rmse=coreset.rmse,
            max_abs_error=coreset.max_abs_error,
            bulk=coreset.bulk_quality(),
            ssim=self.similarity / self.similar_vertices if self.similar_vertices else None,
            ssim_window={
                "sigma": SIGMA,
                "window": WINDOW,
                "data_range": data_range if math.isfinite(data_range) else None,
                "steps": measured,
            },
            psnr_domain=domain.psnr,
            rmse_domain=domain.rmse,
            max_abs_error_domain=domain.max_abs_error,
            per_step=coreset.per_step(),
            between=self.between.quality(),
        )


def measure_quality(
    comparer: Comparer,
    original_frames: Callable[[range], Values],
    decode: Callable[[range], Values],
    shape: Sequence[int],
    measured: Sequence[int],
    progress: Progress = silent,
    neighbours: NeighboursOf | None = None,
) -> Quality:
    """Compare all steps of a decoded series with the original.

    comparer: new; what it observes are the comparisons of the steps, in their order.
    original_frames, decode: neighbouring steps -> frames (t, z, y, x) of the original, and of the
        decoded series. A vertex is in the coreset if its decoded value is finite.
    shape: (t, z, y, x) of both.
    measured: steps whose SSIM over the coreset is measured (`ssim_steps`).
    neighbours: of the key frames, see `neighbours_of`; None if every step is a key frame.

    At most FRAMES_HELD frames or small blocks of frames of each series are in memory. Raises
    InputError for frames of different shapes. Progress stage: "measuring".
    """
    begun = time.perf_counter()
    steps, *frame = shape
    threads, waiting, with_ssim = usable_threads(), deque[Future[Comparison]](), set(measured)
    blocks = [block for _, block in step_blocks(range(steps), frame)]
    at_once = max(1, min(FRAMES_HELD, len(blocks), VERTICES_HELD // max(prod(frame), 1)))

    def collect() -> None:
        """Wait for the first steps under way, and add them."""
        comparison = waiting.popleft().result()
        comparer.add(comparison)
        # The figure of all steps so far: those of single steps would go up and down.
        psnr = comparer.coreset.psnr
        note = "" if psnr is None else f"{psnr:.1f} dB so far"
        progress("measuring", comparison.stop, steps, note)

    with ThreadPoolExecutor(threads, thread_name_prefix="fhash-measure") as workers:
        for block in blocks:
            # before more is read: large frames would be held once more
            while len(waiting) >= at_once:
                collect()
            reading = time.perf_counter()
            original, decoded = original_frames(block), decode(block)
            comparer.seconds += time.perf_counter() - reading
            for part in [block] if neighbours is None else [range(n, n + 1) for n in block]:
                inside = slice(part.start - block.start, part.stop - block.start)
                waiting.append(
                    workers.submit(
                        comparer.compare,
                        part,
                        original[inside],
                        decoded[inside],
                        None if neighbours is None else neighbours(part.start),
                        measured=with_ssim,
                        threads=-(-threads // at_once),
                    )
                )
            del original, decoded
        while waiting:
            collect()
    comparer.tell_ssim(len(measured), time.perf_counter() - begun)
    return comparer.quality(list(measured))
