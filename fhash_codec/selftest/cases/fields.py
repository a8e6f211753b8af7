"""Small fields from which cases are made, and series of them. All arrays are (t, z, y, x)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fhash_formats.series import AXIS_NAMES, ArraySeries, Coordinate

__all__ = ["SHAPE", "lattice", "noise", "series", "waves"]

Shape = tuple[int, int, int, int]
Floats = npt.NDArray[np.float64]

SHAPE: Shape = (4, 9, 10, 11)
"""Shape (t, z, y, x) of most cases: 3,960 values; only the number of steps is a power of two."""


def lattice(shape: Shape = SHAPE) -> tuple[Floats, Floats, Floats, Floats]:
    """The indices t, z, y and x of every vertex, each as an array of the given shape."""
    t, z, y, x = np.meshgrid(*(np.arange(float(n)) for n in shape), indexing="ij")
    return t, z, y, x


def waves(shape: Shape = SHAPE) -> Floats:
    """A smooth moving field with values in 0..1; 0 and 1 both occur unless the shape has one value
    only."""
    t, z, y, x = (index / max(n - 1, 1) for index, n in zip(lattice(shape), shape, strict=True))
    values = np.sin(5 * x + 3 * t) * np.cos(4 * y) + z
    low, high = values.min(), values.max()
    return np.asarray((values - low) / (high - low if high > low else 1.0))


def noise(shape: Shape = SHAPE, seed: int = 0) -> Floats:
    """White noise from a normal distribution with standard deviation 1."""
    return np.random.default_rng(seed).standard_normal(shape)


def series(
    values: npt.NDArray[np.generic],
    *,
    times: Sequence[float] | npt.NDArray[np.float64] | None = None,
    units: str = "1",
    **axes: Floats,
) -> ArraySeries:
    """A series in memory.

    Args:
        values: values (t, z, y, x).
        times: times of the steps in hours; without them the series has no times.
        units: unit of the values.
        axes: positions along z, y or x; an axis that is left out has the positions 0, 1, 2, ...
    """
    coords = {
        axis: Coordinate(name=AXIS_NAMES[axis], values=np.asarray(positions, dtype=np.float64))
        for axis, positions in axes.items()
    }
    if times is not None:
        coords["t"] = Coordinate(
            name="time",
            values=np.asarray(times, dtype=np.float64),
            attributes={"units": "hours since 2000-01-01"},
        )
    return ArraySeries(values, name="hard", units=units, coords=coords)
