"""Integers of a tile to bytes and back by prediction (native/predict.cpp).

Under a tight bound on the error this is smaller than a transform: each
value becomes the nearest `origin + step * integer`, with a step of nearly twice the bound, and the
integers are coded without loss. predictor.py says which vertices predict which. The coder begins
without a prior: at such a bound a tile holds enough to learn from.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.entropy.coder import array_arguments, checked, state_arguments
from fhash_formats.transform.entropy.predictor import CLASSES, Predictor, pass_arrays
from fhash_formats.transform.entropy.prior import State
from fhash_formats.transform.values.elementwise import pieces

__all__ = [
    "MAX_PREDICTED_INTEGER",
    "decode_predicted",
    "encode_predicted",
    "integers_of",
    "values_of",
]

MAX_PREDICTED_INTEGER = 1 << 27
"""Largest magnitude of an integer that is coded by prediction."""
DECISIONS = 16
"""Decisions of a difference, each with estimates and weights of its own."""
LANES = 14
"""Weights of a set."""
LEVELS = 48
"""Levels of the expected difference; each has a set of weights per decision."""
SIZES = (LEVELS * 5, 32 * 27, CLASSES * 24 * 5, 3125, 81 * 5 * 8, 81 * 24, 32 * 24 * 5)
"""Contexts of each of the seven estimates that are mixed; each context has a slot per decision."""
SIMPLES = 200
"""Simple estimates: of low bits, of the escape code and of rows without a difference."""

Integers = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]
Values = npt.NDArray[Any]


@cache
def blank_state() -> State:
    """A state that has learned nothing: even odds, and weights that believe the estimates.

    The arrays are read-only.
    """
    weights = [(CLASSES * DECISIONS * LANES, 4096), (LEVELS * DECISIONS * LANES, 0)]
    return State.even(slots=sum(SIZES) * DECISIONS, weights=weights, simples=SIMPLES).frozen()


def integers_of(values: Values, counted: Mask | None, predictor: Predictor) -> Integers | None:
    """The integers nearest to values, int32; None if one would exceed MAX_PREDICTED_INTEGER.

    Args:
        values: any shape and real type.
        counted: mask of the same shape; the other integers are 0. None counts all.
        predictor: origin and step.
    """
    result = np.empty(values.shape, np.int32)
    flat, out = values.reshape(-1), result.reshape(-1)
    flat_counted = None if counted is None else counted.reshape(-1)
    for piece in pieces(flat.size):
        with np.errstate(all="ignore"):
            # 64-bit whole numbers are subtracted as float64: near the ends of their range an error
            # may exceed the bound, which the encoder checks.
            nearest = np.rint((flat[piece].astype(np.float64) - predictor.origin) / predictor.step)
        if flat_counted is not None:
            nearest = np.where(flat_counted[piece], nearest, 0.0)
        if not np.all(np.abs(nearest) <= MAX_PREDICTED_INTEGER):
            return None
        out[piece] = nearest
    return result


def values_of(integers: Integers, predictor: Predictor) -> npt.NDArray[np.float64]:
    """The values origin + step * integer, float64: one product, one sum."""
    with np.errstate(all="ignore"):
        values = integers * np.float64(predictor.step)
        values += np.float64(predictor.origin)
    return values


def encode_predicted(
    integers: Integers, counted: Mask | None, predictor: Predictor
) -> tuple[bytes, Integers]:
    """Code integers: the bytes, and the integers that they decode to.

    Args:
        integers: (t, z, y, x), each within +-MAX_PREDICTED_INTEGER.
        counted: mask (bool, same shape) of the integers that must come back; the others become
            their predictions. None counts all.
        predictor: the passes and their weights.
    """
    marks = None if counted is None else np.ascontiguousarray(counted, dtype=np.uint8)
    capacity = max(4096, integers.size)
    while True:
        buffer = np.empty(capacity, dtype=np.uint8)
        result = np.array(integers, dtype=np.int32, order="C")
        size = native.library().fhash_encode_predicted(
            result.ctypes.data,
            None if marks is None else marks.ctypes.data,
            *_geometry(integers.shape, predictor),
            *state_arguments(blank_state()),
            *array_arguments(buffer),
        )
        if checked(size) <= capacity:
            return buffer[:size].tobytes(), result
        capacity = size


def decode_predicted(
    data: bytes | memoryview, shape: tuple[int, ...], predictor: Predictor
) -> Integers:
    """The integers (t, z, y, x) of a shape, int32.

    Raises DamagedFileError for bytes that no encoder writes, as far as the decoder can tell.
    """
    integers = np.zeros(shape, dtype=np.int32)
    source = np.frombuffer(data, dtype=np.uint8)
    code = native.library().fhash_decode_predicted(
        integers.ctypes.data,
        *_geometry(shape, predictor),
        *state_arguments(blank_state()),
        *array_arguments(source),
    )
    if checked(code) < 0:
        raise DamagedFileError("the predicted integers of a tile are damaged")
    return integers


def _geometry(shape: tuple[int, ...], predictor: Predictor) -> list[Any]:
    """Shape, levels, passes, taps and weights as the native functions take them.

    The pointers keep their arrays alive.
    """
    passes, taps, weights = pass_arrays(predictor)
    four = ctypes.c_int64 * 4
    return [
        four(*shape),
        four(*predictor.levels),
        *array_arguments(passes),
        taps.ctypes.data_as(ctypes.c_void_p),
        weights.ctypes.data_as(ctypes.c_void_p),
    ]
