"""The exact L2 norms of the synthesis vectors.

Coefficients are multiplied by these norms, so that one quantiser step serves all of them. All norms
are float64, with sums in a fixed order. A synthesis vector of the tile is a product of one vector
per axis (in a coupled plane, per band), and its norm is the product of their norms. An axis of up
to MAX_EXACT vertices has its own norm at each position, which includes the effect of the mirrored
ends. On a longer axis each band has the norm of its interior.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fhash_formats import native
from fhash_formats.transform.axes.spec import KINDS, AxisTransform

__all__ = ["MAX_EXACT", "axis_norms", "band_lengths", "plane_norms"]

MAX_EXACT = 512
"""Longest axis, in vertices, whose norms are computed at each position."""

Norms = NDArray[np.float64]


def band_lengths(n: int, depth: int) -> list[int]:
    """Lengths of the low band of `n` vertices after 0 to `depth` levels."""
    lengths = [n]
    for _ in range(depth):
        lengths.append((lengths[-1] + 1) // 2)
    return lengths


def axis_norms(axis: AxisTransform, n: int) -> Norms:
    """Norms along an axis that is transformed on its own, float64 (n,); 1 beyond a basis's rank."""
    if axis.wavelet:
        return _wavelet_norms(axis.kind, axis.depth, n)
    norms = np.ones(n)
    if axis.basis is not None:
        norms[: axis.basis.rank] = _column_norms(axis.basis.synthesis.astype(np.float64))
    return norms


def plane_norms(y: AxisTransform, x: AxisTransform, rows: int, columns: int) -> Norms:
    """Norms in the plane of y and x, float64 (rows, columns)."""
    if not y.wavelet or (y.kind, y.depth) != (x.kind, x.depth):
        return axis_norms(y, rows)[:, None] * axis_norms(x, columns)
    ys, xs = band_lengths(rows, y.depth), band_lengths(columns, x.depth)
    norms = np.empty((rows, columns))
    for level in range(1, y.depth + 1):  # each overwrites the low-low quarter of the one before
        along_y, along_x = (_wavelet_norms(y.kind, level, n) for n in (rows, columns))
        height, width = ys[level - 1], xs[level - 1]
        norms[:height, :width] = along_y[:height, None] * along_x[:width]
    return norms


@lru_cache(maxsize=256)
def _wavelet_norms(kind: str, depth: int, n: int) -> Norms:
    """Norms of the synthesis vectors of a wavelet on an axis; read-only."""
    if n <= MAX_EXACT:
        norms = _column_norms(_inverse(np.eye(n), kind, depth))
    else:
        norms, ends = np.empty(n), band_lengths(n, depth)
        for level in range(1, depth + 1):
            # With 32 entries in the band, the vector of a middle entry does not reach the ends.
            inner = band_lengths(32 << level, level)
            vectors = np.zeros((inner[0], 2))
            vectors[16, 0] = vectors[inner[level] + 16, 1] = 1.0
            low, high = _column_norms(_inverse(vectors, kind, level))
            norms[: ends[level]], norms[ends[level] : ends[level - 1]] = low, high
    norms.setflags(write=False)
    return norms


def _inverse(bands: NDArray[np.float64], kind: str, depth: int) -> NDArray[np.float64]:
    """The columns that the inverse of a wavelet makes of columns of bands."""
    n, columns = bands.shape
    values, ones = np.empty_like(bands), np.ones(max(n, columns))
    four, pointer = ctypes.c_int64 * 4, ctypes.c_void_p
    code = native.library().fhash_transform_inverse_f64(
        pointer(bands.ctypes.data),
        pointer(values.ctypes.data),
        four(n, 1, 1, columns),
        four(KINDS.index(kind), 0, 0, 0),
        four(depth, 0, 0, 0),
        four(0, 0, 0, 0),
        (pointer * 4)(None, None, None, None),
        pointer(ones.ctypes.data),
        pointer(ones.ctypes.data),
    )
    if code != 0:
        raise MemoryError("no memory for the norms of a transform")
    return values


def _column_norms(matrix: NDArray[np.float64]) -> Norms:
    """Norms of the columns, with sums from the first row on."""
    total = np.zeros(matrix.shape[1])
    for row in matrix:
        total += row * row
    return np.sqrt(total)
