"""Scales of the gradients that surfaces and volumes are shaded by."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Grid

__all__ = ["flatness", "slope_scale", "smoothing"]

Floats = npt.NDArray[np.float64]

FLATTEST = 1e-6
"""Gradient, as a share of the value range per vertex, at which shading has faded by half. The
rounding of the values and the errors of the file raise it.
"""
QUIETEST = 1e-3
"""Noise of gradients, as a share of the value range per vertex, that values need not be smoothed
for.
"""
LEFT = 0.24
"""Noise of the gradients of values that a Gaussian has smoothed, with a deviation of 1 vertex, for
a difference of neighbours of 1: three standard deviations of errors that are even between the
bounds (0.29) and the same along one axis, as those of coding often are (0.2 along the two others).
"""
FALL = 2.0
"""Power of the deviation by which that noise falls."""
DEVIATIONS = (0.8, 2.5)
"""Smallest and largest deviation of the Gaussian, in vertices. Grids hardly have a smaller one; a
larger one would shade by what lies too far away.
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
    Where it is large, gradients are those of smoothed values, and little of the noise is left.
    """
    span = max(high - low, (most - least) * 1e-15) or 1.0
    rounding = 4 * 2.0**-23 * max(abs(least), abs(most))
    share, deviation = noise / span, smoothing(span, noise)
    left = LEFT * share * deviation**-FALL if deviation else share
    return span, max(FLATTEST, min(max(rounding / span, left), 1.0))


def smoothing(span: float, noise: float) -> float:
    """The deviation of the Gaussian, in vertices, that values are smoothed by before shading.

    It is 0 where nothing needs to be smoothed, and else just large enough that QUIETEST is left of
    the noise, within DEVIATIONS.

    span: the range that gradients are shares of.
    noise: difference of two neighbouring vertices that errors of coding can make.
    """
    if noise <= QUIETEST * span:
        return 0.0
    deviation = min(LEFT * noise / span, 1.0) / QUIETEST
    return float(np.clip(deviation ** (1 / FALL), *DEVIATIONS))


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
