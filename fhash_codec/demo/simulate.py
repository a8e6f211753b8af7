"""Small simulated series for the demo: numpy only, the same values on every run.

- `vortex`: two blobs of a tracer, carried and mixed by a swirl; a pseudo-spectral solution of the
  advection-diffusion equation.
- `front`: an expanding shell whose radius follows the Sedov-Taylor law of a blast and whose surface
  grows fingers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.series import AXIS_NAMES, ArraySeries, Coordinate

Frame = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A simulation.

    The domain is the unit cube in metres, stretched to the shape, and lasts one second. Values lie
    in about 0..1.

    Attributes:
        help: one line.
        frames: generates the frames for a shape (t, z, y, x) and a seed.
        name: name of the variable.
        units: units of the variable.
        feature: a feature worth keeping.
    """

    help: str
    frames: Callable[[tuple[int, int, int, int], int], Iterator[Frame]]
    name: str
    units: str
    feature: str


def simulate(
    name: str, shape: tuple[int, int, int, int] = (16, 32, 48, 48), seed: int = 0
) -> ArraySeries:
    """The series (t, z, y, x) float32 of a scene of `SCENES`, with time in s and positions in m.

    Raises InputError for an unknown scene, or fewer than 2 steps or 8 vertices along an axis.
    """
    if name not in SCENES:
        raise InputError(f"scene is '{name}'; allowed: {', '.join(SCENES)}")
    if shape[0] < 2 or min(shape[1:]) < 8:
        raise InputError(
            f"scene shape is {shape} in (t, z, y, x);"
            " at least 2 steps and 8 vertices along every axis are needed"
        )
    scene = SCENES[name]
    positions = {"t": np.linspace(0.0, 1.0, shape[0])} | {
        axis: _centres(n) for axis, n in zip("zyx", shape[1:], strict=True)
    }
    coords = {
        axis: Coordinate(
            name=AXIS_NAMES[axis], values=values, attributes={"units": "s" if axis == "t" else "m"}
        )
        for axis, values in positions.items()
    }
    return ArraySeries(
        np.stack(list(scene.frames(shape, seed))), name=scene.name, units=scene.units, coords=coords
    )


def _centres(n: int) -> npt.NDArray[np.float64]:
    """n cell centres of the interval 0..1."""
    return (np.arange(n) + 0.5) / n


def _positions(shape: tuple[int, ...]) -> tuple[npt.NDArray[np.float64], ...]:
    """Positions z, y and x of every vertex of the unit cube, broadcastable against each other."""
    return tuple(np.meshgrid(*map(_centres, shape), indexing="ij", sparse=True))


def _vortex(shape: tuple[int, int, int, int], seed: int) -> Iterator[Frame]:
    """Solve dc/dt = -div(u c) + D lap(c) in a periodic box.

    Derivatives are taken by Fourier transform, time steps by the classical Runge-Kutta method of
    order 4. u is LeVeque's vortex in a box (sin^2, so that it vanishes on the walls) with an upward
    flow in its core; it is divergence-free.
    """
    steps, *box = shape
    z, y, x = _positions(tuple(box))
    swirl, updraught, diffusivity = 2.4, 0.4, 7e-4
    flow = (
        updraught * (np.sin(np.pi * x) * np.sin(np.pi * y)) ** 4 + 0 * z,
        -swirl * np.sin(np.pi * y) ** 2 * np.sin(2 * np.pi * x) / 2 * (1 + 0 * z),
        swirl * np.sin(np.pi * x) ** 2 * np.sin(2 * np.pi * y) / 2 * (1 + 0 * z),
    )
    counts = [
        np.fft.fftfreq(box[0], 1 / box[0]),
        np.fft.fftfreq(box[1], 1 / box[1]),
        np.fft.rfftfreq(box[2], 1 / box[2]),
    ]
    waves = np.meshgrid(*(2 * np.pi * count for count in counts), indexing="ij", sparse=True)
    # The product u c has waves too short for the lattice: the two-thirds rule removes aliases.
    kept = np.meshgrid(
        *(np.abs(count) < n / 3 for count, n in zip(counts, box, strict=True)),
        indexing="ij",
        sparse=True,
    )
    filtered = kept[0] & kept[1] & kept[2]
    square = sum(wave**2 for wave in waves)

    def slope(spectrum: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
        tracer = np.fft.irfftn(spectrum, s=box, axes=(0, 1, 2))
        carried = sum(
            1j * wave * np.fft.rfftn(u * tracer) for wave, u in zip(waves, flow, strict=True)
        )
        return np.asarray(-diffusivity * square * spectrum - filtered * carried)

    noise = np.random.default_rng(seed).uniform(-0.03, 0.03, size=(2, 3))
    tracer = np.zeros(box)
    for (cz, cy, cx), amplitude in zip(
        np.array([[0.36, 0.5, 0.27], [0.52, 0.5, 0.72]]) + noise, (1.0, 0.75), strict=True
    ):
        tracer += amplitude * np.exp(
            -(((z - cz) / 0.15) ** 2 + ((y - cy) / 0.14) ** 2 + ((x - cx) / 0.14) ** 2)
        )
    spectrum = np.fft.rfftn(tracer) * filtered
    # Stable for |u| k dt < 2.8 (Runge-Kutta on the imaginary axis).
    speed = sum(float(np.abs(u).max()) * n for u, n in zip(flow, box, strict=True)) * 2 * np.pi / 3
    inner = max(1, int(np.ceil(speed / 2.0 / (steps - 1))))
    dt = 1.0 / (steps - 1) / inner
    for step in range(steps):
        for _ in range(inner if step else 0):
            a = slope(spectrum)
            b = slope(spectrum + dt / 2 * a)
            c = slope(spectrum + dt / 2 * b)
            d = slope(spectrum + dt * c)
            spectrum = spectrum + dt / 6 * (a + 2 * b + 2 * c + d)
        yield np.fft.irfftn(spectrum, s=box, axes=(0, 1, 2)).astype(np.float32)


def _front(shape: tuple[int, int, int, int], seed: int) -> Iterator[Frame]:
    """Density of an expanding shell with radius ~ t^(2/5) (Sedov-Taylor).

    Its fingers have fixed directions and grow with time.
    """
    steps, *box = shape
    z, y, x = (position - 0.5 for position in _positions(tuple(box)))
    radius = np.sqrt(z**2 + y**2 + x**2)
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    fingers = np.zeros(box)
    for (dz, dy, dx), height in zip(
        directions, generator.uniform(-1.0, 1.0, size=len(directions)), strict=True
    ):
        fingers += height * np.exp(28.0 * ((z * dz + y * dy + x * dx) / (radius + 1e-9) - 1.0))
    for step in range(steps):
        age = 0.12 + 0.88 * step / (steps - 1)
        surface = 0.4 * age**0.4 * (1.0 + 0.3 * age * fingers)
        depth = (surface - radius) / (0.035 + 0.025 * age)
        shell = np.exp(-np.clip(depth, 0.0, None)) * 0.5 * (1.0 + np.tanh(3.0 * depth))
        yield (0.12 + 0.88 * shell * age**-0.25 / 1.7 + 0.05 * np.tanh(-depth)).astype(np.float32)


SCENES = {
    "vortex": Scene(
        help="two blobs of a tracer carried and mixed by a swirl",
        frames=_vortex,
        name="tracer",
        units="1",
        feature="interval:0.08:2",
    ),
    "front": Scene(
        help="a blast's shell that expands and grows fingers",
        frames=_front,
        name="density",
        units="kg m-3",
        feature="interval:0.25:2",
    ),
}
