"""Integers of two quantisers, made from any indices: what the encoder's search would give."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fhash_formats.transform.coder import Table

NEXT = np.array([[0, 2], [5, 7], [1, 3], [6, 4], [2, 0], [4, 6], [3, 1], [7, 5]])
"""FORMAT.md, Two quantisers."""


def of_two_quantisers(indices: NDArray[np.int32], table: Table) -> NDArray[np.int32]:
    """The integers whose indices these are, in the bands of a table; 0 elsewhere."""
    result, state = np.zeros_like(indices), 0
    for row in table:
        box = tuple(slice(int(low), int(high)) for low, high in zip(row[:4], row[4:8], strict=True))
        band = indices[box]
        values = np.empty(band.size, np.int32)
        for at, k in enumerate(band.ravel().tolist()):
            values[at] = np.sign(k) * (2 * abs(k) - (state & 1))
            state = NEXT[state, k & 1]
        result[box] = values.reshape(band.shape)
    return result
