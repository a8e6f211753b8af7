"""Curves through values that never overshoot."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["pchip"]

Floats = npt.NDArray[np.float64]


def pchip(at: Floats, values: Floats, share: float) -> Floats:
    """Interpolate values by a cubic that stays between the values on either side.

    Source: Fritsch and Butland, A Method for Constructing Local Monotone Piecewise Cubic
    Interpolants, 1984. At the ends the slope is that of the first and the last piece, so that two
    values are joined by a line.

    Args:
        at: shares (n,), strictly ascending.
        values: (n, k).
        share: between the first and the last of `at`.

    Returns:
        Values (k,).
    """
    if len(at) == 1:
        return np.asarray(values[0], dtype=np.float64)
    width = np.diff(at)[:, None]
    slope = np.diff(values, axis=0) / width
    tangents = np.concatenate([slope[:1], slope])
    if len(slope) > 1:
        first, second = 2 * width[1:] + width[:-1], width[1:] + 2 * width[:-1]
        same_sign = slope[:-1] * slope[1:] > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = (first + second) / (first / slope[:-1] + second / slope[1:])
        tangents[1:-1] = np.where(same_sign, mean, 0.0)
    piece = int(np.clip(np.searchsorted(at, share, side="right") - 1, 0, len(slope) - 1))
    h = float(width[piece, 0])
    t = (share - float(at[piece])) / h
    low, high = values[piece], values[piece + 1]
    return np.asarray(
        (1 + 2 * t) * (1 - t) ** 2 * low
        + t * (1 - t) ** 2 * h * tangents[piece]
        + t * t * (3 - 2 * t) * high
        + t * t * (t - 1) * h * tangents[piece + 1],
        dtype=np.float64,
    )
