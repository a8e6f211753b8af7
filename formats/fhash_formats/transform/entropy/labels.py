"""Labels to bytes and back by an adaptive coder (native/labels.cpp).

Labels are numbers of a palette without an order: those of a region are equal, and a border between
two regions seldom shows a third one. The coder predicts each label from those around the vertex
that are already coded. It begins without a prior.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.transform.entropy.coder import array_arguments, checked

__all__ = ["MAX_LABELS", "decode_labels", "encode_labels"]

MAX_LABELS = 65536
"""Most labels of a tile."""

Labels = npt.NDArray[np.uint16]


def encode_labels(labels: npt.NDArray[Any], count: int) -> bytes:
    """Code labels (t, z, y, x), each below `count`, of which there are 1 to MAX_LABELS."""
    # The coder writes to its labels, also in encoding, but does not change them.
    work = np.array(labels, dtype=np.uint16, order="C")
    capacity = max(4096, work.size // 8)
    while True:
        buffer = np.empty(capacity, dtype=np.uint8)
        size = native.library().fhash_encode_labels(
            work.ctypes.data,
            count,
            (ctypes.c_int64 * 4)(*work.shape),
            *array_arguments(buffer),
        )
        if checked(size) <= capacity:
            return buffer[:size].tobytes()
        capacity = size


def decode_labels(data: bytes | memoryview, count: int, shape: tuple[int, ...]) -> Labels:
    """The labels of a shape (t, z, y, x) that `encode_labels` coded.

    Any other bytes give some labels below `count`.
    """
    labels = np.zeros(shape, dtype=np.uint16)
    source = np.frombuffer(data, dtype=np.uint8)
    code = native.library().fhash_decode_labels(
        labels.ctypes.data, count, (ctypes.c_int64 * 4)(*shape), *array_arguments(source)
    )
    checked(code)
    return labels
