"""Generated series for `fhash bench rate`, `table` and `train`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.simulation.simulate import Simulation, simulate
from fhash_formats.errors import InputError, suggestion
from fhash_formats.series import ArraySeries, Coordinate
from fhash_formats.support.values import Single

PREFIX = "generated:"
"""Beginning of the name of a generated series where a file could stand."""

Grid = tuple[npt.NDArray[np.float64], ...]


def _grid(*shape: int) -> Grid:
    """Positions (t, z, y, x) of cell centres, each 0 to 1, broadcastable."""
    return np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij", sparse=True)


def _plateau(seed: int) -> tuple[Single, npt.NDArray[np.float64]]:
    """A blast: a plateau outside, a thin wavy shell, a hollow inside; 21 x 80^3.

    The first step is constant, and the times are uneven.
    """
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.0], np.sort(rng.uniform(0.02, 1.0, 20))])
    _, z, y, x = _grid(1, 80, 80, 80)
    middle = rng.uniform(0.4, 0.6, 3)
    rays = [(axis - at)[0] for axis, at in zip((z, y, x), middle, strict=True)]
    radius = np.sqrt(sum(ray**2 for ray in rays))
    ripples = np.zeros(radius.shape)
    for _ in range(12):
        kz, ky, kx, phase = rng.normal(0.0, 4.0, 4)
        ripples += np.cos((kz * rays[0] + ky * rays[1] + kx * rays[2]) / radius + phase)
    values = np.ones((times.size, 80, 80, 80), np.float32)
    for step, time in enumerate(times[1:], start=1):
        front = 0.45 * time**0.4 * (1 + 0.005 * time * ripples)
        depth = front - radius
        shell = 3.5 * np.exp(-depth / 0.036) * time**-0.1
        hollow = 0.08 + 0.3 * np.clip(radius / front, 0, 1) ** 4.5
        values[step] = np.where(depth > 0, hollow + shell, 1.0)
    return values, times


def _noise(seed: int) -> tuple[Single, npt.NDArray[np.float64]]:
    """White noise: nothing to predict; 10 x 24 x 40 x 40."""
    values = np.random.default_rng(seed).normal(size=(10, 24, 40, 40))
    return values.astype(np.float32), np.arange(10.0)


def _labels(seed: int) -> tuple[Single, npt.NDArray[np.float64]]:
    """Numbers of basins that move: few values, sharp edges; 12 x 16 x 64 x 64."""
    rng = np.random.default_rng(seed)
    t, z, y, x = _grid(12, 16, 64, 64)
    points, drift = rng.uniform(0, 1, (40, 3)), rng.normal(0, 0.2, (40, 3))
    nearest = np.full((12, 16, 64, 64), np.inf)
    labels = np.zeros(nearest.shape, np.float32)
    names = rng.permutation(40)
    for name, (pz, py, px), (vz, vy, vx) in zip(names, points, drift, strict=True):
        away = (z - pz - vz * t) ** 2 + (y - py - vy * t) ** 2 + (x - px - vx * t) ** 2
        labels = np.where(away < nearest, np.float32(name), labels)
        nearest = np.minimum(nearest, away)
    return labels, np.arange(12.0)


def _waves(seed: int, shape: tuple[int, ...], finest: float, power: float) -> Single:
    """A sum of moving plane waves.

    finest: the shortest waves' number across the box. power: amplitude falls as frequency to it.
    """
    rng = np.random.default_rng(seed)
    t, z, y, x = _grid(*shape)
    values = np.zeros(shape)
    for _ in range(60):
        frequency = finest ** rng.uniform(0, 1)
        direction = rng.normal(size=3)
        kz, ky, kx = 2 * np.pi * frequency * direction / np.linalg.norm(direction)
        phase, speed = rng.uniform(0, 2 * np.pi), rng.normal(0, 2)
        values += frequency**-power * np.sin(kz * z + ky * y + kx * x + speed * t + phase)
    return values.astype(np.float32)


def _smooth(seed: int) -> tuple[Single, npt.NDArray[np.float64]]:
    """Long waves that drift slowly; 16 x 32 x 48 x 48."""
    return _waves(seed, (16, 32, 48, 48), 3.0, 1.5), np.linspace(0, 1, 16)


def _turbulence(seed: int) -> tuple[Single, npt.NDArray[np.float64]]:
    """Kolmogorov's spectrum: an octave of waves has the amplitude k^(-1/3); 8 x 48 x 64 x 64.

    The times are uneven.
    """
    times = np.cumsum(np.random.default_rng(seed).uniform(0.2, 1.8, 8))
    return _waves(seed, (8, 48, 64, 64), 32.0, 1 / 3), times


def _thin(seed: int) -> tuple[Single, npt.NDArray[np.float64]]:
    """Turbulence in three layers: one thin axis; 20 x 3 x 96 x 112."""
    return _waves(seed, (20, 3, 96, 112), 24.0, 1.0), np.linspace(0, 1, 20)


def _long(seed: int) -> tuple[Single, npt.NDArray[np.float64]]:
    """Many steps of few vertices, at uneven times; 600 x 6 x 10 x 14."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.2, 1.8, 600))
    _, z, y, x = _grid(1, 6, 10, 14)
    values = np.zeros((600, 6, 10, 14))
    for _ in range(20):
        kz, ky, kx = rng.normal(0, 5, 3)
        speed, phase = rng.normal(0, 0.2), rng.uniform(0, 2 * np.pi)
        place = kz * z + ky * y + kx * x + phase
        values += np.sin(place + speed * times.reshape(-1, 1, 1, 1))
    values += rng.normal(0, 0.05, values.shape)
    return values.astype(np.float32), times


def _short(seed: int) -> tuple[Single, npt.NDArray[np.float64]]:
    """Two steps of many vertices: turbulence with a front; 2 x 80 x 96 x 96."""
    values = _waves(seed, (2, 80, 96, 96), 20.0, 1.0)
    t, _, _, x = _grid(2, 80, 96, 96)
    return (values + np.where(x < 0.4 + 0.1 * t, 2, 0)).astype(np.float32), np.arange(2.0)


GENERATED: dict[str, Callable[[int], tuple[Single, npt.NDArray[np.float64]]]] = {
    "plateau": _plateau,
    "noise": _noise,
    "labels": _labels,
    "smooth": _smooth,
    "turbulence": _turbulence,
    "thin": _thin,
    "long": _long,
    "short": _short,
}
"""Functions of a seed that give values (t, z, y, x) and times in s, by the name of the kind."""


def is_generated(name: str) -> bool:
    """Whether a name is that of a generated series and not of a file."""
    return name.startswith(PREFIX)


def generated(name: str, seed: int = 0) -> ArraySeries:
    """The series of a name such as `generated:plateau`, with cell centres in m as positions.

    Raises InputError for a kind that there is not.
    """
    kind = name.removeprefix(PREFIX)
    if kind not in GENERATED:
        raise InputError(
            f"'{name}' is no generated series; {suggestion(name, map(PREFIX.__add__, GENERATED))}"
        )
    values, times = GENERATED[kind](seed)
    longest = max(values.shape[1:])
    coords = {
        axis: Coordinate(
            name=axis, values=(np.arange(n) + 0.5) / longest, attributes={"units": "m"}
        )
        for axis, n in zip("zyx", values.shape[1:], strict=True)
    }
    coords["t"] = Coordinate(name="time", values=times, attributes={"units": "s"})
    series = ArraySeries(values, name=kind, units="1", coords=coords)
    series.source = f"{PREFIX}{kind}"
    return series


@dataclass(frozen=True)
class Made:
    """A generated series.

    Attributes:
        scene: name of the simulator's scene.
        shape: (t, z, y, x).
        help: what it is, in a few words.
        feature: whether the scene's feature is measured, beside the whole.
    """

    scene: str
    shape: tuple[int, int, int, int]
    help: str
    feature: bool


MADE = {
    "front": Made("front", (8, 32, 64, 64), "a blast's shell", True),
    "argon": Made("bubble", (9, 204, 83, 80), "the size of the paper's Argon box", False),
}
"""Series by name."""
DEFAULT = f"{PREFIX}front"
"""Series where none is named."""


def is_made(name: object) -> bool:
    """Return whether something names a generated series."""
    return isinstance(name, str) and name.startswith(PREFIX)


def made_series(name: str) -> tuple[Simulation, Made]:
    """Return a generated series and what it is.

    Raises InputError for a name that is unknown.
    """
    made = MADE.get(name.removeprefix(PREFIX))
    if made is None:
        raise InputError(
            f"'{name}' is no generated series; {suggestion(name, map(PREFIX.__add__, MADE))}"
        )
    return simulate(made.scene, made.shape), made
