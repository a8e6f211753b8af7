"""Integers of a tile to bytes and back by prediction (native/predict.cpp), native or portable with the same bytes.

Under a tight bound this is smaller than a transform: each value becomes the nearest of `origin + step * integer`, step being nearly twice
the bound, so that all errors within it are used alike, and the integers are coded without loss. See predictor.py for what is predicted
from what. The coder begins from nothing: at such a bound there is enough in a tile to learn from.
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
    "LARGEST",
    "decode_predicted",
    "encode_predicted",
    "integers_of",
    "values_of",
]

LARGEST = 1 << 27
"""Largest magnitude of an integer."""
DECISIONS, LANES, LEVELS = 16, 14, 48
SIZES = (LEVELS * 5, 32 * 27, CLASSES * 24 * 5, 3125, 81 * 5 * 8, 81 * 24, 32 * 24 * 5)
"""Contexts, for each of the seven estimates that are mixed; each has a slot per decision."""
SIMPLES = 200

Integers = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]
Values = npt.NDArray[Any]


@cache
def _blank() -> State:
    """Nothing known: even odds, and weights that take the estimates at their word. The arrays are read-only."""
    weights = [(CLASSES * DECISIONS * LANES, 4096), (LEVELS * DECISIONS * LANES, 0)]
    return State.even(slots=sum(SIZES) * DECISIONS, weights=weights, simples=SIMPLES).frozen()


def integers_of(values: Values, counts: Mask | None, predictor: Predictor) -> Integers | None:
    """The integers nearest to values of any real type, 0 where they do not count; None where one would be too large."""
    result = np.empty(values.shape, np.int32)
    flat, marks, out = (
        values.reshape(-1),
        None if counts is None else counts.reshape(-1),
        result.reshape(-1),
    )
    for piece in pieces(flat.size):
        with np.errstate(all="ignore"):
            # Whole numbers of 64 bits are subtracted as float64: near the ends a bound may be missed, which the encoder sees.
            whole = np.rint((flat[piece].astype(np.float64) - predictor.origin) / predictor.step)
        if marks is not None:
            whole = np.where(marks[piece], whole, 0.0)
        if not np.all(np.abs(whole) <= LARGEST):
            return None
        out[piece] = whole
    return result


def values_of(integers: Integers, predictor: Predictor) -> npt.NDArray[np.float64]:
    """origin + step * integer, in float64: one product, one sum."""
    with np.errstate(all="ignore"):
        values = integers * np.float64(predictor.step)
        values += np.float64(predictor.origin)
    return values


def encode_predicted(
    integers: Integers, care: Mask | None, predictor: Predictor
) -> tuple[bytes, Integers]:
    """Code integers (t, z, y, x), each within +-LARGEST: the bytes, and the integers that they decode to.

    care: what must come back as it is (bool, same shape; None is all); the rest becomes what is predicted for it.
    """
    library = native.library()
    if library is None:
        from fhash_formats.transform.entropy import predict_portable

        return predict_portable.encode(integers, care, predictor, _blank().copy())
    marks = None if care is None else np.ascontiguousarray(care, dtype=np.uint8)
    capacity = max(4096, integers.size)
    while True:
        buffer = np.empty(capacity, dtype=np.uint8)
        result = np.array(integers, dtype=np.int32, order="C")
        size = library.fhash_encode_predicted(
            ctypes.c_void_p(result.ctypes.data),
            ctypes.c_void_p(None if marks is None else marks.ctypes.data),
            *_geometry(integers.shape, predictor),
            *state_arguments(_blank()),
            *array_arguments(buffer, capacity),
        )
        if checked(size) <= capacity:
            return buffer[:size].tobytes(), result
        capacity = size


def decode_predicted(
    data: bytes | memoryview, shape: tuple[int, ...], predictor: Predictor
) -> Integers:
    """The integers (t, z, y, x) of a shape; raises DamagedFileError for bytes that no encoder writes, as far as that shows."""
    library = native.library()
    if library is None:
        from fhash_formats.transform.entropy import predict_portable

        return predict_portable.decode(bytes(data), shape, predictor, _blank().copy())
    integers = np.zeros(shape, dtype=np.int32)
    source = np.frombuffer(data, dtype=np.uint8)
    code = library.fhash_decode_predicted(
        ctypes.c_void_p(integers.ctypes.data),
        *_geometry(shape, predictor),
        *state_arguments(_blank()),
        *array_arguments(source, source.size),
    )
    if checked(code) < 0:
        raise DamagedFileError("the predicted integers of a tile are damaged")
    return integers


def _geometry(shape: tuple[int, ...], predictor: Predictor) -> list[Any]:
    """Shape, levels, passes, taps and weights as the native functions take them; they keep their arrays alive."""
    passes, taps, weights = pass_arrays(predictor)
    four = ctypes.c_int64 * 4
    return [
        four(*shape),
        four(*predictor.levels),
        passes.ctypes.data_as(ctypes.POINTER(ctypes.c_int32)),
        ctypes.c_int64(len(passes)),
        taps.ctypes.data_as(ctypes.POINTER(ctypes.c_int32)),
        weights.ctypes.data_as(ctypes.POINTER(ctypes.c_int16)),
    ]
