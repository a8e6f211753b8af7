"""Masks to bytes and back by an adaptive coder (native/mask.cpp), native or portable with the same bytes.

A mask says which vertices of a tile are occupied. Its coder looks at the bits around a vertex that are known already, and at the levels of
the vertex and its neighbours (mask_levels.py), which tell how likely it is. It begins from a prior (`mask_prior.bin`), learned from other
series than those that are coded, which is part of the format as that of the coefficients is.
"""

from __future__ import annotations

import ctypes
import zlib
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.transform.entropy.coder import array_arguments, checked, state_arguments
from fhash_formats.transform.entropy.mask_levels import Levels
from fhash_formats.transform.entropy.prior import State, pack_state, unpack_state

__all__ = ["blank_mask_state", "decode_mask", "encode_mask", "mask_prior_state", "pack_mask_prior"]

Mask = npt.NDArray[np.bool_]

LEVELS, CONTEXTS, NEAR = 32, 10, 16
SIZES = (512, 1024, 4096, 2048, 2048, 1920, 2592, 4096, 4096, 2048)
"""Contexts of a bit, for each of the ten estimates that are mixed."""
LANES = 2 * CONTEXTS
SIMPLES = 30
"""Flags of segments: by the state around, by the levels, by how many segments are around."""

_FILE = Path(__file__).with_name("mask_prior.bin")


def blank_mask_state() -> State:
    """Nothing known: even odds, and weights that take the estimates at their word."""
    return State.even(
        slots=sum(SIZES), weights=[(LEVELS * LANES, 3277), (NEAR * LANES, 0)], simples=SIMPLES
    )


@cache
def mask_prior_state() -> State:
    """The prior; its arrays are read-only."""
    return unpack_state(zlib.decompress(_FILE.read_bytes()), blank_mask_state()).frozen()


def pack_mask_prior(state: State) -> bytes:
    """A learned state as the bytes of `mask_prior.bin`."""
    return zlib.compress(pack_state(state), 9)


def encode_mask(mask: Mask, levels: tuple[Levels, Levels], *, state: State | None = None) -> bytes:
    """Code a mask (t, z, y, x), bool, at least one vertex. levels: 0 to 31 and 0 to 15 of each vertex, from `MaskLevels`, both uint8.

    state: to begin from and to leave behind, instead of the prior.
    """
    kept = state is not None
    state = mask_prior_state() if state is None else state
    library = native.library()
    if library is None:
        from fhash_formats.transform.entropy import mask_portable

        return mask_portable.encode(mask, levels, state if kept else state.copy())
    bits, first, second = (np.ascontiguousarray(part, dtype=np.uint8) for part in (mask, *levels))
    capacity = max(4096, mask.size // 8)
    while True:
        buffer = np.empty(capacity, dtype=np.uint8)
        size = library.fhash_encode_mask(
            *(ctypes.c_void_p(part.ctypes.data) for part in (bits, first, second)),
            (ctypes.c_int64 * 4)(*mask.shape),
            *state_arguments(state),
            ctypes.c_int64(kept),
            *array_arguments(buffer, capacity),
        )
        if checked(size) <= capacity:
            return buffer[:size].tobytes()
        capacity = size


def decode_mask(data: bytes | memoryview, levels: tuple[Levels, Levels]) -> Mask:
    """The mask (t, z, y, x) that `encode_mask` coded with the same levels. Any other bytes give some mask: a digest must tell."""
    shape = levels[0].shape
    library = native.library()
    if library is None:
        from fhash_formats.transform.entropy import mask_portable

        return mask_portable.decode(bytes(data), levels, mask_prior_state().copy())
    mask = np.empty(shape, dtype=np.uint8)
    first, second = (np.ascontiguousarray(part, dtype=np.uint8) for part in levels)
    source = np.frombuffer(data, dtype=np.uint8)
    code = library.fhash_decode_mask(
        *(ctypes.c_void_p(part.ctypes.data) for part in (mask, first, second)),
        (ctypes.c_int64 * 4)(*shape),
        *state_arguments(mask_prior_state()),
        *array_arguments(source, source.size),
    )
    checked(code)
    return mask.view(np.bool_)
