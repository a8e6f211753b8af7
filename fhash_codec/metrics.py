"""How well decoded frames match the original: PSNR, RMSE, largest error and SSIM, frame by frame in float64. numpy only.

Vertices whose original value is not finite count nowhere. PSNR = 20 log10(range / RMSE) with the global range of the original series.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.normalise import pieces, power_of_two
from fhash_codec.progress import Progress, silent
from fhash_codec.ssim import SIGMA, WINDOW, ssim, ssim_steps
from fhash_formats.errors import InputError

__all__ = ["Errors", "Quality", "StepQuality", "measure_quality", "psnr", "ssim", "ssim_steps"]

Values = npt.NDArray[Any]


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
        self._scale = np.float64(power_of_two(min(data_range, sys.float_info.max)))
        self._squares = 0.0
        self._largest = 0.0

    def add(self, step: int, original: Values, decoded: Values, mask: npt.NDArray[np.bool_] | None = None) -> StepQuality:
        """Compare a frame where `mask` is set, everywhere if None; all of one shape. The step's figures.

        Raises InputError for other shapes and where a decoded value that counts is not finite.
        """
        return self.take(step, self.compare(step, original, decoded, mask))

    def compare(self, step: int, original: Values, decoded: Values, mask: npt.NDArray[np.bool_] | None = None) -> tuple[int, float, float]:
        """Count, sum of squares and largest of the scaled differences of a frame, which `take` takes in; raises as `add`."""
        if original.shape != decoded.shape or (mask is not None and mask.shape != original.shape):
            raise InputError(f"step {step}: the original is {original.shape}, the decoded {decoded.shape}; they must be of one shape")
        count, squares, largest = 0, 0.0, 0.0
        masks = pieces(np.broadcast_to(np.True_, original.shape) if mask is None else mask)
        for one, other, counts in zip(pieces(original), pieces(decoded), masks, strict=True):
            chosen = np.isfinite(one) & counts
            if not chosen.all():
                one, other = one[chosen], other[chosen]
            difference = _scaled_difference(one, other, self._scale)
            if not np.isfinite(difference).all():
                raise InputError(f"step {step}: decoded values are not finite where they are compared")
            count += difference.size
            if difference.size:
                largest = max(largest, float(difference.max()), -float(difference.min()))
            with np.errstate(over="ignore"):
                squares += float(np.square(difference).sum())
        return count, squares, largest

    def take(self, step: int, compared: tuple[int, float, float]) -> StepQuality:
        """Count what `compare` found; the step's figures."""
        count, squares, largest = compared
        self.count += count
        self._squares += squares
        self._largest = max(self._largest, largest)
        rmse = self._rmse(squares, count)
        figures = StepQuality(step=step, psnr=psnr(self.data_range, rmse), rmse=rmse, max_abs_error=self._unscaled(largest, count))
        self.steps.append(figures)
        return figures

    @property
    def rmse(self) -> float | None:
        """Root of the mean squared difference over all frames, in data units."""
        return self._rmse(self._squares, self.count)

    @property
    def psnr(self) -> float | None:
        """In dB, over all frames."""
        return psnr(self.data_range, self.rmse)

    @property
    def max_abs_error(self) -> float | None:
        """The largest difference over all frames, in data units."""
        return self._unscaled(self._largest, self.count)

    def _rmse(self, squares: float, count: int) -> float | None:
        return self._unscaled(math.sqrt(squares / count) if count else 0.0, count)

    def _unscaled(self, value: float, count: int) -> float | None:
        with np.errstate(over="ignore"):
            figure = float(value / self._scale)
        return figure if count and math.isfinite(figure) else None


def _scaled_difference(original: Values, decoded: Values, scale: np.float64) -> npt.NDArray[np.float64]:
    """(original - decoded) * scale in float64; exact for 64-bit integers too, whose differences float64 would round to 0."""
    with np.errstate(over="ignore", invalid="ignore"):
        difference = np.asarray(original * scale - decoded * scale, dtype=np.float64)
    if original.dtype.kind in "iu" and original.dtype.itemsize == 8:
        limits = np.iinfo(original.dtype)
        whole = np.clip(np.rint(decoded.astype(np.float64)), float(limits.min), np.nextafter(float(limits.max), 0.0))
        # Differences wrap at 2^64; those beyond 2^62 do not need the exactness.
        exact = (original - whole.astype(original.dtype)).view(np.int64) - (decoded.astype(np.float64) - whole)
        difference = np.where(np.abs(difference) < 2.0**62 * scale, exact * scale, difference)
    return difference


def psnr(data_range: float, rmse: float | None) -> float | None:
    """20 log10(data_range / rmse) in dB; None where either is 0, unknown or not finite."""
    if rmse is None or not (0 < rmse < math.inf and 0 < data_range < math.inf):
        return None
    return 20 * (math.log10(data_range) - math.log10(rmse))


def measure_quality(
    original_frames: Callable[[int], Values],
    decode: Callable[[int], Values],
    steps: int,
    data_range: float,
    background: float,
    progress: Progress = silent,
) -> Quality:
    """Compare all steps of a decoded series with the original, one frame (z, y, x) of each at a time.

    The coreset is where `decode(step)` is finite; elsewhere it stands for `background` (data units). SSIM is measured over the coreset of
    evenly spaced steps (`ssim_steps`). Raises InputError for frames of different shapes.
    """
    coreset, domain = Errors(data_range), Errors(data_range)
    similarity, vertices, measured = 0.0, 0, [-1]
    for step in range(steps):
        original, decoded = original_frames(step), decode(step)
        if step == 0:
            measured = ssim_steps(steps, original.size)
        known = np.isfinite(decoded)
        compared = coreset.compare(step, original, decoded, known)
        figures = coreset.take(step, compared)
        # Where everything is decoded, both are the same.
        domain.take(step, compared if known.all() else domain.compare(step, original, np.where(known, decoded, background)))
        if step in measured:
            total, count = ssim(original, decoded, data_range, known)
            similarity, vertices = similarity + total, vertices + count
        progress("measuring", step + 1, steps, "" if figures.psnr is None else f"{figures.psnr:.1f} dB")
    return Quality(
        psnr=coreset.psnr,
        rmse=coreset.rmse,
        max_abs_error=coreset.max_abs_error,
        ssim=similarity / vertices if vertices else None,
        ssim_window={"sigma": SIGMA, "window": WINDOW, "data_range": data_range if math.isfinite(data_range) else None, "steps": measured},
        psnr_domain=domain.psnr,
        rmse_domain=domain.rmse,
        max_abs_error_domain=domain.max_abs_error,
        per_step=tuple(coreset.steps),
    )
