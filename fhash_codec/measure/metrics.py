"""Quality of decoded frames: PSNR, RMSE, largest error and SSIM, frame by frame in float64.

Vertices whose original value is not finite are left out of every figure.
PSNR = 20 log10(range / RMSE), with the range of the whole original series. numpy only.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.ssim import SIGMA, WINDOW, ssim, ssim_steps
from fhash_codec.measure.sums import ErrorSums, Values, error_sums
from fhash_codec.measure.value_range import ValueRange, power_of_two
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import InputError
from fhash_formats.support.threads import usable_threads

__all__ = ["Errors", "Quality", "StepQuality", "measure_quality", "psnr", "ssim", "ssim_steps"]

FRAMES_HELD = 8
"""Frames of each series in memory at a time while they are compared, at most."""

VERTICES_HELD = 1 << 24
"""Vertices of these frames together, at most; a single larger frame is allowed."""


@dataclass(frozen=True, kw_only=True)
class StepQuality:
    """Figures of one step: PSNR in dB, errors in data units.

    None if no vertex is counted; the PSNR is None as well if the error or the range is 0.
    """

    step: int
    psnr: float | None
    rmse: float | None
    max_abs_error: float | None


@dataclass(frozen=True, kw_only=True)
class BulkQuality:
    """Figures over the counted vertices whose original value lies in the bulk of the series.

    Attributes:
        psnr: in dB, relative to the width of the bulk; None if the error is 0.
        rmse: in data units; None if no such vertex is counted.
        range: first and last value of the bulk, in data units.
    """

    psnr: float | None
    rmse: float | None
    range: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Figures of a series; None if no vertex is counted or a figure has no finite value.

    Attributes:
        psnr, rmse, max_abs_error: over the coreset of all steps, in dB and data units.
        bulk: over the part of it whose values are the bulk; None without a bulk.
        ssim: mean over the coreset of the measured steps.
        ssim_window: sigma and window of the SSIM in vertices, the data range and measured steps.
        psnr_domain, rmse_domain, max_abs_error_domain: over all vertices, with the background as
            the decoded value outside the coreset.
        per_step: figures over the coreset of each step.
    """

    psnr: float | None
    rmse: float | None
    max_abs_error: float | None
    bulk: BulkQuality | None
    ssim: float | None
    ssim_window: dict[str, Any]
    psnr_domain: float | None
    rmse_domain: float | None
    max_abs_error_domain: float | None
    per_step: tuple[StepQuality, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        values = {**asdict(self), "per_step": [asdict(step) for step in self.per_step]}
        if self.bulk is not None:
            values["bulk"]["range"] = list(self.bulk.range)
        return values


class Errors:
    """Squared and largest differences over frames.

    Differences are computed after scaling by an exact power of two near the range, so that neither
    huge nor tiny ranges overflow or underflow.

    Attributes:
        data_range: of the original series, in data units; inf is allowed and makes PSNR None.
        bulk: of the original series, in data units; None without one.
        count: vertices compared so far.
        steps: a StepQuality per frame.
    """

    def __init__(self, data_range: float, bulk: ValueRange | None = None) -> None:
        """Begin without frames; raises InputError for a range below 0 or NaN."""
        if not data_range >= 0:
            raise InputError(f"data range is {data_range}; 0 or more is needed")
        self.data_range = data_range
        self.bulk = bulk
        self.count = 0
        self.steps: list[StepQuality] = []
        self._scale = power_of_two(min(data_range, sys.float_info.max))
        self._squares = 0.0
        self._largest = 0.0
        self._bulk_count = 0
        self._bulk_squares = 0.0

    def add(
        self,
        step: int,
        original: Values,
        decoded: Values,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> StepQuality:
        """Compare a frame, and return the figures of its step.

        mask: vertices to be compared, all if None. The three arrays have one shape. Raises
        InputError for different shapes, and for a decoded value that is not finite at a vertex that
        is compared.
        """
        return self.take(step, self.compare(step, original, decoded, mask))

    def compare(
        self,
        step: int,
        original: Values,
        decoded: Values,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> ErrorSums:
        """The scaled differences of a frame, for `take`; parameters and errors as in `add`."""
        if original.shape != decoded.shape or (mask is not None and mask.shape != original.shape):
            raise InputError(
                f"step {step}: the original is {original.shape}, the decoded {decoded.shape}; "
                "they must be of one shape"
            )
        bulk = None if self.bulk is None else (self.bulk.low, self.bulk.high)
        errors = error_sums(original, decoded, mask, self._scale, bulk)
        if errors.number < 0:
            raise InputError(f"step {step}: decoded values are not finite where they are compared")
        return errors

    def take(self, step: int, errors: ErrorSums) -> StepQuality:
        """Add the differences of a step, and return its figures."""
        count, squares, largest = errors[:3]
        self.count += count
        self._squares += squares
        self._bulk_count += errors.bulk_count
        self._bulk_squares += errors.bulk_squares
        self._largest = max(self._largest, largest)
        figures = StepQuality(
            step=step,
            psnr=self._psnr(squares, count),
            rmse=self._rmse(squares, count),
            max_abs_error=self._unscaled(largest, count),
        )
        self.steps.append(figures)
        return figures

    @property
    def rmse(self) -> float | None:
        """Root of the mean squared difference over all frames, in data units."""
        return self._rmse(self._squares, self.count)

    @property
    def psnr(self) -> float | None:
        """PSNR over all frames, in dB."""
        return self._psnr(self._squares, self.count)

    @property
    def max_abs_error(self) -> float | None:
        """The largest difference over all frames, in data units."""
        return self._unscaled(self._largest, self.count)

    def bulk_quality(self) -> BulkQuality | None:
        """The figures of the bulk over all frames; None without a bulk."""
        if self.bulk is None:
            return None
        squares, count = self._bulk_squares, self._bulk_count
        width = (self.bulk.high - self.bulk.low) * self._scale
        return BulkQuality(
            psnr=psnr(width, math.sqrt(squares / count) if count else None),
            rmse=self._rmse(squares, count),
            range=(self.bulk.low, self.bulk.high),
        )

    def _psnr(self, squares: float, count: int) -> float | None:
        # In scaled units: in data units, a mean of denormals would be rounded to a denormal.
        return psnr(self.data_range * self._scale, math.sqrt(squares / count) if count else None)

    def _rmse(self, squares: float, count: int) -> float | None:
        return self._unscaled(math.sqrt(squares / count) if count else 0.0, count)

    def _unscaled(self, value: float, count: int) -> float | None:
        with np.errstate(over="ignore"):
            figure = float(np.float64(value) / self._scale)
        return figure if count and math.isfinite(figure) else None


def psnr(data_range: float, rmse: float | None) -> float | None:
    """20 log10(data_range / rmse) in dB; None if either is 0, None or not finite."""
    if rmse is None or not (0 < rmse < math.inf and 0 < data_range < math.inf):
        return None
    return 20 * (math.log10(data_range) - math.log10(rmse))


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    """Comparison of one step.

    Attributes:
        coreset, domain: scaled differences over the coreset, and over all vertices.
        similarity: what `ssim` returns; (0.0, 0) for a step whose SSIM is not measured.
    """

    step: int
    coreset: ErrorSums
    domain: ErrorSums
    similarity: tuple[float, int]


class _Comparer:
    """Comparison of decoded steps with the original, a few steps at a time in threads.

    The figures are added up in the order of the steps, whatever the number of threads.
    """

    def __init__(self, data_range: float, background: float, bulk: ValueRange | None) -> None:
        self.coreset, self.domain = Errors(data_range, bulk), Errors(data_range)
        self.similarity, self.similar_vertices = 0.0, 0
        self._background = background

    def compare(
        self, step: int, original: Values, decoded: Values, *, with_ssim: bool, threads: int
    ) -> _Comparison:
        """Compare one step; safe in any thread.

        threads: of the SSIM.
        """
        in_coreset = np.isfinite(decoded)
        mask = None if in_coreset.all() else in_coreset
        coreset = domain = self.coreset.compare(step, original, decoded, mask)
        if mask is not None:
            filled = np.where(mask, decoded, decoded.dtype.type(self._background))
            domain = self.domain.compare(step, original, filled)
        similarity = 0.0, 0
        if with_ssim:
            data_range = self.coreset.data_range
            similarity = ssim(original, decoded, data_range, mask, threads=threads)
        return _Comparison(step=step, coreset=coreset, domain=domain, similarity=similarity)

    def add(self, comparison: _Comparison) -> StepQuality:
        """Add a step to the figures of the series; the steps come in order."""
        figures = self.coreset.take(comparison.step, comparison.coreset)
        self.domain.take(comparison.step, comparison.domain)
        total, vertices = comparison.similarity
        self.similarity += total
        self.similar_vertices += vertices
        return figures

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
            per_step=tuple(coreset.steps),
        )


def measure_quality(
    original_frames: Callable[[int], Values],
    decode: Callable[[int], Values],
    steps: int,
    data_range: float,
    background: float,
    progress: Progress = silent,
    *,
    bulk: ValueRange | None = None,
) -> Quality:
    """Compare all steps of a decoded series with the original.

    original_frames, decode: step -> frame (z, y, x) of the original, and of the decoded series. A
        vertex is in the coreset if its decoded value is finite.
    data_range: of the original series, in data units.
    background: decoded value outside the coreset for the figures over the domain, in data units.
    bulk: of the original series, in data units (`find_bulk`); no figures of it if None.

    At most FRAMES_HELD frames of each series are in memory. The SSIM is measured over the coreset
    of evenly spaced steps (`ssim_steps`). Raises InputError for frames of different shapes.
    Progress stage: "measuring".
    """
    comparer = _Comparer(data_range, background, bulk)
    measured = [-1]
    threads, waiting = usable_threads(), deque[Future[_Comparison]]()

    def collect() -> None:
        """Wait for the first step under way, and add it."""
        figures = comparer.add(waiting.popleft().result())
        # The figure of all steps so far: those of single steps would go up and down.
        psnr = comparer.coreset.psnr
        note = "" if psnr is None else f"{psnr:.1f} dB so far"
        progress("measuring", figures.step + 1, steps, note)

    with ThreadPoolExecutor(threads, thread_name_prefix="fhash-measure") as workers:
        for step in range(steps):
            original, decoded = original_frames(step), decode(step)
            if step == 0:
                measured = ssim_steps(steps, original.size)
            at_once = max(1, min(FRAMES_HELD, steps, VERTICES_HELD // max(original.size, 1)))
            while len(waiting) >= at_once:
                collect()
            waiting.append(
                workers.submit(
                    comparer.compare,
                    step,
                    original,
                    decoded,
                    with_ssim=step in measured,
                    threads=-(-threads // at_once),
                )
            )
        while waiting:
            collect()
    return comparer.quality(measured)
