"""The transform of one tile in numpy: the twin of native/lifting.cpp, with the same bits.

The twin does the same operations in the same order: elementwise + - * on whole arrays as written
here, and sums over an axis in ascending order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["KIND_NUMBERS", "forward_axis", "forward_tile", "inverse_axis", "inverse_tile"]

Values = NDArray[Any]

KIND_NUMBERS = {"none": 0, "haar": 1, "5/3": 2, "9/7": 3, "klt": 4}
"""Numbers of the kinds in calls of the native library."""

_BLOCK = 1 << 15
"""Values of a matrix product that are computed at once, to stay in the cache."""

_STEPS: dict[str, tuple[tuple[bool, float], ...]] = {
    "5/3": ((True, -0.5), (False, 0.25)),
    "9/7": (
        (True, -1.586134342059924),
        (False, -0.052980118572961),
        (True, 0.882911075530934),
        (False, 0.443506852043971),
    ),
}
"""Lifting steps of each wavelet: (whether the odd half changes, factor).

9/7: Daubechies and Sweldens 1998, without the final scaling by K.
"""


def forward_tile(
    values: Values,
    kinds: Sequence[str],
    depths: Sequence[int],
    matrices: Sequence[Values | None],
    scale_tz: Values,
    scale_yx: Values,
) -> Values:
    """Coefficients of a tile: transformed along t, then z, then y and x, then scaled.

    Args:
        values: the tile (t, z, y, x).
        kinds: kind of each axis.
        depths: number of levels of each axis.
        matrices: analysis matrix of each axis with a basis, None for the others.
        scale_tz: factors (t, z), applied first.
        scale_yx: factors (y, x).
    """
    result = values.copy()
    for axis in (0, 1):
        result = _forward_packet(result, axis, kinds[axis], depths[axis], matrices[axis])
    if _coupled(kinds, depths):
        rows, columns = result.shape[2:]
        for _ in range(depths[2]):
            corner = result[:, :, :rows, :columns]
            corner[...] = forward_axis(forward_axis(corner, 2, kinds[2]), 3, kinds[3])
            rows, columns = (rows + 1) // 2, (columns + 1) // 2
    else:
        for axis in (2, 3):
            result = _forward_packet(result, axis, kinds[axis], depths[axis], matrices[axis])
    return np.ascontiguousarray((result * scale_tz[:, :, None, None]) * scale_yx)


def inverse_tile(
    coefficients: Values,
    kinds: Sequence[str],
    depths: Sequence[int],
    matrices: Sequence[Values | None],
    scale_tz: Values,
    scale_yx: Values,
) -> Values:
    """Values of a tile: the steps of `forward_tile` undone in the opposite order.

    The arguments are those of `forward_tile`, except that the matrices are the synthesis matrices
    and the scales the reciprocals.
    """
    result = (coefficients * scale_tz[:, :, None, None]) * scale_yx
    if _coupled(kinds, depths):
        sizes = [result.shape[2:]]
        for _ in range(depths[2]):
            sizes.append(((sizes[-1][0] + 1) // 2, (sizes[-1][1] + 1) // 2))
        for rows, columns in sizes[depths[2] - 1 :: -1]:
            corner = result[:, :, :rows, :columns]
            corner[...] = inverse_axis(inverse_axis(corner, 3, kinds[3]), 2, kinds[2])
    else:
        for axis in (3, 2):
            result = _inverse_packet(result, axis, kinds[axis], depths[axis], matrices[axis])
    for axis in (1, 0):
        result = _inverse_packet(result, axis, kinds[axis], depths[axis], matrices[axis])
    return np.ascontiguousarray(result)


def forward_axis(values: Values, axis: int, kind: str) -> Values:
    """One level of a wavelet along an axis of any array: the low band, then the high band.

    Norms are not applied. An axis of length 1 stays as it is.
    """
    moved = np.moveaxis(values, axis, 0)
    even, odd = moved[0::2].copy(), moved[1::2].copy()
    if len(odd) == 0:
        return values
    if kind == "haar":
        odd -= even[: len(odd)]
        even[: len(odd)] += even.dtype.type(0.5) * odd
    else:
        for changes_odd, factor in _STEPS[kind]:
            _lift(even, odd, changes_odd, factor)
    return np.moveaxis(np.concatenate([even, odd]), 0, axis)


def inverse_axis(bands: Values, axis: int, kind: str) -> Values:
    """The inverse of `forward_axis`."""
    moved = np.moveaxis(bands, axis, 0)
    low = (len(moved) + 1) // 2
    even, odd = moved[:low].copy(), moved[low:].copy()
    if len(odd) == 0:
        return bands
    if kind == "haar":
        even[: len(odd)] -= even.dtype.type(0.5) * odd
        odd += even[: len(odd)]
    else:
        for changes_odd, factor in reversed(_STEPS[kind]):
            _lift(even, odd, changes_odd, -factor)
    result = np.empty_like(moved, order="C")
    result[0::2], result[1::2] = even, odd
    return np.moveaxis(result, 0, axis)


def _lift(even: Values, odd: Values, changes_odd: bool, factor: float) -> None:
    """One lifting step in place; the row is mirrored about its first and its last number."""
    if changes_odd:
        odd += odd.dtype.type(factor) * (
            even[: len(odd)] + np.concatenate([even[1:], even[-1:]])[: len(odd)]
        )
    else:
        even += even.dtype.type(factor) * (
            np.concatenate([odd[:1], odd])[: len(even)]
            + np.concatenate([odd, odd[-1:]])[: len(even)]
        )


def _coupled(kinds: Sequence[str], depths: Sequence[int]) -> bool:
    """Whether y and x form a pyramid, as in `TransformSpec.coupled`."""
    return kinds[2] == kinds[3] and kinds[2] in ("haar", "5/3", "9/7") and depths[2] == depths[3]


def _forward_packet(
    values: Values, axis: int, kind: str, depth: int, matrix: Values | None
) -> Values:
    """The transform of one axis on its own, in place unless it has a matrix."""
    if matrix is not None:
        return _product(matrix, values, axis)
    moved = np.moveaxis(values, axis, 0)
    n = len(moved)
    for _ in range(depth):
        moved[:n] = forward_axis(moved[:n], 0, kind)
        n = (n + 1) // 2
    return values


def _inverse_packet(
    values: Values, axis: int, kind: str, depth: int, matrix: Values | None
) -> Values:
    """The inverse of `_forward_packet`, in place unless the axis has a matrix."""
    if matrix is not None:
        return _product(matrix, values, axis)
    moved = np.moveaxis(values, axis, 0)
    lengths = [len(moved)]
    for _ in range(depth):
        lengths.append((lengths[-1] + 1) // 2)
    for n in lengths[:depth][::-1]:
        moved[:n] = inverse_axis(moved[:n], 0, kind)
    return values


def _product(matrix: Values, values: Values, axis: int) -> Values:
    """matrix (m, k) times the first k entries along an axis of length n.

    Entries m to n of the result are 0.
    """
    moved = np.moveaxis(values, axis, 0)
    rows, terms = matrix.shape
    columns = moved.reshape(len(moved), -1)[:terms]
    result = np.zeros((len(moved), columns.shape[1]), values.dtype)
    width = max(64, _BLOCK // len(moved))
    for start in range(0, columns.shape[1] if terms else 0, width):
        block = columns[:, start : start + width]
        total = matrix[:, :1] * block[0]
        term = np.empty_like(total)
        for k in range(1, terms):
            np.multiply(matrix[:, k : k + 1], block[k], out=term)
            total += term
        result[:rows, start : start + width] = total
    return np.moveaxis(result.reshape(moved.shape), 0, axis)
