"""Products of the lines of a tile along an axis, from which the data's own bases are made.

They are computed by native code (fhash_codec/native/gram.cpp), which adds line after line. A
library for matrices would add in an order of its own, by threads of its own beside those that work
on tiles.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_formats.transform.entropy.coder import checked

__all__ = ["Gram", "gram_of"]

Gram = npt.NDArray[np.float64]
"""Products of lines (length, length)."""


def gram_of(planes: npt.NDArray[Any], center: float) -> Gram:
    """Return the sum of v v^T over the lines v along the middle axis of planes.

    planes: values (before, length, after) of any real type. Each counts less the centre, and as 0
        where that is not finite.
    """
    if planes.dtype not in (np.float32, np.float64):
        planes = planes.astype(np.float64)
    planes = np.ascontiguousarray(planes)
    before, length, after = planes.shape
    sums: Gram = np.empty((length, length))
    function = getattr(native.library(), f"fhash_gram_f{planes.itemsize * 8}")
    places = ctypes.c_void_p(planes.ctypes.data), ctypes.c_void_p(sums.ctypes.data)
    checked(function(places[0], before, length, after, center, places[1]))
    return sums
