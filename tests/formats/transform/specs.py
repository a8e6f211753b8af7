"""Transforms for tests, made from a kind and a depth for each axis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fhash_formats.transform.spec import WAVELETS, AxisTransform, TransformSpec, fit_basis

Depths = TypeVar("Depths", int, tuple[int, ...])

SHAPES = [
    (1, 1, 1, 1),
    (2, 3, 5, 7),
    (4, 9, 17, 33),
    (16, 1, 2, 64),
    (3, 8, 64, 65),
    (1, 2, 1, 40),
    (2, 2, 40, 1),
    (7, 13, 31, 29),
]
"""Shapes (t, z, y, x) of tiles: odd, even, long and flat."""
MIXES = [
    ("haar", "5/3", "9/7", "9/7"),
    ("9/7", "haar", "5/3", "5/3"),
    ("5/3", "9/7", "haar", "haar"),
    ("klt", "none", "9/7", "5/3"),
    ("none", "klt", "haar", "klt"),
    ("klt", "klt", "klt", "klt"),
    ("none", "none", "none", "none"),
    ("9/7", "5/3", "klt", "9/7"),
]
"""Kinds along (t, z, y, x)."""
TYPES = [np.float32, np.float64]
"""Working types."""


def spec_of(
    kinds: Sequence[str], depths: int | Sequence[int], shape: Sequence[int], step: float = 1e-4
) -> TransformSpec:
    """A transform of tiles of a shape (t, z, y, x).

    Args:
        kinds: kind of each axis.
        depths: depth of the wavelets, one for all axes or one for each axis.
        shape: lengths of the axes, for the bases.
        step: quantiser step of the bases; a large step drops the weakest vectors, a huge one all.
    """
    t, z, y, x = (
        axis_of(kind, depth, n, step)
        for kind, depth, n in zip(kinds, _per_axis(depths), shape, strict=True)
    )
    return TransformSpec(axes=(t, z, y, x))


def axis_of(kind: str, depth: int, n: int, step: float = 1e-4) -> AxisTransform:
    """The transform of one axis of `n` vertices; the basis of "klt" fits random walks."""
    if kind == "klt":
        columns = np.cumsum(np.random.default_rng(n).standard_normal((n, 2 * n + 9)), axis=0)
        return AxisTransform(kind=kind, basis=fit_basis(columns @ columns.T, step))
    return AxisTransform(kind=kind, depth=depth if kind in WAVELETS else 0)


def mixes_and_depths(
    mixes: Sequence[tuple[str, ...]], depths: Sequence[Depths]
) -> list[tuple[tuple[str, ...], Depths]]:
    """Each mix of kinds with each depth that makes another transform: only wavelets have depths."""
    pairs = {
        (
            kinds,
            tuple(
                depth if kind in WAVELETS else 0
                for kind, depth in zip(kinds, _per_axis(given), strict=True)
            ),
        ): (kinds, given)
        for kinds in mixes
        for given in reversed(depths)
    }
    return list(pairs.values())


def _per_axis(depths: int | Sequence[int]) -> Sequence[int]:
    return (depths,) * 4 if isinstance(depths, int) else depths


def noise(shape: tuple[int, ...], dtype: Any, seed: int = 0) -> NDArray[Any]:
    """Values of a normal distribution."""
    return np.random.default_rng(seed).standard_normal(shape).astype(dtype)
