"""Coefficients of a tile to its values: weights, wavelets by lifting, bases of the data.

Each coefficient is first multiplied by the reciprocal of the norm of its synthesis vector. The
norm is a product of a factor for (t, z) and one for (y, x), computed in float64 and rounded once.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from reference.bands import WAVELETS, lengths
from reference.integers import decode_block

Values = npt.NDArray[Any]


class Axis(NamedTuple):
    """The transform along one axis: "none"; a wavelet of a depth; or "klt" with a basis (n, r)."""

    kind: str
    depth: int = 0
    basis: Values | None = None


def inverse(coefficients: Values, axes: Sequence[Axis]) -> Values:
    """The values of a tile (t, z, y, x), before the centre is added; in the working type."""
    dtype, (t, z, y, x) = coefficients.dtype, axes
    n = coefficients.shape
    tz = axis_norms(t, n[0])[:, None] * axis_norms(z, n[1])
    yx = plane_norms(y, x, n[2], n[3])
    values = coefficients * (1 / tz).astype(dtype)[:, :, None, None]
    values = values * (1 / yx).astype(dtype)
    if is_coupled(y, x):
        rows, columns = lengths(n[2], y.depth), lengths(n[3], x.depth)
        for level in range(y.depth - 1, -1, -1):
            corner = values[:, :, : rows[level], : columns[level]]
            corner[...] = merge(merge(corner, 3, x.kind), 2, y.kind)
    else:
        values = inverse_along(inverse_along(values, 3, x), 2, y)
    return inverse_along(inverse_along(values, 1, z), 0, t)


def is_coupled(y: Axis, x: Axis) -> bool:
    """Whether y and x form a pyramid."""
    return y.kind in WAVELETS and y[:2] == x[:2]


def inverse_along(values: Values, axis: int, transform: Axis) -> Values:
    """The inverse of one axis on its own."""
    moved = np.moveaxis(values, axis, 0)
    if transform.basis is not None:
        matrix = transform.basis.astype(values.dtype)
        total = np.zeros_like(moved)
        for k in range(matrix.shape[1]):  # in this order
            term = matrix[:, k].reshape(-1, 1, 1, 1) * moved[k]
            total = term if k == 0 else total + term
        return np.moveaxis(total, 0, axis)
    for n in lengths(len(moved), transform.depth)[:-1][::-1]:
        moved[:n] = merge(moved[:n], 0, transform.kind)
    return values


STEPS = {
    "5/3": ((True, -0.5), (False, 0.25)),
    "9/7": (
        (True, -1.586134342059924),
        (False, -0.052980118572961),
        (True, 0.882911075530934),
        (False, 0.443506852043971),
    ),
}
"""Lifting steps of the forward transform: whether the odd half changes, and the factor."""


def merge(bands: Values, axis: int, kind: str) -> Values:
    """One level of a wavelet undone: low and high band along an axis by turns again."""
    moved = np.moveaxis(bands, axis, 0)
    half = (len(moved) + 1) // 2
    even, odd = moved[:half].copy(), moved[half:].copy()
    number = bands.dtype.type
    if not len(odd):
        return bands
    if kind == "haar":
        even[: len(odd)] -= number(0.5) * odd
        odd += even[: len(odd)]
    else:
        for changes_odd, factor in reversed(STEPS[kind]):
            if changes_odd:  # neighbours are mirrored at the ends
                after = np.concatenate([even[1:], even[-1:]])
                odd += number(-factor) * (even + after)[: len(odd)]
            else:
                before, after = np.concatenate([odd[:1], odd]), np.concatenate([odd, odd[-1:]])
                even += number(-factor) * (before[:half] + after[:half])
    result = np.empty_like(moved)
    result[0::2], result[1::2] = even, odd
    return np.moveaxis(result, 0, axis)


@cache
def wavelet_norms(kind: str, depth: int, n: int) -> Values:
    """Norms of the synthesis vectors of a wavelet, float64 (n,).

    Up to 512 vertices each vector has its own; on longer axes a band has that of one in the middle.
    """
    if n <= 512:
        return column_norms(inverse_along(np.eye(n), 0, Axis(kind, depth)))
    norms, ends = np.empty(n), lengths(n, depth)
    for level in range(1, depth + 1):
        inner = lengths(32 << level, level)
        vectors = np.zeros((inner[0], 2))
        vectors[16, 0] = vectors[inner[level] + 16, 1] = 1
        low, high = column_norms(inverse_along(vectors, 0, Axis(kind, level)))
        norms[: ends[level]], norms[ends[level] : ends[level - 1]] = low, high
    return norms


def axis_norms(axis: Axis, n: int) -> Values:
    """Norms of the synthesis vectors of an axis on its own, float64 (n,); 1 without a vector."""
    if axis.kind in WAVELETS:
        return wavelet_norms(axis.kind, axis.depth, n)
    norms = np.ones(n)
    if axis.basis is not None:
        norms[: axis.basis.shape[1]] = column_norms(axis.basis.astype(np.float64))
    return norms


def plane_norms(y: Axis, x: Axis, rows: int, columns: int) -> Values:
    """Norms in the plane of y and x, float64 (rows, columns)."""
    if not is_coupled(y, x):
        return axis_norms(y, rows)[:, None] * axis_norms(x, columns)
    ys, xs = lengths(rows, y.depth), lengths(columns, x.depth)
    norms = np.empty((rows, columns))
    for level in range(1, y.depth + 1):  # each overwrites the low-low quarter of the one before
        along_y, along_x = (wavelet_norms(y.kind, level, n) for n in (rows, columns))
        quarter = slice(0, ys[level - 1]), slice(0, xs[level - 1])
        norms[quarter] = along_y[quarter[0], None] * along_x[quarter[1]]
    return norms


def column_norms(matrix: Values) -> Values:
    """Norms of the columns, with sums from the first row on."""
    total = np.zeros(matrix.shape[1])
    for row in matrix:
        total += row * row
    return np.sqrt(total)


def unpack_basis(data: bytes) -> Values:
    """The synthesis matrix (n, r), float32, of a packed basis.

    n and r; the exponent of each vector's scale, in unary downwards from 24; the vectors in the
    domain of the cosine transform as a block of integers.
    """
    n, rank = struct.unpack("<HH", data[:4])
    bits = np.unpackbits(np.frombuffer(data[4:], np.uint8))
    ones = np.flatnonzero(bits)[:rank]
    exponents = [24 - (int(one) - k) for k, one in enumerate(ones)]
    block = data[4 + (int(ones[-1]) // 8 + 1 if rank else 0) :]
    integers = decode_block(block, (1, 1, rank, n))[0, 0] if rank else np.zeros((0, n), np.int32)
    vectors = np.zeros((rank, n))
    for k in range(n):
        row = np.array([cosine((2 * i + 1) * k % (4 * n), n) for i in range(n)])
        row *= math.sqrt((2.0 if k else 1.0) / n)
        vectors += integers[:, k : k + 1].astype(np.float64) * row
    scales = [math.ldexp(0.7071067811865476 if e % 2 else 1.0, -(e // 2)) for e in exponents]
    return (vectors * np.array(scales).reshape(-1, 1)).T.astype(np.float32)


@cache
def cosine(m: int, n: int) -> float:
    """cos(pi m / 2 n), by a Taylor series in an eighth of the circle: the same bits everywhere."""
    if m > 2 * n:
        m = 4 * n - m
    if m > n:
        return -cosine(2 * n - m, n)
    sine = 2 * m > n
    angle = math.pi * (n - m if sine else m) / (2 * n)
    square = angle * angle
    total = 1.0
    for k in range(21 if sine else 20, 1, -2):
        total = 1.0 - square / (k * (k - 1)) * total
    return angle * total if sine else total
