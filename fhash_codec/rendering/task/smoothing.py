"""Smoother values, by whose gradients bounded files are shaded.

The errors of a bounded file have no direction, and neighbouring vertices may be wrong in opposite
directions. In the gradient of values that a Gaussian has smoothed, errors largely cancel, and what
the values do over several vertices is left.

Where the values themselves change from vertex to vertex, a Gaussian would blur what is there. The
errors have a bound, so a smoothed value that is further from the decoded one than this bound is
wrong for sure: it is clipped to the bound.
"""

from __future__ import annotations

import ctypes
import math

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_formats.support.threads import in_threads

__all__ = ["smoothed"]

Single = npt.NDArray[np.float32]

REACH = 3.0
"""Standard deviations after which the Gaussian ends."""


def smoothed(values: Single, deviation: float, error: float = math.inf) -> Single:
    """Values smoothed by a Gaussian along each axis, and no further from their own than an error.

    The pair of values on both sides of a vertex counts only where both are there; else twice the
    value of the vertex takes its place. So values that are linear stay as they are, up to the
    faces. A missing value stays missing.

    Args:
        values: float32 (z, y, x), contiguous, NaN where there is none.
        deviation: standard deviation of the Gaussian, in vertices, above 0.
        error: largest difference of a smoothed value from its own, in the units of the values.
    """
    out = _blurred(values, deviation)
    if error < math.inf:
        list(in_threads(lambda z: _clip(out[z], values[z], np.float32(error)), range(len(out))))
    return out


def _clip(blurred: Single, values: Single, error: np.float32) -> None:
    """Clip a layer of smoothed values, in place."""
    blurred -= values
    np.clip(blurred, -error, error, out=blurred)
    blurred += values


def _blurred(values: Single, deviation: float) -> Single:
    """The values after a Gaussian along each axis; a new array."""
    weights = _weights(deviation)
    library = native.library()
    shape = (ctypes.c_int64 * 3)(*values.shape)
    layers, rows, _ = values.shape
    flat, out = np.empty_like(values), np.empty_like(values)
    given = shape, weights.ctypes.data, len(weights) - 1

    def layer(z: int) -> None:
        scratch = np.empty(values.shape[1:], dtype=np.float32)
        library.fhash_march_smooth_layers(
            values.ctypes.data, *given, z, z + 1, flat.ctypes.data, scratch.ctypes.data
        )

    def row(y: int) -> None:
        library.fhash_march_smooth_rows(flat.ctypes.data, *given, y, y + 1, out.ctypes.data)

    list(in_threads(layer, range(layers)))
    list(in_threads(row, range(rows)))
    return out


def _weights(deviation: float) -> Single:
    """Weights of a value itself and of those 1, 2 and so on vertices away on both sides."""
    away = np.arange(math.ceil(REACH * deviation) + 1)
    weights = np.exp(-0.5 * (away / deviation) ** 2)
    return np.asarray(weights / (2 * weights.sum() - weights[0]), dtype=np.float32)
