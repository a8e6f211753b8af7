"""Parts of the settings of a tile: transform and basis of each axis, scores of a mask."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.native import pointer
from fhash_formats.support.values import Integers

NO_MEMORY = -2
"""Code that a native function returns where it had no memory; twin of `NO_MEMORY` in guard.hpp."""


def encode_block(integers: Integers) -> bytes:
    """Code a small block of int32 integers (four axes) that stands alone."""
    given = np.ascontiguousarray(integers, np.int32)
    room = np.empty(8 * given.size + 4096, np.uint8)
    if not given.size:
        return b""
    coder = native.library().fhash_encode_block
    size = checked(coder(pointer(given), given.shape, pointer(room), room.size))
    assert 0 <= size <= room.size, "eight bytes are enough for an integer"
    return room[:size].tobytes()


def decode_block(data: bytes | memoryview, shape: tuple[int, ...]) -> Integers:
    """The block that `encode_block` coded.

    Raises DamagedFileError for bytes that no encoder writes, as far as the decoder can tell.
    """
    if prod(shape) == 0:
        if len(data):
            raise DamagedFileError("bytes where nothing is coded")
        return np.zeros(shape, dtype=np.int32)
    integers, source = np.zeros(shape, np.int32), np.frombuffer(data, np.uint8)
    code = native.library().fhash_decode_block(
        pointer(source), source.size, shape, pointer(integers)
    )
    if checked(code) < 0:
        raise DamagedFileError("the coded integers are damaged")
    return integers


def checked(code: int) -> int:
    """The code that a native function returned; raises MemoryError where it is NO_MEMORY."""
    if code == NO_MEMORY:
        raise MemoryError("no memory for the work of a native function")
    return code


MAX_LABELS = 65536
"""Most labels of a tile."""

MAX_EDGES = 15
"""Most edges between classes of values."""
MAX_REACH = 64
"""Largest reach, in vertices."""
MAX_SCORE = 4095
"""Largest score, and largest sum of scores."""
MAX_FLOAT = float(np.finfo(np.float64).max)
"""Largest magnitude of an edge."""
UNIT = 128
"""Scores per bit."""


@dataclass(frozen=True, kw_only=True)
class MaskLevels:
    """Scores of the decoded values; raises InputError for values that are not allowed.

    Attributes:
        edges: at most MAX_EDGES ascending numbers; class i holds the values from edge i - 1 on and
            below edge i.
        scores: score of each class, 0 to MAX_SCORE, in 1/UNIT bit.
        others: scores for the second level; without them it is the level of the vertex alone by
            `scores`.
        reach: vertices along z, y and x by which a feature was grown, 0 to MAX_REACH.
    """

    edges: tuple[float, ...] = ()
    scores: tuple[int, ...] = (0,)
    others: tuple[int, ...] = ()
    reach: int = 0

    def __post_init__(self) -> None:
        numbers = all(type(edge) in (int, float) and abs(edge) <= MAX_FLOAT for edge in self.edges)
        if (
            len(self.edges) > MAX_EDGES
            or not numbers
            or any(low >= high for low, high in pairwise(self.edges))
        ):
            raise InputError(
                f"edges of a mask are {self.edges!r:.80}; "
                f"at most {MAX_EDGES} ascending numbers are needed"
            )
        for scores in (self.scores, *([self.others] if self.others else [])):
            if len(scores) != len(self.edges) + 1 or not all(
                type(n) is int and 0 <= n <= MAX_SCORE for n in scores
            ):
                raise InputError(
                    f"scores of a mask are {scores!r:.80}; "
                    f"{len(self.edges) + 1} whole numbers to {MAX_SCORE} are needed"
                )
        if type(self.reach) is not int or not 0 <= self.reach <= MAX_REACH:
            raise InputError(
                f"reach of a mask is {self.reach!r:.40}; a whole number to {MAX_REACH} is needed"
            )


MAX_LENGTH = 512
"""Longest axis, in vertices, that may have a basis of its own."""
MAX_EXPONENT = 24
"""Largest scale exponent: integers up to 2^12."""

_SQRT_HALF = 0.7071067811865476
"""Square root of 1/2."""
_MIN_NEW = 0.3
"""Smallest share of a vector's length outside the span of the vectors before it.

A vector below that adds noise and no information.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Basis:
    """A quantised synthesis matrix. Raises InputError for integers or exponents out of range.

    Attributes:
        integers: DCT coefficients of the vectors, int32 (r, n), the vector of the largest amplitude
            first. At most 1.5 * 2^(e / 2) + 1 in size; no row is all zero.
        exponents: e of each row, MAX_EXPONENT at most and 0 at least, never rising.
    """

    integers: NDArray[np.int32]
    exponents: tuple[int, ...]

    def __post_init__(self) -> None:
        if self.integers.ndim != 2 or self.integers.dtype != np.int32:
            raise InputError("the integers of a basis are an int32 array (r, n)")
        rank, n = self.integers.shape
        if not 1 <= n <= MAX_LENGTH or rank > n or len(self.exponents) != rank:
            raise InputError(
                f"a basis has at most n vectors of length n, n at most {MAX_LENGTH}, "
                f"not {rank} of {n} with {len(self.exponents)} exponents"
            )
        falling = [MAX_EXPONENT, *self.exponents, 0]
        if any(before < after for before, after in pairwise(falling)):
            raise InputError(
                f"the exponents of a basis fall from at most {MAX_EXPONENT} to at least 0"
            )
        largest = (
            np.abs(self.integers.astype(np.int64)).max(axis=1) if rank else np.zeros(0, np.int64)
        )
        if any(
            not 0 < size <= (1 << exponent // 2) * 1.5 + 1
            for size, exponent in zip(largest.tolist(), self.exponents, strict=True)
        ):
            raise InputError("a vector of the basis is zero or longer than 1")
        self.integers.setflags(write=False)

    @property
    def n(self) -> int:
        """Length of the axis."""
        return int(self.integers.shape[1])

    @property
    def rank(self) -> int:
        """Number of vectors, at most n."""
        return int(self.integers.shape[0])

    @cached_property
    def synthesis(self) -> NDArray[np.float32]:
        """S, float32 (n, r). Its columns are the vectors, of about unit length.

        Every machine computes the same bits.
        """
        vectors = np.zeros((self.rank, self.n), np.float64)
        for k, row in enumerate(_dct(self.n)):
            vectors += self.integers[:, k : k + 1].astype(np.float64) * row
        scales = np.array([_shrink(exponent) for exponent in self.exponents], np.float64)
        result = np.ascontiguousarray((vectors * scales[:, None]).T.astype(np.float32))
        result.setflags(write=False)
        return result

    @cached_property
    def analysis(self) -> NDArray[np.float64]:
        """(S^T S)^-1 S^T, float64 (r, n), which gives the least-squares coefficients of a column.

        Only the encoder needs it. Raises InputError where S is singular.
        """
        wide = self.synthesis.astype(np.float64)
        gram = np.zeros((self.rank, self.rank))
        for row in wide:
            gram += row[:, None] * row
        result = _solve(gram, np.ascontiguousarray(wide.T))
        result.setflags(write=False)
        return result

    def to_bytes(self) -> bytes:
        """The packed basis; the module's docstring describes its bytes."""
        bits: list[int] = []
        level = MAX_EXPONENT
        for exponent in self.exponents:
            bits += [0] * (level - exponent) + [1]
            level = exponent
        block = encode_block(self.integers.reshape(1, 1, self.rank, self.n)) if self.rank else b""
        return (
            struct.pack("<HH", self.n, self.rank)
            + np.packbits(np.array(bits, np.uint8)).tobytes()
            + block
        )

    @classmethod
    def from_bytes(cls, data: bytes, n: int | None = None) -> Basis:
        """The inverse of `to_bytes`. Raises DamagedFileError.

        n: the length that the basis must have; None for any.
        """
        if len(data) < 4:
            raise DamagedFileError(f"a packed basis has at least 4 bytes, not {len(data)}")
        length, rank = struct.unpack("<HH", data[:4])
        if not 1 <= length <= MAX_LENGTH or rank > length or n not in (None, length):
            raise DamagedFileError(
                f"a packed basis has {rank} vectors of length {length} "
                f"where {n or f'at most {MAX_LENGTH}'} is needed"
            )
        exponents, size = _read_exponents(data[4:], rank)
        rest = data[4 + size :]
        if not rank and rest:
            raise DamagedFileError("a packed basis has bytes after its end")
        integers = (
            decode_block(rest, (1, 1, rank, length)).reshape(rank, length)
            if rank
            else np.zeros((0, length), np.int32)
        )
        try:
            return cls(integers=integers, exponents=exponents)
        except InputError as error:
            raise DamagedFileError(f"a packed basis: {error}") from error

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Basis)
            and self.exponents == other.exponents
            and np.array_equal(self.integers, other.integers)
        )

    def __hash__(self) -> int:
        return hash((self.exponents, self.integers.tobytes()))


def fit_basis(gram: NDArray[np.float64], step: float) -> Basis:
    """Fit the basis of data from the Gram matrix of its columns.

    A vector is dropped where its total amplitude, the root of its eigenvalue, is below the step.
    The others get a scale of amplitude / step, to half an octave and at most 2^12. Quantising a
    vector then costs no more than quantising its coefficients. For the encoder.

    Args:
        gram: float64 (n, n), the sum (not the mean) over all columns v of v v^T.
        step: quantiser step in data units, > 0.

    Raises InputError for a matrix that is not square, too large or not finite, and for another
    step.
    """
    if gram.ndim != 2 or gram.shape[0] != gram.shape[1] or not 1 <= len(gram) <= MAX_LENGTH:
        raise InputError(
            f"a Gram matrix is square with at most {MAX_LENGTH} rows, not {gram.shape}"
        )
    if not np.isfinite(gram).all() or not (math.isfinite(step) and step > 0):
        raise InputError(f"a basis needs finite data and a positive step, not {step!r}")
    amplitudes, spectra = _modes(gram.tobytes(), len(gram))
    rows: list[NDArray[np.int32]] = []
    exponents: list[int] = []
    span = np.zeros((0, len(gram)))  # orthonormal basis of the rows so far
    for amplitude, spectrum in zip(amplitudes.tolist(), spectra, strict=True):
        if amplitude < step:
            break
        exponent = min(MAX_EXPONENT, round(2 * math.log2(amplitude / step)))
        sign = 1.0 if spectrum[np.argmax(np.abs(spectrum))] > 0 else -1.0
        row = np.rint(spectrum * (sign / _shrink(exponent))).astype(np.int32)
        rest = row.astype(np.float64)
        length = math.sqrt(rest @ rest)
        for _ in range(2):  # Gram-Schmidt, repeated against rounding
            rest = rest - (span @ rest) @ span
        rest_length = math.sqrt(rest @ rest)
        if length == 0 or rest_length < _MIN_NEW * length:
            continue
        span = np.vstack([span, rest / rest_length])
        rows.append(row)
        exponents.append(exponent)
    return Basis(
        integers=np.array(rows, np.int32).reshape(len(rows), len(gram)), exponents=tuple(exponents)
    )


@lru_cache(maxsize=32)
def _modes(gram: bytes, n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The amplitudes of the modes of a Gram matrix, the largest first, and their DCTs as rows.

    They are kept for the next step that a basis is fitted for.
    """
    values, vectors = np.linalg.eigh(np.frombuffer(gram).reshape(n, n))
    spectra = vectors[:, ::-1].T @ np.array(_dct(n)).T
    return np.sqrt(np.maximum(values[::-1], 0.0)), spectra


def _shrink(exponent: int) -> float:
    """2^(-exponent / 2), computed from exact powers of two and one constant."""
    return math.ldexp(_SQRT_HALF if exponent % 2 else 1.0, -(exponent // 2))


def _read_exponents(data: bytes, rank: int) -> tuple[tuple[int, ...], int]:
    """The exponents at the start of `data`, and the number of their bytes."""
    room = (rank + MAX_EXPONENT + 7) // 8
    bits = np.unpackbits(np.frombuffer(data[:room], np.uint8)).tolist()
    exponents: list[int] = []
    level, position = MAX_EXPONENT, 0
    while len(exponents) < rank:
        if position == len(bits) or level < 0:
            raise DamagedFileError("the exponents of a packed basis are cut or out of range")
        if bits[position]:
            exponents.append(level)
        else:
            level -= 1
        position += 1
    size = (position + 7) // 8
    if any(bits[position : 8 * size]):
        raise DamagedFileError("the exponents of a packed basis are not padded with zeros")
    return tuple(exponents), size


@lru_cache(maxsize=32)
def _dct(n: int) -> tuple[NDArray[np.float64], ...]:
    """The rows k of the orthonormal DCT-II of length n: c_k cos(pi (2 i + 1) k / 2 n).

    Computed with + - * / and sqrt only, so that every machine gets the same bits.
    """
    cosines = np.array([_cosine(m, n) for m in range(4 * n)])
    odd = 2 * np.arange(n, dtype=np.int64) + 1
    return tuple(cosines[odd * k % (4 * n)] * math.sqrt((2.0 if k else 1.0) / n) for k in range(n))


def _cosine(m: int, n: int) -> float:
    """cos(pi m / 2 n) for 0 <= m < 4 n, to about 1e-16.

    The angle is folded into an eighth of the circle; there the Taylor series is summed in float64.
    """
    if m > 2 * n:
        m = 4 * n - m
    if m > n:
        return -_cosine(2 * n - m, n)
    sine = 2 * m > n
    angle = math.pi * (n - m if sine else m) / (2 * n)
    square = angle * angle
    total = 1.0
    for k in range(21 if sine else 20, 1, -2):
        total = 1.0 - square / (k * (k - 1)) * total
    return angle * total if sine else total


def _solve(gram: NDArray[np.float64], right: NDArray[Any]) -> NDArray[np.float64]:
    """gram^-1 right, for a symmetric positive definite matrix, by elimination in a fixed order.

    Raises InputError where the matrix is nearly singular.
    """
    left, result = gram.copy(), right.astype(np.float64)
    for k in range(len(left)):
        if not left[k, k] > 1e-9 * gram[k, k]:
            raise InputError(
                "the vectors of a basis depend on each other, so nothing can be encoded with it"
            )
        ratios = left[k + 1 :, k] / left[k, k]
        left[k + 1 :] -= ratios[:, None] * left[k]
        result[k + 1 :] -= ratios[:, None] * result[k]
    for k in range(len(left) - 1, -1, -1):
        result[k] = result[k] / left[k, k]
        result[:k] -= left[:k, k, None] * result[k]
    return result


AXES = ("t", "z", "y", "x")
"""Names of the axes, in order."""
KINDS = ("none", "haar", "5/3", "9/7", "klt")
"""Kinds of transforms.

No transform; Haar, with the mean of a pair as its low band; LeGall 5/3; Cohen-Daubechies-Feauveau
9/7; the data's own basis (Karhunen-Loeve).
"""
WAVELETS = ("haar", "5/3", "9/7")
"""Kinds that split an axis into bands."""
MAX_DEPTH = 10
"""Most levels of a wavelet."""


@dataclass(frozen=True, kw_only=True)
class AxisTransform:
    """The transform along one axis. Raises InputError for values that do not fit together.

    Attributes:
        kind: one of KINDS.
        depth: number of levels, 1 to MAX_DEPTH for a wavelet and 0 for the others.
        basis: the basis of "klt"; None for the other kinds.
    """

    kind: str
    depth: int = 0
    basis: Basis | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"unknown transform {self.kind!r:.40}: choose from {', '.join(KINDS)}")
        if isinstance(self.depth, bool) or not isinstance(self.depth, int):
            raise InputError(f"the depth of a transform is a whole number, not {self.depth!r:.40}")
        shallowest, deepest = (1, MAX_DEPTH) if self.wavelet else (0, 0)
        if not shallowest <= self.depth <= deepest:
            raise InputError(
                f"the depth of {self.kind!r} is {shallowest} to {deepest}, not {self.depth!r:.40}"
            )
        if (self.kind == "klt") != isinstance(self.basis, Basis):
            raise InputError("'klt' needs a basis, and nothing else takes one")

    @property
    def wavelet(self) -> bool:
        """Whether the axis is split into bands."""
        return self.kind in WAVELETS

    def to_json(self) -> Any:
        """The JSON value: `"none"` or `[kind, depth]`. Raises InputError for a basis."""
        if self.basis is not None:
            raise InputError("a basis of the data's own is no JSON value")
        return [self.kind, self.depth] if self.wavelet else self.kind

    @classmethod
    def from_json(cls, value: Any) -> AxisTransform:
        """The inverse of `to_json`. Raises InputError for anything else."""
        if isinstance(value, str):
            return cls(kind=value)
        if isinstance(value, (list, tuple)) and len(value) == 2 and isinstance(value[0], str):
            return cls(kind=value[0], depth=value[1])
        raise InputError(f'a transform is "none" or [kind, depth], not {value!r:.60}')


@dataclass(frozen=True, kw_only=True)
class TransformSpec:
    """The transforms along (t, z, y, x). Raises InputError unless there are four.

    Attributes:
        axes: the transform of each axis.
    """

    axes: tuple[AxisTransform, AxisTransform, AxisTransform, AxisTransform]

    def __post_init__(self) -> None:
        if (
            not isinstance(self.axes, tuple)
            or len(self.axes) != 4
            or not all(isinstance(axis, AxisTransform) for axis in self.axes)
        ):
            raise InputError("a transform has four axes (t, z, y, x), each an AxisTransform")

    @property
    def coupled(self) -> bool:
        """Whether y and x form a pyramid: the same wavelet with the same depth."""
        y, x = self.axes[2:]
        return y.wavelet and (y.kind, y.depth) == (x.kind, x.depth)

    def check(self, shape: Sequence[int]) -> None:
        """Raises InputError for a basis of another length than its axis of a tile (t, z, y, x)."""
        for name, axis, n in zip(AXES, self.axes, shape, strict=True):
            if axis.basis is not None and axis.basis.n != n:
                raise InputError(
                    f"the basis along {name} is for {axis.basis.n} vertices, the tile has {n}"
                )

    def to_dict(self) -> dict[str, Any]:
        """JSON values by axis.

        For example `{"t": ["haar", 2], "z": "none", "y": ["9/7", 4], "x": ["9/7", 4]}`.
        """
        return {name: axis.to_json() for name, axis in zip(AXES, self.axes, strict=True)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TransformSpec:
        """The inverse of `to_dict`.

        Raises InputError for a missing or unknown key and for a bad value; the message names the
        key.
        """
        if not isinstance(values, Mapping):
            raise InputError(
                f"a transform is a mapping with the keys {', '.join(AXES)}, not {values!r:.60}"
            )
        unknown = [key for key in values if key not in AXES]
        missing = [key for key in AXES if key not in values]
        if unknown or missing:
            named = f"unknown key {unknown[0]!r:.40}" if unknown else f"missing key {missing[0]!r}"
            raise InputError(f"transform: {named}; the keys are {', '.join(AXES)}")
        t, z, y, x = (_axis(key, values[key]) for key in AXES)
        return cls(axes=(t, z, y, x))


def _axis(key: str, value: Any) -> AxisTransform:
    try:
        return AxisTransform.from_json(value)
    except InputError as error:
        raise InputError(f"transform, key {key!r}: {error}") from error
