"""The transform of a tile, forward and inverse, at full or reduced resolution.

The forward transform goes along t, then z, then y and x (spec.py). Then each coefficient is
multiplied by the norm of its synthesis vector (weights.py). The norm is a product of two factors,
one of (t, z) and one of (y, x), each computed in float64 and rounded once to the working type. The
inverse multiplies by their reciprocals, rounded once, and undoes the rest in the opposite order.
The arithmetic is that of native/lifting.cpp.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from fhash_formats import native
from fhash_formats.errors import InputError
from fhash_formats.transform.axes.spec import AXES, KINDS, TransformSpec
from fhash_formats.transform.axes.weights import axis_norms, band_lengths, plane_norms

__all__ = ["MAX_LOD", "Transform"]

MAX_LOD = 10
"""Most halvings of a reduced resolution."""

STEPS_97 = (
    (True, -1.586134342059924),
    (False, -0.052980118572961),
    (True, 0.882911075530934),
    (False, 0.443506852043971),
)
"""Lifting steps of the wavelet 9/7 (Daubechies and Sweldens 1998, without the final scaling by K):
whether the odd half changes, and the factor."""

Values = NDArray[Any]
Integers = NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """The arguments of one run over a tile.

    Attributes:
        kinds: kind of each axis.
        depths: number of levels of each axis.
        matrices: matrix of each axis with a basis, None for the others.
        scale_tz: factors (t, z).
        scale_yx: factors (y, x).
    """

    kinds: tuple[str, ...]
    depths: tuple[int, ...]
    matrices: tuple[Values | None, ...]
    scale_tz: Values
    scale_yx: Values

    def run(self, values: Values, inverse: bool) -> Values:
        """The transformed values. Raises MemoryError."""
        direction, width = "inverse" if inverse else "forward", values.dtype.itemsize * 8
        result = np.empty(values.shape, values.dtype)
        _check_code(
            getattr(native.library(), f"fhash_transform_{direction}_f{width}")(
                *self._native_arguments(values, result, inverse)
            )
        )
        return result

    def reconstruct(self, integers: Integers, result: Values, numbers: Sequence[float]) -> None:
        """Write the values of integers into `result`. Raises MemoryError."""
        _check_code(
            getattr(native.library(), f"fhash_reconstruct_f{result.dtype.itemsize * 8}")(
                *self._native_arguments(integers, result, inverse=True),
                (ctypes.c_double * len(numbers))(*numbers),
            )
        )

    @cached_property
    def _native_matrices(self) -> list[Values | None]:
        """The matrices as the library takes them: along x transposed, so that its rows lie along
        the results.
        """
        return [
            None if matrix is None else np.ascontiguousarray(matrix.T if axis == 3 else matrix)
            for axis, matrix in enumerate(self.matrices)
        ]

    def _native_arguments(self, source: Values, result: Values, inverse: bool) -> list[Any]:
        """The arguments of the native transforms."""
        rank_axis = 1 if inverse else 0
        ranks = [0 if matrix is None else matrix.shape[rank_axis] for matrix in self.matrices]
        four = ctypes.c_int64 * 4
        matrices = self._native_matrices
        pointers = (ctypes.c_void_p * 4)(*(None if m is None else m.ctypes.data for m in matrices))
        return [
            source.ctypes.data_as(ctypes.c_void_p),
            result.ctypes.data_as(ctypes.c_void_p),
            four(*source.shape),
            four(*(KINDS.index(kind) for kind in self.kinds)),
            four(*self.depths),
            four(*ranks),
            pointers,
            self.scale_tz.ctypes.data_as(ctypes.c_void_p),
            self.scale_yx.ctypes.data_as(ctypes.c_void_p),
        ]


def _check_code(code: int) -> None:
    """Raises MemoryError where a native transform had no memory."""
    if code == -2:
        raise MemoryError("no memory for the transform of a tile")
    assert code == 0, f"the native transform refused its arguments ({code})"


class Transform:
    """The transform of tiles of one shape and type.

    Build it once and use it for every tile, from any thread.

    Args:
        spec: the transform of each axis.
        shape: (t, z, y, x), each at least 1; along an axis with a basis, the length of the basis.
        dtype: type of values, coefficients and arithmetic, float32 or float64.

    Raises InputError for another shape or type.
    """

    def __init__(
        self, spec: TransformSpec, shape: tuple[int, ...], dtype: DTypeLike = np.float32
    ) -> None:
        self.spec = spec
        self.shape = tuple(int(n) for n in shape)
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        if len(self.shape) != 4 or min(self.shape) < 1:
            raise InputError(f"a tile has four axes (t, z, y, x) of at least 1, not {self.shape}")
        if self.dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
            raise InputError(f"a transform works in float32 or float64, not {self.dtype}")
        for name, axis, n in zip(AXES, spec.axes, self.shape, strict=True):
            if axis.basis is not None and axis.basis.n != n:
                raise InputError(
                    f"the basis along {name} is for {axis.basis.n} vertices, the tile has {n}"
                )
        self._plans: dict[int, _Plan] = {}

    @cached_property
    def norms(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Norms of the synthesis vectors, float64, as two factors: (t, z) and (y, x)."""
        t, z, y, x = self.spec.axes
        return axis_norms(t, self.shape[0])[:, None] * axis_norms(z, self.shape[1]), plane_norms(
            y, x, *self.shape[2:]
        )

    def forward(self, values: Values) -> Values:
        """Coefficients of a tile: a new array of the same shape and type, low bands first.

        Entries beyond a basis's rank are 0. Raises InputError for another shape or type.
        """
        return self._forward_plan.run(self._checked(values), inverse=False)

    def inverse(self, coefficients: Values, lod: int = 0) -> Values:
        """Values of a tile from its coefficients: a new array of the same type.

        Args:
            coefficients: what `forward` gives, of the same shape and type.
            lod: level of detail. 0 gives the tile. n gives ceil(length / 2^n) vertices along z, y
                and x and all along t, at every 2^n-th vertex; a constant stays that constant.

        Along an axis with a wavelet, the reduced values are the low band n levels down. A Haar low
        band is the mean of its 2^n vertices and stands between them, up to (2^n - 1) / 2 off. For
        levels beyond an axis's depth, and along an axis with a basis or without a transform, the
        values are filtered by (1/4, 1/2, 1/4), clamped at the ends, and every second one is kept.

        Raises InputError for another shape or type, or lod outside 0 to MAX_LOD.
        """
        _check_lod(lod)
        checked = self._checked(coefficients)
        if lod not in self._plans:
            self._plans[lod] = self._inverse_plan(lod)
        kept = tuple(slice(0, n) for n in self._bands(lod))
        result = self._plans[lod].run(np.ascontiguousarray(checked[kept]), inverse=True)
        for axis, transform in enumerate(self.spec.axes[1:], start=1):
            for _ in range(lod - min(lod, transform.depth)):
                result = _halved(result, axis)
        return result

    def reconstruct(
        self, integers: Integers, numbers: Sequence[float], *, in_place: bool = False
    ) -> Values | None:
        """Values of a tile from its quantised coefficients.

        They are `dequantise`, `inverse` and `clip_shifted` in one run over the memory. The result
        is None where only those three can do it.

        Args:
            integers: int32 of the tile's shape, C-contiguous.
            numbers: quantiser step, six offsets in steps (of magnitudes 1, 2, 3, 4, odd ones from
                5 on, even ones from 6 on), then the centre and the ends of the range.
            in_place: whether the values may overwrite the integers, which they then do where they
                have the same size.
        """
        # Zeros may have another sign until a centre is added that is not -0.
        if numbers[7] == 0 and math.copysign(1.0, numbers[7]) < 0:
            return None
        over = in_place and self.dtype == np.float32 and integers.flags.writeable
        result = integers.view(np.float32) if over else np.empty(self.shape, self.dtype)
        if 0 not in self._plans:
            self._plans[0] = self._inverse_plan(0)
        self._plans[0].reconstruct(integers, result, numbers)
        return result

    @cached_property
    def _forward_plan(self) -> _Plan:
        bases = [axis.basis for axis in self.spec.axes]
        return _Plan(
            kinds=tuple(axis.kind for axis in self.spec.axes),
            depths=tuple(axis.depth for axis in self.spec.axes),
            matrices=tuple(
                None if basis is None else basis.analysis.astype(self.dtype) for basis in bases
            ),
            scale_tz=self.norms[0].astype(self.dtype),
            scale_yx=self.norms[1].astype(self.dtype),
        )

    def _inverse_plan(self, lod: int) -> _Plan:
        """The inverse of the bands that `lod` needs: the deepest levels of each wavelet along z, y,
        x.

        The gain on a constant of the `lod` levels that are left out is divided out.
        """
        left_out = (0, *(min(lod, axis.depth) for axis in self.spec.axes[1:]))
        depths = tuple(
            axis.depth - levels for axis, levels in zip(self.spec.axes, left_out, strict=True)
        )
        kinds = tuple(
            "none" if axis.wavelet and depth == 0 else axis.kind
            for axis, depth in zip(self.spec.axes, depths, strict=True)
        )
        t, z, y, x = self._bands(lod)
        gains = [
            _gain(axis.kind, n, levels)
            for axis, n, levels in zip(self.spec.axes, self.shape, left_out, strict=True)
        ]
        bases = [axis.basis for axis in self.spec.axes]
        return _Plan(
            kinds=kinds,
            depths=depths,
            matrices=tuple(
                None if basis is None else basis.synthesis.astype(self.dtype) for basis in bases
            ),
            scale_tz=(1.0 / (self.norms[0][:t, :z] * gains[1])).astype(self.dtype),
            scale_yx=(1.0 / (self.norms[1][:y, :x] * (gains[2] * gains[3]))).astype(self.dtype),
        )

    def _bands(self, lod: int) -> tuple[int, ...]:
        """Shape of the coefficients that `lod` needs."""
        return (
            self.shape[0],
            *(
                band_lengths(n, min(lod, axis.depth))[-1]
                for axis, n in zip(self.spec.axes[1:], self.shape[1:], strict=True)
            ),
        )

    def _checked(self, values: Values) -> Values:
        if values.shape != self.shape or values.dtype != self.dtype:
            raise InputError(
                f"this transform takes {self.dtype} of shape {self.shape}, "
                f"not {values.dtype} of {values.shape}"
            )
        return np.ascontiguousarray(values)


def _check_lod(lod: int) -> None:
    if isinstance(lod, bool) or not isinstance(lod, (int, np.integer)) or not 0 <= lod <= MAX_LOD:
        raise InputError(f"lod is 0 to {MAX_LOD}, not {lod!r}")


def _gain(kind: str, n: int, levels: int) -> float:
    """The value of a constant 1 in the low band after `levels` levels.

    It differs from 1 for 9/7 only, whose lifting leaves out the scaling by K. A level on a length
    of 1 changes nothing.
    """
    if kind != "9/7":
        return 1.0
    even = odd = 1.0
    for changes_odd, factor in STEPS_97:
        if changes_odd:
            odd += factor * (even + even)
        else:
            even += factor * (odd + odd)
    gain = 1.0
    for m in band_lengths(n, levels)[:levels]:
        gain *= even if m > 1 else 1.0
    return gain


def _halved(values: Values, axis: int) -> Values:
    """Every second value along an axis after the filter (1/4, 1/2, 1/4), clamped at the ends."""
    moved = np.moveaxis(values, axis, 0)
    before, after = (
        np.concatenate([moved[:1], moved])[:-1][0::2],
        np.concatenate([moved[1:], moved[-1:]])[0::2],
    )
    kind = values.dtype.type
    with np.errstate(all="ignore"):
        return np.ascontiguousarray(
            np.moveaxis((before + after) * kind(0.25) + moved[0::2] * kind(0.5), 0, axis)
        )
