"""Integers to bytes and back by the adaptive coder, native/coder.cpp.

The coder adapts while it works. It begins from a *prior*: estimates and mixing weights that were
learned from other series (prior.py), so that small tiles need not learn from nothing. The prior is
part of the format.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.entropy.prior import State, prior_state
from fhash_formats.transform.entropy.table import Table, single_band

__all__ = [
    "MAX_INTEGER",
    "Encoded",
    "array_arguments",
    "checked",
    "decode_block",
    "decode_integers",
    "encode_block",
    "encode_integers",
    "state_arguments",
]

MAX_INTEGER = 2**30 - 1
"""Largest magnitude of an integer."""

NO_MEMORY = -2
"""Code that a native function returns where it had no memory; twin of `NO_MEMORY` in guard.hpp."""

NO_TRELLIS = -3
"""Code of an encoder that met an integer which its quantiser does not have, as in
native/coder_contexts.hpp."""

Integers = npt.NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """Coded integers.

    Attributes:
        data: the bytes.
        integers: what the bytes decode to; other than the integers given where the rate-distortion
            optimisation changed some.
    """

    data: bytes
    integers: Integers


def encode_integers(
    integers: Integers,
    table: Table,
    *,
    scaled: npt.NDArray[np.float32] | None = None,
    weight: float = 0.0,
    state: State | None = None,
    trellis: bool = False,
) -> Encoded:
    """Code integers in the bands of a table; integers outside the bands count as 0.

    Args:
        integers: int32 (t, z, y, x), magnitudes up to MAX_INTEGER.
        table: the bands.
        scaled: coefficients / quantiser step, float32, same shape. With it each magnitude is chosen
            anew, from the nearest one, one less and zero: the one with the least squared error, in
            steps, plus `weight` per bit.
        weight: squared steps that a bit is worth.
        state: state to begin from, which is adapted in place; None begins from the prior.
        trellis: whether the integers are those of two quantisers (trellis.py). Raises InputError
            for integers that are not, and does not go with `scaled`.
    """
    if trellis and scaled is not None:
        raise InputError("integers of a trellis are chosen before they are coded")
    keep = state is not None
    state = prior_state(trellis) if state is None else state
    given = np.ascontiguousarray(integers, dtype=np.int32)
    chosen = None if scaled is None else np.ascontiguousarray(scaled, dtype=np.float32)
    capacity = max(4096, given.size // 2)
    while True:
        buffer = np.empty(capacity, dtype=np.uint8)
        # The native coder writes to its integers only where it chooses them.
        integers = given if chosen is None else given.copy()
        size = native.library().fhash_encode(
            _pointer(integers),
            _pointer(chosen),
            weight,
            trellis,
            (ctypes.c_int64 * 4)(*integers.shape),
            *array_arguments(table),
            *state_arguments(state),
            keep,
            *array_arguments(buffer),
        )
        if size == NO_TRELLIS:
            raise InputError("an integer is not one of the quantiser whose turn it is")
        if checked(size) <= capacity:
            return Encoded(data=buffer[:size].tobytes(), integers=integers)
        # Retry with the original integers. Coding the chosen ones would give other bytes, because
        # rows that became empty are signalled differently.
        capacity = size


def decode_integers(
    data: bytes | memoryview,
    shape: tuple[int, ...],
    table: Table,
    *,
    trellis: bool = False,
) -> Integers:
    """The integers (t, z, y, x) of a shape, int32; `trellis` as for the encoder.

    Raises DamagedFileError for bytes that no encoder writes, as far as the decoder can tell.
    """
    integers = np.zeros(shape, dtype=np.int32)
    source = np.frombuffer(data, dtype=np.uint8)
    code = native.library().fhash_decode(
        _pointer(integers),
        trellis,
        (ctypes.c_int64 * 4)(*shape),
        *array_arguments(table),
        *state_arguments(prior_state(trellis)),
        *array_arguments(source),
    )
    if checked(code) < 0:
        raise DamagedFileError("the coded integers are damaged")
    return integers


def encode_block(integers: Integers) -> bytes:
    """Code a small block of int32 integers (four axes) that stands alone."""
    return encode_integers(integers, single_band(integers.shape)).data if integers.size else b""


def decode_block(data: bytes | memoryview, shape: tuple[int, ...]) -> Integers:
    """The block that `encode_block` coded; raises DamagedFileError as `decode_integers` does."""
    if prod(shape) == 0:
        if len(data):
            raise DamagedFileError("bytes where nothing is coded")
        return np.zeros(shape, dtype=np.int32)
    return decode_integers(data, shape, single_band(shape))


def checked(code: int) -> int:
    """The code that a native function returned; raises MemoryError where it is NO_MEMORY."""
    if code == NO_MEMORY:
        raise MemoryError("no memory for the work of a native function")
    return code


def _pointer(array: npt.NDArray[Any] | None) -> ctypes.c_void_p:
    # The pointer object also keeps the array alive. When threads build the prior at the same time,
    # only one of their copies is cached, and nothing else refers to the others.
    return ctypes.c_void_p(None) if array is None else array.ctypes.data_as(ctypes.c_void_p)


def array_arguments(array: npt.NDArray[Any]) -> tuple[ctypes.c_void_p, int]:
    """An array and its length along the first axis, as the native functions take them."""
    return _pointer(array), len(array)


def state_arguments(state: State) -> list[Any]:
    """The arrays of a state, each with its length, as the native functions take them."""
    return [
        *array_arguments(state.slots),
        *array_arguments(state.weights),
        *array_arguments(state.simples),
    ]
