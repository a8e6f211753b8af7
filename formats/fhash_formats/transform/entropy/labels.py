"""Labels to bytes and back by an adaptive coder, native (native/labels.cpp) or portable.

Both write the same bytes. Labels are numbers of a palette without an order: those of a region are
equal, and a border between two regions seldom shows a third one. The coder predicts each label from
those around the vertex that are already coded. It begins without a prior.
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.transform.entropy.coder import array_arguments, checked, state_arguments
from fhash_formats.transform.entropy.prior import State

__all__ = ["MAX_LABELS", "blank_label_state", "decode_labels", "encode_labels"]

MAX_LABELS = 256
"""Most labels of a tile."""
LANES = 16
"""Weights of a set."""
SLOTS = 3072 + 6144 + 6144 + 8192 + 65536 + 1008 + 2 * 12288 + 256 + 3 * 16384
"""Estimates that are mixed, of decisions about candidates and of bits."""
CANDIDATE_SETS = 3 * 16 + 3 * 4
"""Sets of weights of decisions about candidates."""
BIT_SETS = 8 + 4
"""Sets of weights of bits."""
SIMPLES = 10
"""Simple estimates, those of the flags of segments."""

Labels = npt.NDArray[np.uint8]


@cache
def blank_label_state() -> State:
    """A state that has learned nothing: even odds, and weights that believe the estimates.

    The arrays are read-only.
    """
    near, found, levels, tested = 3 * 16, 3 * 4, 8, 4
    weights = [
        (near * LANES, 3072),
        (found * LANES, 0),
        (levels * LANES, 4096),
        (tested * LANES, 0),
    ]
    return State.even(slots=SLOTS, weights=weights, simples=SIMPLES).frozen()


def encode_labels(labels: Labels, count: int) -> bytes:
    """Code labels (t, z, y, x), uint8, each below `count`, of which there are 1 to MAX_LABELS."""
    library = native.library()
    if library is None:
        from fhash_formats.transform.entropy import labels_portable

        return labels_portable.encode(labels, count, blank_label_state().copy())
    source = np.ascontiguousarray(labels, dtype=np.uint8)
    capacity = max(4096, labels.size // 8)
    while True:
        # The coder writes to its labels, also in encoding.
        work, buffer = source.copy(), np.empty(capacity, dtype=np.uint8)
        size = library.fhash_encode_labels(
            work.ctypes.data,
            count,
            (ctypes.c_int64 * 4)(*labels.shape),
            *state_arguments(blank_label_state()),
            *array_arguments(buffer),
        )
        if checked(size) <= capacity:
            return buffer[:size].tobytes()
        capacity = size


def decode_labels(data: bytes | memoryview, count: int, shape: tuple[int, ...]) -> Labels:
    """The labels of a shape (t, z, y, x), uint8, that `encode_labels` coded.

    Any other bytes give some labels below `count`: the caller must check a digest.
    """
    library = native.library()
    if library is None:
        from fhash_formats.transform.entropy import labels_portable

        return labels_portable.decode(bytes(data), count, shape, blank_label_state().copy())
    labels = np.zeros(shape, dtype=np.uint8)
    source = np.frombuffer(data, dtype=np.uint8)
    code = library.fhash_decode_labels(
        labels.ctypes.data,
        count,
        (ctypes.c_int64 * 4)(*shape),
        *state_arguments(blank_label_state()),
        *array_arguments(source),
    )
    checked(code)
    return labels
