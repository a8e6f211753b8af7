"""The table of bands that the coder takes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Table = npt.NDArray[np.int32]
"""(bands, COLUMNS): low[4], high[4], kind, then four times (band or -1, shift[4]); a shift is the number of halvings in between."""


COLUMNS = 29


_NONE = [-1, 0, 0, 0, 0]


def single_band(shape: Sequence[int]) -> Table:
    """The table of integers that were not transformed."""
    return np.array([[0, 0, 0, 0, *shape, 0, *_NONE * 4]], dtype=np.int32)
