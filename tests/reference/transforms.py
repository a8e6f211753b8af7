"""Transform of the native library by cffi, for tests that look at one kernel alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from fhash_formats.errors import InputError
from fhash_formats.native import ffi, library, pointer
from fhash_formats.support.values import Integers, Values
from fhash_formats.transform.spec import AXES, KINDS, AxisTransform, TransformSpec
from reference.kernels import COLUMNS, NO_REFERENCE, Table

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
    code = library().fhash_transform_inverse_f64(
        pointer(bands),
        pointer(values),
        (n, 1, 1, columns),
        (KINDS.index(kind), 0, 0, 0),
        (depth, 0, 0, 0),
        (0, 0, 0, 0),
        [ffi.NULL] * 4,
        pointer(ones),
        pointer(ones),
        1,
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


THREADS = 2
"""Threads that share a run; they change no bit."""
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
            getattr(library(), f"fhash_transform_{direction}_f{width}")(
                *self._native_arguments(values, result, inverse)
            )
        )
        return result

    def reconstruct(self, integers: Integers, result: Values, numbers: Sequence[float]) -> None:
        """Write the values of integers into `result`. Raises MemoryError."""
        _check_code(
            getattr(library(), f"fhash_reconstruct_f{result.dtype.itemsize * 8}")(
                *self._native_arguments(integers, result, inverse=True),
                numbers,
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
        matrices = self._native_matrices
        pointers = [pointer(matrix) for matrix in matrices]
        return [
            pointer(source),
            pointer(result),
            source.shape,
            [KINDS.index(kind) for kind in self.kinds],
            self.depths,
            ranks,
            pointers,
            pointer(self.scale_tz),
            pointer(self.scale_yx),
            THREADS,
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


_KLT_PLANE = 13
"""Kind of a plane that is spanned by a basis of the data."""
_LEVELS_APART = 4
"""Finest levels that have kinds of their own; coarser levels share the last one's."""


class Span(NamedTuple):
    """A band along one axis.

    Attributes:
        level: 0 for the low band or the whole axis, 1 for the finest high band, negative for the
            low half of a coupled level.
        start: first coefficient.
        stop: coefficient after the last one.
    """

    level: int
    start: int
    stop: int


class _Key(NamedTuple):
    """The place of a band: its number along t and along z, its levels along y and x."""

    t: int
    z: int
    y: int
    x: int


Rows = dict[_Key, int]
"""Row in the table of each earlier band."""


def band_table(spec: TransformSpec, shape: Sequence[int]) -> Table:
    """The bands of a transform on tiles of a shape (t, z, y, x); read-only.

    The native coder trusts the table: every band lies within the shape. Raises InputError for a
    basis of another length than its axis.
    """
    t, z, y, x = spec.axes
    for name, axis, length in zip(AXES, spec.axes, shape, strict=True):
        if axis.basis is not None and axis.basis.n != length:
            raise InputError(
                f"the basis along {name} is for {axis.basis.n} vertices, the tile has {length}"
            )
    return _table(
        _spans(t, shape[0]),
        _spans(z, shape[1]),
        _spans(y, shape[2]),
        _spans(x, shape[3]),
        spec.coupled,
        y.kind == "klt" or x.kind == "klt",
    )


def _spans(axis: AxisTransform, length: int) -> tuple[Span, ...]:
    """The bands along an axis, coarsest first, without empty ones."""
    if axis.basis is not None:
        return (Span(0, 0, axis.basis.rank),) if axis.basis.rank else ()
    lengths = band_lengths(length, axis.depth)
    low = Span(0, 0, lengths[-1])
    high = [Span(level, lengths[level], lengths[level - 1]) for level in range(axis.depth, 0, -1)]
    return tuple(span for span in (low, *high) if span.start < span.stop)


@lru_cache(maxsize=256)
def _table(
    t: tuple[Span, ...],
    z: tuple[Span, ...],
    y: tuple[Span, ...],
    x: tuple[Span, ...],
    coupled: bool,
    klt: bool,
) -> Table:
    """The table of all bands; coupled: of y and x. klt: whether a basis lies along y or x."""
    rows_of: Rows = {}
    rows: list[list[int]] = []
    for plane in _coupled_planes(y, x) if coupled else [list(product(y, x))]:
        for (t_number, t_span), (z_number, z_span) in product(enumerate(t), enumerate(z)):
            for y_span, x_span in plane:
                key = _Key(t_number, z_number, y_span.level, x_span.level)
                spans = (t_span, z_span, y_span, x_span)
                kind = 4 * _plane_kind(key, klt) + 2 * (t_span.level > 0) + (z_span.level > 0)
                rows.append(
                    [
                        *(span.start for span in spans),
                        *(span.stop for span in spans),
                        kind,
                        *(
                            _coupled_parent(rows_of, key)
                            if coupled
                            else _parent(rows_of, key, y, x)
                        ),
                        *_before_along_t(rows_of, key),
                        *_before_along_z(rows_of, key),
                        *(_sibling(rows_of, key) if coupled else NO_REFERENCE),
                    ]
                )
                rows_of[key] = len(rows) - 1
    table = np.array(rows, dtype=np.int32).reshape(-1, COLUMNS)
    table.setflags(write=False)
    return table


def _coupled_planes(y: tuple[Span, ...], x: tuple[Span, ...]) -> list[list[tuple[Span, Span]]]:
    """The bands (y, x) of a coupled plane, in groups.

    The first group is the low-low band. Each level from the coarsest on follows with low-high,
    high-low and high-high. The low half of a level has the level's negative number.
    """
    by_y, by_x = {span.level: span for span in y}, {span.level: span for span in x}
    planes = [[(by_y[0], by_x[0])]]
    for level in range(max([*by_y, *by_x]), 0, -1):
        low_y, low_x = (
            Span(-level, 0, _low_end(by_y, level)),
            Span(-level, 0, _low_end(by_x, level)),
        )
        plane = []
        if level in by_x:
            plane.append((low_y, by_x[level]))
        if level in by_y:
            plane.append((by_y[level], low_x))
        if level in by_x and level in by_y:
            plane.append((by_y[level], by_x[level]))
        planes.append(plane)
    return planes


def _low_end(spans: dict[int, Span], level: int) -> int:
    """The end of the low half of a level.

    It is where the level's high band begins, or where the axis ends at a level without one.
    """
    if level in spans:
        return spans[level].start
    return max(span.stop for span in spans.values() if span.level >= level or span.level == 0)


def _plane_kind(key: _Key, klt: bool) -> int:
    """0 for low-low, 1 to 12 by level and orientation, 13 where a basis spans the plane."""
    if klt:
        return _KLT_PLANE
    level = max(key.y, key.x)
    if level <= 0:
        return 0
    orientation = 2 if key.y > 0 and key.x > 0 else 1 if key.y > 0 else 0
    return 1 + 3 * (min(level, _LEVELS_APART) - 1) + orientation


def _reference(rows_of: Rows, key: _Key, halvings: tuple[int, int, int, int]) -> list[int]:
    """The columns of a reference to an earlier band.

    halvings: along (t, z, y, x), how often an index is halved on the way to that band.
    """
    return [rows_of[key], *halvings] if key in rows_of else NO_REFERENCE


def _before_along_t(rows_of: Rows, key: _Key) -> list[int]:
    """The next coarser band along t."""
    return _reference(rows_of, key._replace(t=key.t - 1), (int(key.t > 1), 0, 0, 0))


def _before_along_z(rows_of: Rows, key: _Key) -> list[int]:
    """The next coarser band along z."""
    return _reference(rows_of, key._replace(z=key.z - 1), (0, int(key.z > 1), 0, 0))


def _coupled_parent(rows_of: Rows, key: _Key) -> list[int]:
    """The band of the same orientation one level up, or the low-low band where there is none."""
    level = max(key.y, key.x)
    if level <= 0:
        return NO_REFERENCE
    coarser = key._replace(
        y=level + 1 if key.y > 0 else -(level + 1), x=level + 1 if key.x > 0 else -(level + 1)
    )
    if coarser in rows_of:
        return _reference(rows_of, coarser, (0, 0, 1, 1))
    return _reference(rows_of, key._replace(y=0, x=0), (0, 0, 0, 0))


def _parent(rows_of: Rows, key: _Key, y: tuple[Span, ...], x: tuple[Span, ...]) -> list[int]:
    """The next coarser band along y, or along x where the band is the coarsest along y."""
    levels_y, levels_x = [span.level for span in y], [span.level for span in x]
    y_number, x_number = levels_y.index(key.y), levels_x.index(key.x)
    if y_number:
        coarser = key._replace(y=levels_y[y_number - 1])
        return _reference(rows_of, coarser, (0, 0, int(y_number > 1), 0))
    if x_number:
        coarser = key._replace(x=levels_x[x_number - 1])
        return _reference(rows_of, coarser, (0, 0, 0, int(x_number > 1)))
    return NO_REFERENCE


def _sibling(rows_of: Rows, key: _Key) -> list[int]:
    """The band of the same level that a band of a coupled plane refers to.

    High-low refers to low-high, and high-high to high-low.
    """
    if max(key.y, key.x) <= 0 or key.y < 0:
        return NO_REFERENCE
    sibling = key._replace(x=-key.y) if key.x > 0 else key._replace(y=key.x, x=-key.x)
    return _reference(rows_of, sibling, (0, 0, 0, 0))
