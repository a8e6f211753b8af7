"""Opacity by gradient: the points of a scene as a `Grading` in marched units."""

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

__all__ = ["factors_at_vertices", "grading_of"]

Floats = npt.NDArray[np.float64]
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
