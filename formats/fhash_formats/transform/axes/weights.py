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
    norms = np.ones(n)
    if axis.basis is not None:
        total = np.zeros(axis.basis.rank)
        for row in axis.basis.synthesis.astype(np.float64):
            total += row * row
        norms[: axis.basis.rank] = np.sqrt(total)
    elif axis.wavelet:
        lengths, low, high = band_lengths(n, axis.depth), *_level_norms(axis.kind, axis.depth, n)
        norms[: lengths[-1]] = low[-1]
        for level in range(1, axis.depth + 1):
            norms[lengths[level] : lengths[level - 1]] = high[level]
    return norms


def plane_norms(y: AxisTransform, x: AxisTransform, rows: int, columns: int) -> Norms:
    """Norms in the plane of y and x, float64 (rows, columns)."""
    if not y.wavelet or (y.kind, y.depth) != (x.kind, x.depth):
        return axis_norms(y, rows)[:, None] * axis_norms(x, columns)
    ys, xs = band_lengths(rows, y.depth), band_lengths(columns, x.depth)
    (low_y, high_y), (low_x, high_x) = (
        _level_norms(y.kind, y.depth, rows),
        _level_norms(x.kind, x.depth, columns),
    )
    norms = np.ones((rows, columns))
    for level in range(1, y.depth + 1):
        norms[: ys[level], xs[level] : xs[level - 1]] = low_y[level][:, None] * high_x[level]
        norms[ys[level] : ys[level - 1], : xs[level]] = high_y[level][:, None] * low_x[level]
        norms[ys[level] : ys[level - 1], xs[level] : xs[level - 1]] = (
            high_y[level][:, None] * high_x[level]
        )
    norms[: ys[-1], : xs[-1]] = low_y[-1][:, None] * low_x[-1]
    return norms


@lru_cache(maxsize=128)
def _level_norms(kind: str, depth: int, n: int) -> tuple[list[Norms], list[Norms]]:
    """Norms of the low band and of the high band after 0 to `depth` levels.

    The high band of level 0 is empty.
    """
    low, high = [np.ones(n)], [np.ones(0)]
    lengths = band_lengths(n, depth)
    for level in range(1, depth + 1):
        m = lengths[level]
        if n <= MAX_EXACT:
            norms = _synthesis_norms(kind, lengths[: level + 1], np.eye(lengths[level - 1]))
            low.append(norms[:m])
            high.append(norms[m:])
        else:
            # With 32 entries in the band, the vector of a middle entry does not reach the ends.
            interior = band_lengths(32 << level, level)
            impulses = np.zeros((interior[level - 1], 2))
            impulses[16, 0] = impulses[interior[level] + 16, 1] = 1.0
            norms = _synthesis_norms(kind, interior, impulses)
            low.append(np.full(m, norms[0]))
            high.append(np.full(lengths[level - 1] - m, norms[1]))
    return low, high


def _synthesis_norms(kind: str, lengths: list[int], bands: NDArray[np.float64]) -> Norms:
    """Norms of the columns that the inverse makes of `bands`, both bands of the deepest level.

    lengths: of the low band after each level.
    """
    (n, depth), columns = (lengths[0], len(lengths) - 1), bands.shape[1]
    padded = np.zeros((n, columns))
    padded[: len(bands)] = bands
    values, ones = np.empty_like(padded), np.ones(max(n, columns))
    four, pointer = ctypes.c_int64 * 4, ctypes.c_void_p
    code = native.library().fhash_transform_inverse_f64(
        pointer(padded.ctypes.data),
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
    total = np.zeros(columns)
    for row in values:
        total += row * row
    return np.sqrt(total)
