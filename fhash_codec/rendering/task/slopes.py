"""Gradients: their scales for shading, and a scene's opacity by gradient as a `Grading`."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.colour.opacity import about
from fhash_codec.rendering.scene.scene import TransferFunctionSpec
from fhash_codec.rendering.task.task import GRADES, Grading
from fhash_codec.rendering.task.units import Units
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError
from fhash_formats.support.threads import in_threads

__all__ = ["factors_at_vertices", "flatness", "grading_of", "slope_scale", "smoothing"]

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


Single = npt.NDArray[np.float32]

LEAST_TOP = 1e-300
"""Least gradient of the last factor in marched units, so that there are numbers to divide by it."""


def grading_of(
    spec: TransferFunctionSpec, volume: Volume, units: Units, grid: Grid
) -> Grading | None:
    """The opacity by gradient that a scene asks for; None without it.

    A gradient of a scene is a share of the series' value range in the distance of two vertices, the
    geometric mean of the spacings. Raises InputError for points that do not ascend and for factors
    beyond 0 to 1.
    """
    points = np.array(spec.gradient_opacity, dtype=np.float64).reshape(-1, 2)
    if not len(points) or spec.nothing:
        return None
    if np.any(np.diff(points[:, 0]) <= 0):
        raise InputError(
            "the gradients of 'gradient_opacity' do not ascend; each must be above the one before"
        )
    if not 0 < points[:, 1].max() <= 1:
        raise InputError(
            f"the factors of 'gradient_opacity' reach to {points[:, 1].max():g}; allowed: 0 to 1, "
            "one of them above 0"
        )
    top = float(points[-1, 0]) or 1.0
    low, high = volume.value_range.low, volume.value_range.high
    ends = units.to([low, high] if low < high else about(low))
    return Grading(
        factors=np.interp(np.linspace(0.0, top, GRADES + 1), points[:, 0], points[:, 1]),
        top=max(top * float(ends[1] - ends[0]) / grid.vertex_spacing, LEAST_TOP),
    )


def factors_at_vertices(values: Single, grading: Grading, spacing: Floats) -> Single:
    """Factors (z, y, x) of the extinction at the vertices of a frame, 0 where a value is missing.

    Gradients are central differences. Where a neighbour is missing they are the difference to the
    other one.

    Args:
        values: float32 (z, y, x), contiguous, in marched units.
        grading: factors by the size of the gradient.
        spacing: (3,), x, y, z, distance of two vertices of the frame, in the coordinates.
    """
    # A finite scale: a gradient of 0 stays one.
    with np.errstate(over="ignore"):
        scale = np.minimum(GRADES / grading.top / np.abs(spacing), np.finfo(np.float64).max)
    library = native.library()
    table = np.append(grading.factors, grading.factors[-1]).astype(np.float32)
    out = np.empty(values.shape, dtype=np.float32)
    shape = (ctypes.c_int64 * 3)(*values.shape)

    def layer(z: int) -> None:
        library.fhash_march_factors(
            values.ctypes.data,
            shape,
            scale.ctypes.data,
            table.ctypes.data,
            GRADES + 1,
            z,
            z + 1,
            out.ctypes.data,
        )

    list(in_threads(layer, range(len(values))))
    return out
