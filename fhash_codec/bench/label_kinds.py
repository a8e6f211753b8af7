"""Made series of labels, of kinds that simulations and analyses write.

They were chosen and measured after the coder of labels was finished, so it was not tuned on them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["KINDS"]

Labels = npt.NDArray[Any]
Shape = tuple[int, int, int, int]

SHAPE: Shape = (8, 20, 56, 60)
"""Shape (t, z, y, x) of most kinds, in vertices."""


def _smooth_field(shape: tuple[int, ...], width: float, seed: int) -> npt.NDArray[np.float64]:
    """Random numbers of mean 0 and deviation 1, smoothed along all axes.

    width: deviation of the Gaussian, in vertices.
    """
    from scipy.ndimage import gaussian_filter

    noise = np.random.default_rng(seed).normal(size=shape)
    field = gaussian_filter(noise, width, mode="wrap")
    return np.asarray(field / field.std())


def _nearest_point(shape: Shape, points: int, speed: float, seed: int) -> npt.NDArray[np.int64]:
    """Number of the nearest of moving points, at every vertex and step.

    speed: deviation of the points' speeds, in vertices a step.
    """
    from scipy.spatial import cKDTree

    chance = np.random.default_rng(seed)
    lengths = np.array(shape[1:])
    starts = chance.uniform(0, 1, (points, 3)) * lengths
    speeds = chance.normal(0, speed, (points, 3))
    vertices = np.moveaxis(np.indices(shape[1:]), 0, -1).reshape(-1, 3)
    frames = [
        cKDTree(starts + step * speeds).query(vertices)[1].reshape(shape[1:])
        for step in range(shape[0])
    ]
    return np.asarray(np.stack(frames).astype(np.int64))


def _components() -> Labels:
    """Connected regions above a threshold, numbered anew at each step."""
    from scipy.ndimage import label

    field = _smooth_field(SHAPE, 2.5, 1)
    return np.asarray(np.stack([label(frame > 0.6)[0] for frame in field]).astype(np.int32))


def _tracked_components() -> Labels:
    """Regions above a threshold, connected in space and time: each keeps its number."""
    from scipy.ndimage import label

    return np.asarray(np.asarray(label(_smooth_field(SHAPE, 2.0, 2) > 1.0)[0]).astype(np.uint16))


def _refinement_levels() -> Labels:
    """Levels of an adaptive mesh: blocks of 4^3 about a front that moves."""
    t, z, y, x = (np.asarray(axis, float) for axis in np.indices(SHAPE))
    bend = 4 * np.sin(y // 4 * 0.6) + 3 * np.cos(z // 4 * 0.9)
    distance = np.abs(x // 4 * 4 + bend - 10 - 4 * t)
    return np.asarray((4 - np.searchsorted([4.0, 9.0, 16.0, 28.0], distance)).astype(np.int8))


def _basins() -> Labels:
    """Watersheds: the minimum to which the steepest descent from each vertex leads."""
    field = _smooth_field(SHAPE, 2.2, 3)
    return np.asarray(np.stack([_descend(frame) for frame in field]).astype(np.uint16))


def _descend(field: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Number of the local minimum below each vertex, in the order of the vertices."""
    padded = np.pad(field, 1, constant_values=np.inf)
    offsets = [(dz, dy, dx) for dz in (0, 1, 2) for dy in (0, 1, 2) for dx in (0, 1, 2)]
    z, y, x = field.shape
    around = np.stack([padded[a : a + z, b : b + y, c : c + x] for a, b, c in offsets])
    places = np.pad(np.arange(field.size).reshape(field.shape), 1)
    targets = np.stack([places[a : a + z, b : b + y, c : c + x] for a, b, c in offsets])
    below = np.take_along_axis(targets, around.argmin(0)[None], 0)[0].ravel()
    while True:
        further = below[below]
        if (further == below).all():
            return np.unique(below, return_inverse=True)[1].reshape(field.shape)
        below = further


def _particles() -> Labels:
    """Numbers of 150 particles at single vertices, 0 elsewhere."""
    chance = np.random.default_rng(4)
    places, speeds = chance.uniform(0, 1, (150, 3)), chance.normal(0, 0.01, (150, 3))
    labels = np.zeros(SHAPE, np.int32)
    for step in range(SHAPE[0]):
        z, y, x = ((places + step * speeds) % 1 * SHAPE[1:]).astype(int).T
        labels[step, z, y, x] = np.arange(150) + 1000
    return labels


def _checkerboard() -> Labels:
    """Cubes of 5 vertices in turns, which move by one vertex a step."""
    t, z, y, x = np.indices(SHAPE)
    return np.asarray(((z // 5 + y // 5 + (x + t) // 5) % 2).astype(np.uint8))


def _stripes() -> Labels:
    """Ascending numbers in slabs of 3 vertices, the same at each step."""
    x = np.indices(SHAPE)[3]
    return np.asarray((x // 3 * 11 + 5).astype(np.int16))


def _many() -> Labels:
    """3,000 grains of a polycrystal that drift."""
    chance = np.random.default_rng(5)
    return np.asarray(
        chance.permutation(3000)[_nearest_point(SHAPE, 3000, 0.15, 5)].astype(np.uint16)
    )


def _large_ids() -> Labels:
    """Global identifiers of 200 moving cells, between 1 and 2 thousand million."""
    ids = np.random.default_rng(6).integers(10**9, 2 * 10**9, 200)
    return np.asarray(ids[_nearest_point(SHAPE, 200, 0.4, 6)].astype(np.int32))


def _thin() -> Labels:
    """One layer of 180 x 300 vertices: cells that move."""
    return _nearest_point((6, 1, 180, 300), 120, 1.5, 7).astype(np.uint8)


def _two_steps() -> Labels:
    """Two steps of cells."""
    return _nearest_point((2, 40, 80, 84), 90, 1.0, 8).astype(np.uint8)


def _tiny_grid() -> Labels:
    """200 steps of a grid of 6 x 7 x 8 vertices."""
    return _nearest_point((200, 6, 7, 8), 12, 0.03, 9).astype(np.int16)


def _filled() -> Labels:
    """Classes of an ocean, with -9999 over land."""
    land = _smooth_field(SHAPE[2:], 5.0, 10) > 0.4
    depth = np.arange(SHAPE[1])[:, None, None] - 14 + 3 * _smooth_field(SHAPE[2:], 4.0, 11)
    classes = np.digitize(_smooth_field(SHAPE, 3.0, 12), [-1.2, -0.4, 0.3, 1.1]) + 1
    return np.asarray(np.where(land | (depth > 0), -9999, classes).astype(np.int16))


def _domains() -> Labels:
    """Magnetic domains: three-state Potts model with noise of one vertex."""
    chance = np.random.default_rng(13)
    states = np.stack([_smooth_field(SHAPE, 1.6, 14 + k) for k in range(3)]).argmax(0)
    flips = chance.random(SHAPE) < 0.03
    return np.asarray(np.where(flips, chance.integers(0, 3, SHAPE), states).astype(np.uint8))


def _ranks() -> Labels:
    """Numbers of 360 processors that share a grid by blocks, the same at each step."""
    _, z, y, x = np.indices(SHAPE)
    return np.asarray((z // 4 * 72 + y // 7 * 9 + x // 7).astype(np.int32))


def _flags() -> Labels:
    """Five independent yes-or-no answers as the bits of a number."""
    bits = [(_smooth_field(SHAPE, 2.5, 20 + k) > 0.3 * k) << k for k in range(5)]
    return np.asarray(np.sum(bits, axis=0).astype(np.uint8))


def _arrival() -> Labels:
    """Step at which a front reached each vertex, -1 before: values grow old and stay."""
    reached = np.floor(SHAPE[0] * (0.5 + 0.28 * _smooth_field(SHAPE[1:], 5.0, 30)))
    t = np.arange(SHAPE[0])[:, None, None, None]
    return np.asarray(np.where(reached <= t, reached, -1).astype(np.int8))


def _noise() -> Labels:
    """Random labels without any structure."""
    return np.asarray(np.random.default_rng(31).integers(0, 6, SHAPE).astype(np.uint8))


def _floats() -> Labels:
    """Material numbers in float32 with NaN outside a ball."""
    materials = _nearest_point(SHAPE, 25, 0.3, 32).astype(np.float32)
    _, z, y, x = np.indices(SHAPE)
    outside = (z - 10) ** 2 * 7 + (y - 28) ** 2 + (x - 30) ** 2 > 28**2
    return np.where(outside, np.float32(np.nan), materials)


KINDS: dict[str, Callable[[], Labels]] = {
    "components": _components,
    "tracked components": _tracked_components,
    "refinement levels": _refinement_levels,
    "basins": _basins,
    "particles": _particles,
    "checkerboard": _checkerboard,
    "stripes": _stripes,
    "many": _many,
    "large ids": _large_ids,
    "thin": _thin,
    "two steps": _two_steps,
    "tiny grid": _tiny_grid,
    "filled": _filled,
    "domains": _domains,
    "ranks": _ranks,
    "flags": _flags,
    "arrival": _arrival,
    "noise": _noise,
    "floats": _floats,
}
"""Kinds by their names; each call makes the same series."""
