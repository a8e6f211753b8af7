"""Labels to bytes and back by an adaptive coder (native/labels.cpp).

Labels are numbers of a palette without an order: those of a region are
equal, and a border between two regions seldom shows a third one. The coder predicts each label from
those around the vertex that are already coded. It begins without a prior.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.transform.entropy.coder import array_arguments, checked, state_arguments
from fhash_formats.transform.entropy.prior import State

__all__ = ["MAX_LABELS", "blank_label_state", "decode_labels", "encode_labels"]

MAX_LABELS = 65536
"""Most labels of a tile."""
MAX_NARROW = 256
"""Most labels that are uint8; more of them are coded with another state, as uint16."""
LANES = 16
"""Weights of a set."""
CANDIDATE_SLOTS = 3072 + 6144 + 6144 + 8192 + 65536 + 1008 + 2 * 12288
"""Estimates that are mixed, of decisions about candidates."""
BIT_SLOTS = 256 + 3 * 16384
"""Estimates that are mixed, of bits of at most MAX_NARROW labels."""
WIDE_BIT_SLOTS = 4 * 65536
"""Estimates that are mixed, of bits of more labels."""
CANDIDATE_SETS = 3 * 16 + 3 * 4
"""Sets of weights of decisions about candidates."""
SIMPLES = 10
"""Simple estimates, those of the flags of segments; more labels have one more."""

Labels = npt.NDArray[Any]
"""Labels of type uint8, or uint16 where there are more than MAX_NARROW."""


@cache
def blank_label_state(wide: bool = False) -> State:
    """A state that has learned nothing: even odds, and weights that believe the estimates.

    wide: the state for more than MAX_NARROW labels. The arrays are read-only.
    """
    near, found, levels, tested = 3 * 16, 3 * 4, 16 if wide else 8, 4
    weights = [
        (near * LANES, 3072),
        (found * LANES, 0),
        (levels * LANES, 4096),
        (tested * LANES, 0),
    ]
    slots = CANDIDATE_SLOTS + (WIDE_BIT_SLOTS if wide else BIT_SLOTS)
    return State.even(slots=slots, weights=weights, simples=SIMPLES + wide).frozen()


def encode_labels(labels: Labels, count: int) -> bytes:
    """Code labels (t, z, y, x), each below `count`, of which there are 1 to MAX_LABELS."""
    wide = count > MAX_NARROW
    state = blank_label_state(wide)
    library = native.library()
    encode = library.fhash_encode_wide_labels if wide else library.fhash_encode_labels
    # The coder writes to its labels, also in encoding, but does not change them.
    work = np.array(labels, dtype=np.uint16 if wide else np.uint8, order="C")
    capacity = max(4096, labels.size // 8)
    while True:
        buffer = np.empty(capacity, dtype=np.uint8)
        size = encode(
            work.ctypes.data,
            count,
            (ctypes.c_int64 * 4)(*labels.shape),
            *state_arguments(state),
            *array_arguments(buffer),
        )
        if checked(size) <= capacity:
            return buffer[:size].tobytes()
        capacity = size


def decode_labels(data: bytes | memoryview, count: int, shape: tuple[int, ...]) -> Labels:
    """The labels of a shape (t, z, y, x) that `encode_labels` coded.

    They are uint8, or uint16 where there are more than MAX_NARROW. Any other bytes give some labels
    below `count`: the caller must check a digest.
    """
    wide = count > MAX_NARROW
    state = blank_label_state(wide)
    library = native.library()
    decode = library.fhash_decode_wide_labels if wide else library.fhash_decode_labels
    labels = np.zeros(shape, dtype=np.uint16 if wide else np.uint8)
    source = np.frombuffer(data, dtype=np.uint8)
    code = decode(
        labels.ctypes.data,
        count,
        (ctypes.c_int64 * 4)(*shape),
        *state_arguments(state),
        *array_arguments(source),
    )
    checked(code)
    return labels
