"""Scales of the gradients that surfaces and volumes are shaded by."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Grid

__all__ = ["flatness", "slope_scale"]

Floats = npt.NDArray[np.float64]

FLATTEST = 1e-6
"""Gradient, as a share of the value range per vertex, at which shading has faded by half. The
rounding of the values and the errors of the file raise it.
"""
STEEPEST = 1e18
"""Largest gradient. The squares of larger ones overflow float32."""


def flatness(
    low: float, high: float, least: float, most: float, noise: float = 0.0
) -> tuple[float, float]:
    """The range that gradients are shares of, and the gradient at which shading has faded by half.

    low, high: ends of the table, whose range it is.
    least, most: extreme values of the frame. Their rounding to float32 makes gradients of noise,
    which must not be lit.
    noise: difference of two neighbouring vertices up to which it is taken for an error of coding.
    """
    span = max(high - low, (most - least) * 1e-15) or 1.0
    rounding = 4 * 2.0**-23 * max(abs(least), abs(most))
    return span, max(FLATTEST, min(max(rounding, noise) / span, 1.0))


def slope_scale(grid: Grid, span: float, least: float, most: float) -> Floats:
    """Factors (3,), x, y, z, from differences between vertices to gradients.

    A gradient is a share of `span` in the distance of two vertices. The factors are clipped so that
    the largest possible difference, from `least` to `most`, gives at most STEEPEST. That changes
    factors only where the vertex spacings of the axes differ so much that the direction of the
    gradient stays the same.
    """
    with np.errstate(over="ignore", divide="ignore"):
        limit = STEEPEST / np.float64(most - least)
        factors: Floats = np.clip(grid.vertex_spacing / (span * grid.spacing), -limit, limit)
    return factors
