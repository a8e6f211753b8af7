"""PSNR over the seconds of a training, and the seconds that it took to a quality."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["GOALS", "CurvePoint", "seconds_to"]

GOALS = (40.0, 50.0)
"""Qualities in dB whose seconds are told."""


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """The quality of a model in training.

    Attributes:
        seconds, cpu_seconds: of training until then, without the measurement of the quality.
        epochs: passes over the coreset until then.
        psnr: dB on bricks of the coreset; None for an exact model.
    """

    seconds: float
    cpu_seconds: float
    epochs: float
    psnr: float | None


def seconds_to(curve: Sequence[CurvePoint], psnr: float) -> CurvePoint | None:
    """Return the first point of a curve that reaches a quality in dB; None if none does."""
    return next((point for point in curve if point.psnr is None or point.psnr >= psnr), None)
