"""How well decoded frames match the original: PSNR, RMSE, largest error and SSIM, frame by frame in float64. numpy only.

Vertices whose original value is not finite count nowhere. PSNR = 20 log10(range / RMSE) with the global range of the original series.
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
from fhash_codec.measure.sums import Values, squared_errors
from fhash_codec.measure.value_range import power_of_two
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import InputError
from fhash_formats.support.threads import usable_threads

__all__ = ["Errors", "Quality", "StepQuality", "measure_quality", "psnr", "ssim", "ssim_steps"]

FRAMES_HELD, VERTICES_HELD = 8, 1 << 24
"""Frames of each series that may be held while they are compared: at most so many, of at most so many vertices together, at least one."""


@dataclass(frozen=True, kw_only=True)
class StepQuality:
    """Figures of one step: dB, data units, data units; None where nothing counts, and PSNR also where the error or the range is 0."""

    step: int
    psnr: float | None
    rmse: float | None
    max_abs_error: float | None


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Figures of a whole series; None where nothing counts or a figure has no finite value.

    Attributes:
        psnr, rmse, max_abs_error: over the coreset of all steps, in dB and data units.
        ssim: mean over the coreset of the measured steps. ssim_window: its sigma and window in vertices, the data range and those steps.
        psnr_domain, rmse_domain, max_abs_error_domain: over all vertices, the background standing outside the coreset.
        per_step: over the coreset of each step.
    """

    psnr: float | None
    rmse: float | None
    max_abs_error: float | None
    ssim: float | None
    ssim_window: dict[str, Any]
    psnr_domain: float | None
    rmse_domain: float | None
    max_abs_error_domain: float | None
    per_step: tuple[StepQuality, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        return {**asdict(self), "per_step": [asdict(step) for step in self.per_step]}


class Errors:
    """Squared and largest differences over frames.

    Differences are taken after scaling by an exact power of two near the range, so that neither huge nor tiny ranges over- or underflow.

    Attributes:
        count: vertices compared so far. steps: a StepQuality per frame.
    """

    def __init__(self, data_range: float) -> None:
        """data_range: of the original series, in data units; one that overflows (inf) is allowed and leaves PSNR None."""
        if not data_range >= 0:
            raise InputError(f"data range is {data_range}; 0 or more is needed")
        self.data_range = data_range
        self.count = 0
        self.steps: list[StepQuality] = []
        self._scale = power_of_two(min(data_range, sys.float_info.max))
        self._squares = 0.0
        self._largest = 0.0

    def add(
        self,
        step: int,
        original: Values,
        decoded: Values,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> StepQuality:
        """Compare a frame where `mask` is set, everywhere if None; all of one shape. The step's figures.

        Raises InputError for other shapes and where a decoded value that counts is not finite.
        """
        return self.take(step, self.compare(step, original, decoded, mask))

    def compare(
        self,
        step: int,
        original: Values,
        decoded: Values,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> tuple[int, float, float]:
        """Count, sum of squares and largest of the scaled differences of a frame, which `take` takes in; raises as `add`."""
        if original.shape != decoded.shape or (mask is not None and mask.shape != original.shape):
            raise InputError(
                f"step {step}: the original is {original.shape}, the decoded {decoded.shape}; they must be of one shape"
            )
        found = squared_errors(original, decoded, mask, self._scale)
        if found[0] < 0:
            raise InputError(f"step {step}: decoded values are not finite where they are compared")
        return found

    def take(self, step: int, compared: tuple[int, float, float]) -> StepQuality:
        """Count what `compare` found; the step's figures."""
        count, squares, largest = compared
        self.count += count
        self._squares += squares
        self._largest = max(self._largest, largest)
        rmse = self._rmse(squares, count)
        figures = StepQuality(
            step=step,
            psnr=self._psnr(squares, count),
            rmse=rmse,
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
        """In dB, over all frames."""
        return self._psnr(self._squares, self.count)

    @property
    def max_abs_error(self) -> float | None:
        """The largest difference over all frames, in data units."""
        return self._unscaled(self._largest, self.count)

    def _psnr(self, squares: float, count: int) -> float | None:
        # In scaled units: a mean of denormals is rounded to one.
        return psnr(self.data_range * self._scale, math.sqrt(squares / count) if count else None)

    def _rmse(self, squares: float, count: int) -> float | None:
        return self._unscaled(math.sqrt(squares / count) if count else 0.0, count)

    def _unscaled(self, value: float, count: int) -> float | None:
        with np.errstate(over="ignore"):
            figure = float(np.float64(value) / self._scale)
        return figure if count and math.isfinite(figure) else None


def psnr(data_range: float, rmse: float | None) -> float | None:
    """20 log10(data_range / rmse) in dB; None where either is 0, unknown or not finite."""
    if rmse is None or not (0 < rmse < math.inf and 0 < data_range < math.inf):
        return None
    return 20 * (math.log10(data_range) - math.log10(rmse))


@dataclass(frozen=True, kw_only=True)
class _Compared:
    """A step's errors over the coreset and over everything, as `Errors.compare` gives them, and what `ssim` gives."""

    step: int
    inside: tuple[int, float, float]
    everywhere: tuple[int, float, float]
    similarity: tuple[float, int]


def measure_quality(
    original_frames: Callable[[int], Values],
    decode: Callable[[int], Values],
    steps: int,
    data_range: float,
    background: float,
    progress: Progress = silent,
) -> Quality:
    """Compare all steps of a decoded series with the original, some frames (z, y, x) of each at a time (FRAMES_HELD).

    The coreset is where `decode(step)` is finite; elsewhere it stands for `background` (data units). SSIM is measured over the coreset of
    evenly spaced steps (`ssim_steps`). Raises InputError for frames of different shapes.
    """
    coreset, domain = Errors(data_range), Errors(data_range)
    similarity, vertices, measured = 0.0, 0, [-1]
    threads, waiting = usable_threads(), deque[Future[_Compared]]()

    def work(step: int, original: Values, decoded: Values, similar: bool, share: int) -> _Compared:
        known = np.isfinite(decoded)
        whole = bool(known.all())
        inside = coreset.compare(step, original, decoded, None if whole else known)
        # Where everything is decoded, both are the same.
        outside = (
            inside
            if whole
            else domain.compare(
                step, original, np.where(known, decoded, decoded.dtype.type(background))
            )
        )
        found = (
            ssim(original, decoded, data_range, None if whole else known, threads=share)
            if similar
            else (0.0, 0)
        )
        return _Compared(step=step, inside=inside, everywhere=outside, similarity=found)

    def collect() -> None:
        nonlocal similarity, vertices
        compared = waiting.popleft().result()
        figures = coreset.take(compared.step, compared.inside)
        domain.take(compared.step, compared.everywhere)
        similarity, vertices = (
            similarity + compared.similarity[0],
            vertices + compared.similarity[1],
        )
        progress(
            "measuring",
            compared.step + 1,
            steps,
            "" if figures.psnr is None else f"{figures.psnr:.1f} dB",
        )

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
                    work, step, original, decoded, step in measured, -(-threads // at_once)
                )
            )
        while waiting:
            collect()
    return Quality(
        psnr=coreset.psnr,
        rmse=coreset.rmse,
        max_abs_error=coreset.max_abs_error,
        ssim=similarity / vertices if vertices else None,
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
