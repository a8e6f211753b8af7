"""Two blobs, and tasks that both this renderer and VTK draw."""

from __future__ import annotations

import numpy as np

from fhash_bench.pictures.vtk import VtkPeer
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import Lighting, Table, Task
from fhash_codec.rendering.scenes import Camera
from fhash_formats.series import Coordinate

SHAPE = (4, 12, 14, 16)


SIZE = (72, 60)


LIGHTING = Lighting(ambient=0.2, diffuse=0.8, specular=0.3, specular_power=12.0, lamp=None)


CAMERAS = (
    Camera(azimuth=25, elevation=15),
    Camera(view="xz", projection="parallel", azimuth=-10),
    Camera(position=(9.0, 30.0, 12.0), focal_point=(6.0, 13.0, 10.0), view_up=(0.3, 0, 1)),
)


def field() -> np.ndarray:
    """Two blobs on 0, (t, z, y, x).

    The large one moves along x; the small one tells mirrored axes apart.
    """
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    large = np.exp(-((z - 5) ** 2 + (y - 6) ** 2 + (x - 6 - t) ** 2) / 12)
    return (
        large + 0.7 * np.exp(-((z - 9) ** 2 + (y - 3) ** 2 + (x - 13) ** 2) / 4) + 0 * t
    ).astype(np.float32)


def axes() -> dict[str, Coordinate]:
    """Coordinates whose spacings differ, y descending."""
    values = {
        "t": np.arange(4.0),
        "z": 3 + 1.5 * np.arange(12),
        "y": 20 - np.arange(14.0),
        "x": 0.8 * np.arange(16),
    }
    return {
        axis: Coordinate(name=axis, values=positions, attributes={})
        for axis, positions in values.items()
    }


def task(camera: Camera, *, shaded: bool, step: float) -> Task:
    """A task that draws the blobs from a camera, with ray steps of `step` vertices."""
    values = np.linspace(0, 1, 512)
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.stack([values, 1 - values, 0.5 + 0 * values], axis=-1).astype(np.float32),
        extinctions=0.5 * np.clip(values - 0.1, 0, None),
    )
    rays = Rays.of(camera, Grid.of(axes()), SIZE)
    return Task(
        rays=rays,
        step=step,
        threshold=0.0,
        table=table,
        lighting=LIGHTING if shaded else None,
        shaded=shaded,
    )


def drawn(asked: Task, values: np.ndarray, mapper: str = "gpu") -> np.ndarray:
    """The bytes (H, W, 3) of a frame (z, y, x) that VTK draws."""
    peer = VtkPeer(values, asked, unit=1.0, mapper=mapper)
    try:
        peer.look(asked.rays)
        peer.draw()
        return peer.draw().pixels
    finally:
        peer.close()
