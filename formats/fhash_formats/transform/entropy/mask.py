"""Masks to bytes and back by an adaptive coder (native/mask.cpp).

A mask says which vertices of a tile are occupied. Its coder predicts
each bit from the bits around the vertex that are already coded, and from the levels of the vertex
and its neighbours (mask_levels.py), which tell how likely the vertex is occupied. It begins from a
prior (`mask_prior.bin`) that was learned from other series. Like the prior of the coefficients, it
is part of the format.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.transform.entropy.coder import array_arguments, checked, state_arguments
from fhash_formats.transform.entropy.mask_levels import Levels
from fhash_formats.transform.entropy.prior import State, unpack_state

__all__ = ["blank_mask_state", "decode_mask", "encode_mask", "mask_prior_state"]

Mask = npt.NDArray[np.bool_]

LEVELS = 32
"""Levels of a vertex; each has a set of mixing weights."""
CONTEXTS = 10
"""Estimates that are mixed for a bit."""
NEAR = 16
"""Patterns of the four nearest bits; each has a set of mixing weights."""
SIZES = (512, 1024, 4096, 2048, 2048, 1920, 2592, 4096, 4096, 2048)
"""Contexts of each estimate."""
LANES = 2 * CONTEXTS
"""Weights of a set."""
SIMPLES = 30
"""Simple estimates, those of the flags of segments: by the state around, the levels, and the number
of segments around."""

_FILE = Path(__file__).with_name("mask_prior.bin")


def blank_mask_state() -> State:
    """A state that has learned nothing: even odds, and weights that believe the estimates."""
    return State.even(
        slots=sum(SIZES), weights=[(LEVELS * LANES, 3277), (NEAR * LANES, 0)], simples=SIMPLES
    )


@cache
def mask_prior_state() -> State:
    """The prior of masks; its arrays are read-only."""
    return unpack_state(_FILE.read_bytes(), blank_mask_state()).frozen()


def encode_mask(mask: Mask, levels: tuple[Levels, Levels], *, state: State | None = None) -> bytes:
    """Code a mask.

    Args:
        mask: bool (t, z, y, x), at least one vertex.
        levels: two levels of each vertex, 0 to 31 and 0 to 15, uint8, from `MaskLevels.levels`.
        state: state to begin from, which is adapted in place; None begins from the prior.
    """
    keep = state is not None
    state = mask_prior_state() if state is None else state
    bits, first, second = (np.ascontiguousarray(array, dtype=np.uint8) for array in (mask, *levels))
    capacity = max(4096, mask.size // 8)
    while True:
        buffer = np.empty(capacity, dtype=np.uint8)
        size = native.library().fhash_encode_mask(
            *(array.ctypes.data for array in (bits, first, second)),
            (ctypes.c_int64 * 4)(*mask.shape),
            *state_arguments(state),
            keep,
            *array_arguments(buffer),
        )
        if checked(size) <= capacity:
            return buffer[:size].tobytes()
        capacity = size


def decode_mask(data: bytes | memoryview, levels: tuple[Levels, Levels]) -> Mask:
    """The mask, bool (t, z, y, x), that `encode_mask` coded with the same levels.

    Any other bytes give some mask: the caller must check a digest.
    """
    shape = levels[0].shape
    mask = np.empty(shape, dtype=np.uint8)
    first, second = (np.ascontiguousarray(array, dtype=np.uint8) for array in levels)
    source = np.frombuffer(data, dtype=np.uint8)
    code = native.library().fhash_decode_mask(
        *(array.ctypes.data for array in (mask, first, second)),
        (ctypes.c_int64 * 4)(*shape),
        *state_arguments(mask_prior_state()),
        *array_arguments(source),
    )
    checked(code)
    return mask.view(np.bool_)
