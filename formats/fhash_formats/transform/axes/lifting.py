"""The transform of a tile, forward and inverse, at full or reduced resolution.

Forward: along t, then z, then y and x (spec.py), then each coefficient is multiplied by the norm of its synthesis vector (weights.py).
The norm is two factors, of (t, z) and of (y, x), each computed in float64 and rounded once to the working type; the inverse multiplies by
their reciprocals, rounded once, and undoes the rest in the opposite order. The native library and the portable twin give the same bits.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from fhash_formats import native
from fhash_formats.errors import InputError
from fhash_formats.transform.axes.lifting_portable import (
    KIND_NUMBERS,
    forward_axis,
    forward_tile,
    inverse_tile,
)
from fhash_formats.transform.axes.spec import AXES, TransformSpec
from fhash_formats.transform.axes.weights import axis_norms, band_lengths, plane_norms

__all__ = ["MAX_LOD", "Transform"]

MAX_LOD = 10
"""Most halvings of a reduced resolution."""

Values = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """One run over a tile: what goes along each axis, and the factors of (t, z) and (y, x)."""

    kinds: tuple[str, ...]
    depths: tuple[int, ...]
    matrices: tuple[Values | None, ...]
    scale_tz: Values
    scale_yx: Values

    def run(self, values: Values, inverse: bool) -> Values:
        library = native.library()
        if library is None:
            with np.errstate(all="ignore"):
                return (inverse_tile if inverse else forward_tile)(
                    values, self.kinds, self.depths, self.matrices, self.scale_tz, self.scale_yx
                )
        direction, width = "inverse" if inverse else "forward", values.dtype.itemsize * 8
        function = getattr(library, f"fhash_transform_{direction}_f{width}")
        result = np.empty(values.shape, values.dtype)
        rank = 1 if inverse else 0
        ranks = [0 if matrix is None else matrix.shape[rank] for matrix in self.matrices]
        # Along x the library takes the transpose, whose rows lie along the results.
        held = [
            None if m is None else np.ascontiguousarray(m.T if axis == 3 else m)
            for axis, m in enumerate(self.matrices)
        ]
        pointers = (ctypes.c_void_p * 4)(*(None if m is None else m.ctypes.data for m in held))
        shape, kinds = (
            (ctypes.c_int64 * 4)(*values.shape),
            (ctypes.c_int64 * 4)(*(KIND_NUMBERS[kind] for kind in self.kinds)),
        )
        scales = (ctypes.c_void_p(array.ctypes.data) for array in (self.scale_tz, self.scale_yx))
        ends = (ctypes.c_void_p(array.ctypes.data) for array in (values, result))
        code = function(
            *ends,
            shape,
            kinds,
            (ctypes.c_int64 * 4)(*self.depths),
            (ctypes.c_int64 * 4)(*ranks),
            pointers,
            *scales,
        )
        if code == -2:
            raise MemoryError("no memory for the transform of a tile")
        assert code == 0, f"the native transform refused its arguments ({code})"
        return result


class Transform:
    """The transform of tiles of one shape and type; build it once and use it for every tile, from any thread.

    spec: what goes along each axis. shape: (t, z, y, x), each at least 1; along an axis with a basis, its length. dtype: float32 or
    float64, the type of values, coefficients and arithmetic. Raises InputError.
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

    @property
    def weights(self) -> NDArray[np.float64]:
        """The norm of each coefficient's synthesis vector, float64 of the tile's shape; for looking at, not for the way to and back."""
        tz, yx = self.norms
        return tz[:, :, None, None] * yx

    def lod_shape(self, lod: int) -> tuple[int, ...]:
        """Shape of `inverse(..., lod)`: t, and ceil(n / 2^lod) along z, y, x."""
        _check_lod(lod)
        return (self.shape[0], *((n + (1 << lod) - 1) >> lod for n in self.shape[1:]))

    def forward(self, values: Values) -> Values:
        """Coefficients of a tile: a fresh array of the same shape and type, low bands first; entries beyond a basis's rank are 0.

        Raises InputError for another shape or type.
        """
        return self._forward_plan.run(self._checked(values), inverse=False)

    def inverse(self, coefficients: Values, lod: int = 0) -> Values:
        """Values of a tile from its coefficients: a fresh array of the same type.

        lod: 0 gives the tile; n gives ceil(length / 2^n) vertices along z, y and x and all along t, at every 2^n-th vertex, and a
        constant stays that constant. Along an axis with a wavelet that is the low band n levels down; a Haar low band is the mean of its
        2^n vertices, so it stands between them, up to (2^n - 1) / 2 off. For the levels that an axis lacks, and with a basis or nothing,
        the values are filtered by (1/4, 1/2, 1/4), clamped at the ends, and every second is kept. Raises InputError for another shape or
        type, or lod outside 0 to MAX_LOD.
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
        """The inverse of the first bands of z, y, x: what is left of each wavelet after `lod` levels, its gain on a constant taken out."""
        stopped = (0, *(min(lod, axis.depth) for axis in self.spec.axes[1:]))
        depths = tuple(
            axis.depth - levels for axis, levels in zip(self.spec.axes, stopped, strict=True)
        )
        kinds = tuple(
            "none" if axis.wavelet and depth == 0 else axis.kind
            for axis, depth in zip(self.spec.axes, depths, strict=True)
        )
        t, z, y, x = self._bands(lod)
        gains = [
            _gain(axis.kind, n, levels)
            for axis, n, levels in zip(self.spec.axes, self.shape, stopped, strict=True)
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
                f"this transform takes {self.dtype} of shape {self.shape}, not {values.dtype} of {values.shape}"
            )
        return np.ascontiguousarray(values)


def _check_lod(lod: int) -> None:
    if isinstance(lod, bool) or not isinstance(lod, (int, np.integer)) or not 0 <= lod <= MAX_LOD:
        raise InputError(f"lod is 0 to {MAX_LOD}, not {lod!r}")


def _gain(kind: str, n: int, levels: int) -> float:
    """What `levels` low bands make of a constant 1 (1 but for 9/7, whose lifting leaves out the scaling; none where a length is 1)."""
    gain = 1.0
    for m in band_lengths(n, levels)[:levels]:
        gain *= float(forward_axis(np.ones(min(m, 2)), 0, kind)[0])
    return gain


def _halved(values: Values, axis: int) -> Values:
    """Every second entry along an axis after the filter (1/4, 1/2, 1/4), clamped at the ends."""
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
