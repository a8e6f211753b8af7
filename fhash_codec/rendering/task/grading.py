"""Opacity by gradient: the points of a scene as a `Grading` in marched units."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.colour.opacity import about
from fhash_codec.rendering.scene.scene import TransferFunctionSpec
from fhash_codec.rendering.task.task import GRADES, Grading
from fhash_codec.rendering.task.units import Units
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError

__all__ = ["grading_of"]


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
        top=top * float(ends[1] - ends[0]) / grid.vertex_spacing,
    )
