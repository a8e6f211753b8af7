"""Even spacing of the coordinates of an axis, which image formats need."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

# Of the axis's extent. Coordinates are often stored as float32, which is good to 6e-8 of their
# size: that must pass. And on an axis of a thousand vertices the largest deviation that passes is a
# thousandth of a cell, which no picture shows.
TOLERANCE = 1e-6


def even_spacing(values: npt.NDArray[np.float64]) -> float | None:
    """The step of evenly spaced coordinates (n,); None where they are uneven.

    The step is negative for descending coordinates and 1.0 for one vertex. Even means that no value
    is further than 1e-6 of the extent from the straight line between the first and the last.
    """
    if not np.all(np.isfinite(values)):
        return None
    if len(values) == 1:
        return 1.0
    extent = float(values[-1] - values[0])
    line = np.linspace(values[0], values[-1], len(values))
    if extent == 0 or np.max(np.abs(values - line)) > TOLERANCE * abs(extent):
        return None
    return extent / (len(values) - 1)
