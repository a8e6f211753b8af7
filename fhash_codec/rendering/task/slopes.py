"""Scales of gradients."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Grid

Floats = npt.NDArray[np.float64]

FLATTEST = 1e-6
"""Of the value range per vertex: a gradient that counts as half of one. Rounding of the values raises it."""


STEEPEST = 1e18
"""The largest gradient whose square float32 can compute with."""


def flatness(low: float, high: float, least: float, most: float) -> tuple[float, float]:
    """The range that gradients are shares of, and the one per vertex at which light from a direction is half gone.

    low, high: ends of the table. least, most: values of the frame, whose rounding to float32 must not be lit.
    """
    span = max(high - low, (most - least) * 1e-15) or 1.0
    noise = 4 * 2.0**-23 * max(abs(least), abs(most)) / span
    return span, max(FLATTEST, min(noise, 1.0))


def slope_scale(grid: Grid, span: float, least: float, most: float) -> Floats:
    """Factors (3,), x, y, z, from differences between vertices to gradients: shares of `span` in the distance of vertices.

    No more than what makes STEEPEST of the difference between least and most, the values of the frame: with axes of lengths that differ
    that much the direction is the same, and float32 has no room for the squares of more.
    """
    with np.errstate(over="ignore", divide="ignore"):
        limit = STEEPEST / np.float64(most - least)
        factors: Floats = np.clip(grid.vertex_spacing / (span * grid.spacing), -limit, limit)
    return factors
