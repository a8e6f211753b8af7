"""Integers to bytes and back by the adaptive coder (native/coder.cpp), native or portable with the same bytes.

The coder adapts while it works. It begins from a *prior*: estimates and mixing weights that were learned from other series (prior.py), so
that small tiles need not learn from nothing. The prior is part of the format.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import DamagedFileError
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
"""Largest magnitude that is coded."""

Integers = npt.NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """data: the bytes. integers: what they decode to, which rate-distortion optimisation may have changed."""

    data: bytes
    integers: Integers


def encode_integers(
    integers: Integers,
    table: Table,
    *,
    scaled: npt.NDArray[np.float32] | None = None,
    weight: float = 0.0,
    state: State | None = None,
) -> Encoded:
    """Code int32 integers (t, z, y, x) in the bands of a table; all outside the bands count as 0.

    scaled: coefficients / step, float32: then each magnitude is chosen anew among the nearest, one less and zero, by squared error in
    steps plus `weight` per bit. state: to begin from and to leave behind, instead of the prior.
    """
    kept = state is not None
    state = prior_state() if state is None else state
    given = np.ascontiguousarray(integers, dtype=np.int32)
    library = native.library()
    if library is None:
        from fhash_formats.transform.entropy import coder_portable

        integers = given.copy()
        data = coder_portable.encode(
            integers, table, scaled, weight, state.copy() if not kept else state
        )
        return Encoded(data=data, integers=integers)
    chosen = None if scaled is None else np.ascontiguousarray(scaled, dtype=np.float32)
    capacity = max(4096, given.size // 2)
    while True:
        buffer = np.empty(capacity, dtype=np.uint8)
        integers = given if chosen is None else given.copy()  # only chosen integers are written
        size = library.fhash_encode(
            _pointer(integers),
            _pointer(chosen),
            ctypes.c_double(weight),
            (ctypes.c_int64 * 4)(*integers.shape),
            *array_arguments(table, table.shape[0]),
            *state_arguments(state),
            ctypes.c_int64(kept),
            *array_arguments(buffer, capacity),
        )
        if checked(size) <= capacity:
            return Encoded(data=buffer[:size].tobytes(), integers=integers)
        # Once more with the same integers: those chosen would be coded otherwise, as rows that became empty are told apart.
        capacity = size


def decode_integers(data: bytes | memoryview, shape: tuple[int, ...], table: Table) -> Integers:
    """The integers (t, z, y, x) of a shape; raises DamagedFileError for bytes that no encoder writes, as far as that shows."""
    integers = np.zeros(shape, dtype=np.int32)
    library = native.library()
    if library is None:
        from fhash_formats.transform.entropy import coder_portable

        coder_portable.decode(integers, table, bytes(data), prior_state().copy())
        return integers
    source = np.frombuffer(data, dtype=np.uint8)
    code = library.fhash_decode(
        _pointer(integers),
        (ctypes.c_int64 * 4)(*shape),
        *array_arguments(table, table.shape[0]),
        *state_arguments(prior_state()),
        *array_arguments(source, source.size),
    )
    if checked(code) < 0:
        raise DamagedFileError("the coded integers are damaged")
    return integers


def encode_block(integers: Integers) -> bytes:
    """Code a small block of int32 integers (four axes) that stands alone."""
    return encode_integers(integers, single_band(integers.shape)).data if integers.size else b""


def decode_block(data: bytes | memoryview, shape: tuple[int, ...]) -> Integers:
    """What `encode_block` coded; raises DamagedFileError for any other bytes."""
    if prod(shape) == 0:
        if len(data):
            raise DamagedFileError("bytes where nothing is coded")
        return np.zeros(shape, dtype=np.int32)
    integers = decode_integers(data, shape, single_band(shape))
    # Small blocks carry no digest: they must be what the encoder would write.
    if np.abs(integers.astype(np.int64)).max(initial=0) > MAX_INTEGER or encode_block(
        integers
    ) != bytes(data):
        raise DamagedFileError("the coded integers are damaged")
    return integers


def checked(code: int) -> int:
    """What a native function returned; raises MemoryError where that is that it had no memory."""
    if code == -2:
        raise MemoryError("no memory for the work of a native function")
    return code


def _pointer(array: npt.NDArray[Any] | None) -> ctypes.c_void_p:
    # It holds the array, too: threads that make a state at once get one each, and of all but one nothing else would.
    return ctypes.c_void_p(None) if array is None else array.ctypes.data_as(ctypes.c_void_p)


def array_arguments(array: npt.NDArray[Any], count: int) -> tuple[ctypes.c_void_p, ctypes.c_int64]:
    """An array and its length as the native functions take them."""
    return _pointer(array), ctypes.c_int64(count)


def state_arguments(state: State) -> list[Any]:
    """The arrays of a state as the native functions take them."""
    return [
        part
        for array in (state.slots, state.weights, state.simples)
        for part in array_arguments(array, array.shape[0])
    ]
