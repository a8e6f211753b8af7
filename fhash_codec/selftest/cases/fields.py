"""Small fields that cases are made from, and series of them. Axes (t, z, y, x)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fhash_formats.series import AXIS_NAMES, ArraySeries, Coordinate

__all__ = ["SHAPE", "lattice", "noise", "series", "waves"]

Four = tuple[int, int, int, int]
Floats = npt.NDArray[np.float64]

SHAPE: Four = (4, 9, 10, 11)
"""Of most cases: 3,960 values, no length a power of two but that of time."""


def lattice(shape: Four = SHAPE) -> tuple[Floats, Floats, Floats, Floats]:
    """The indices t, z, y and x of every vertex."""
    t, z, y, x = np.meshgrid(*(np.arange(float(n)) for n in shape), indexing="ij")
    return t, z, y, x


def waves(shape: Four = SHAPE) -> Floats:
    """A smooth moving field with values in 0..1, both ends among them where the shape has more than one value."""
    t, z, y, x = (part / max(n - 1, 1) for part, n in zip(lattice(shape), shape, strict=True))
    values = np.sin(5 * x + 3 * t) * np.cos(4 * y) + z
    low, high = values.min(), values.max()
    return np.asarray((values - low) / (high - low if high > low else 1.0))


def noise(shape: Four = SHAPE, seed: int = 0) -> Floats:
    """White noise, normal with deviation 1."""
    return np.random.default_rng(seed).standard_normal(shape)


def series(
    values: npt.NDArray[np.generic],
    *,
    times: Sequence[float] | npt.NDArray[np.float64] | None = None,
    units: str = "1",
    **axes: Floats,
) -> ArraySeries:
    """A series in memory. times: of its steps. axes: positions along z, y or x; those left out are 0, 1, 2, ..."""
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
