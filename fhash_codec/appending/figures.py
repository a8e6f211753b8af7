"""Quality of a growing file: sums of the errors of each step, and the figures that follow.

The figures are those that `measure` would find (fhash_codec/comparison.py), without SSIM and
without those of the bulk, which need all steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fhash_codec.header import brief_quality
from fhash_codec.measure.errors import psnr
from fhash_codec.measure.sums import Values, error_sums
from fhash_codec.measure.value_range import ValueRange, power_of_two
from fhash_formats.container import ContainerWriter
from fhash_formats.errors import InputError

__all__ = ["Figures", "StepErrors"]


ROUNDED_ONCE = 1 - 1e-12
"""Factor of a figure that was rounded up to some decimals, so that it is not once more.

Its float may lie above the decimal number.
"""


class StepErrors(NamedTuple):
    """Errors of one step, scaled by the power of two of its `Figures`."""

    number: int
    """Number of values."""
    squares: float
    """Sum of the squared errors."""
    largest: float
    """Largest absolute error."""


class Figures:
    """Errors of the steps of a file so far.

    Attributes:
        scale: power of two by which errors are multiplied before they are squared.
        steps: errors of each step.
    """

    def __init__(self, scale: float, steps: Sequence[StepErrors] = ()) -> None:
        self.scale = scale
        self.steps = list(steps)

    @staticmethod
    def scale_of(value_range: ValueRange) -> float:
        """The power of two by which errors of values of a range are scaled."""
        width = value_range.high - value_range.low
        return power_of_two(width if width > 0 else max(abs(value_range.high), 1.0))

    @classmethod
    def of_header(cls, header: Mapping[str, Any], scale: float) -> Figures:
        """The errors that a full header (`full_header`) tells, rounded to the worse side.

        Raises InputError for a file that does not tell them of each step.
        """
        steps, *frame = header["domain"]["shape"]
        told = header["quality"].get("per_step", [])
        most = header["quality"].get("max_abs_error")
        # That of all steps is rounded less: it keeps the promise where those of steps may not.
        limit = float(most) if isinstance(most, int | float) else math.inf
        count, errors = math.prod(frame), []
        for step in range(steps):
            figures = told[step] if step < len(told) else {}
            pair: list[Any] = [figures.get(name) for name in ("rmse", "max_abs_error")]
            if not all(isinstance(one, int | float) and one >= 0 for one in pair):
                raise InputError(
                    f"the file does not tell the errors of step {step}, and a longer one could not"
                )
            root = float(pair[0]) * ROUNDED_ONCE * scale
            largest = min(float(pair[1]), limit) * ROUNDED_ONCE * scale
            errors.append(StepErrors(count, count * root * root, largest))
        return cls(scale, errors)

    def measure(self, original: Values, decoded: Values) -> StepErrors:
        """The errors of a decoded frame (z, y, x)."""
        sums = error_sums(original, decoded, None, self.scale)
        if sums.number != original.size:
            raise RuntimeError("a decoded frame has values that are not finite")
        return StepErrors(sums.number, sums.squares, sums.largest)

    def header(self, writer: ContainerWriter, data_range: float) -> dict[str, Any]:
        """The header's `quality`.

        Args:
            writer: of the container; it gets an array for the figures of many steps.
            data_range: width of the header's value range.
        """
        count = sum(step.number for step in self.steps)
        squares = math.fsum(step.squares for step in self.steps)
        root = math.sqrt(squares / count)
        whole = {
            "psnr": psnr(data_range * self.scale, root),
            "rmse": self._figure(root),
            "max_abs_error": self._figure(max(step.largest for step in self.steps)),
        }
        per_step = [
            {
                "rmse": self._figure(math.sqrt(step.squares / step.number)),
                "max_abs_error": self._figure(step.largest),
            }
            for step in self.steps
        ]
        everywhere = {f"{name}_domain": value for name, value in whole.items()}
        quality: dict[str, Any] = {**whole, **everywhere, "ssim_window": {}, "per_step": per_step}
        return brief_quality(writer, quality, data_range, len(self.steps))

    def _figure(self, scaled: float) -> float | None:
        """A scaled error in data units; None where it is not finite."""
        with np.errstate(over="ignore"):
            figure = float(np.float64(scaled) / self.scale)
        return figure if math.isfinite(figure) else None
