"""Table of bands that the coder takes; native/coder_contexts.hpp names the same columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

__all__ = [
    "BAND",
    "COLUMNS",
    "HIGH",
    "KIND",
    "LOW",
    "NO_REFERENCE",
    "REFERENCES",
    "REFERENCE_COLUMNS",
    "REFERENCE_COUNT",
    "SHIFT",
    "Table",
    "single_band",
]

Table = npt.NDArray[np.int32]
"""Bands in the order in which they are coded, int32 of shape (bands, COLUMNS)."""

LOW = 0
"""First of four columns: the lowest index of the band along t, z, y, x."""
HIGH = 4
"""First of four columns: one past the highest index of the band along t, z, y, x."""
KIND = 8
"""Column of the kind, 0 to 63; bands of one kind share their statistics."""
REFERENCES = 9
"""First column of the references: the earlier bands from which a band takes contexts."""
REFERENCE_COUNT = 4
"""References of a band: its parent, the bands before it along t and along z, and its sibling."""
REFERENCE_COLUMNS = 5
"""Columns of one reference: BAND, then SHIFT along t, z, y, x."""
BAND = 0
"""Column within a reference: number of the band referred to, or -1 for no band."""
SHIFT = 1
"""First of four columns within a reference: halvings between the two bands along t, z, y, x."""
COLUMNS = REFERENCES + REFERENCE_COUNT * REFERENCE_COLUMNS
"""Columns of the table."""

NO_REFERENCE = [-1, 0, 0, 0, 0]
"""Columns of a reference to no band."""


def single_band(shape: Sequence[int]) -> Table:
    """The table of integers (t, z, y, x) that were not transformed: one band of kind 0."""
    row = [0, 0, 0, 0, *shape, 0, *NO_REFERENCE * REFERENCE_COUNT]
    return np.array([row], dtype=np.int32)
