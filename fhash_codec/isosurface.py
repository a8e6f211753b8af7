"""The surface of a value in a decoded frame as triangles, by scikit-image's marching cubes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import Coordinate
from fhash_formats.writers.mesh import Mesh

__all__ = ["isosurface", "require_marching_cubes"]


def require_marching_cubes() -> Any:
    """The function of scikit-image; raises MissingDependencyError where it is not installed."""
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise MissingDependencyError(
            "an isosurface needs scikit-image: pip install 'fhash[mesh]'"
        ) from error
    return marching_cubes


def isosurface(
    frame: npt.NDArray[Any],
    value: float,
    coords: Mapping[str, Coordinate],
    *,
    name: str = "values",
    time: float = 0.0,
) -> Mesh:
    """The surface where a frame (z, y, x) has a value, in physical coordinates, which need not be even.

    Cells with a vertex that is not finite are left out. Lewiner et al., Efficient Implementation of Marching Cubes' Cases with
    Topological Guarantees, 2003. Raises InputError where the frame has no such surface, MissingDependencyError.
    """
    marching_cubes = require_marching_cubes()
    if not math.isfinite(value):
        raise InputError(f"isosurface {value} is not a finite number")
    if min(frame.shape) < 2:
        raise InputError(
            f"a surface needs two vertices along each axis; the region has {frame.shape} (z, y, x)"
        )
    known = np.isfinite(frame)
    if not known.any():
        raise InputError("no vertex of the region has a value; no surface")
    # The difference in full precision: the library computes in float32, in which 101325.001 is 101325.
    above = np.where(known, frame, value).astype(np.float64) - value
    scale = float(np.abs(above).max())
    cells = np.ones([length - 1 for length in frame.shape], dtype=bool)
    for corner in np.ndindex(2, 2, 2):
        cells &= known[
            tuple(slice(at, at + length) for at, length in zip(corner, cells.shape, strict=True))
        ]
    wanted = np.zeros(frame.shape, dtype=bool)
    wanted[1:, 1:, 1:] = cells  # the library asks for a cell by its last vertex
    try:
        found = (
            marching_cubes(
                (above / (scale or 1.0)).astype(np.float32),
                0.0,
                mask=wanted,
                allow_degenerate=False,
            )
            if scale
            else None
        )
    except (RuntimeError, ValueError):  # the library's words for a surface that is empty
        found = None
    if found is None or not len(found[1]):
        low, high = float(frame[known].min()), float(frame[known].max())
        raise InputError(
            f"no surface of the value {value:g} in the region: its values run from {low:.6g} to {high:.6g}"
        )
    places, triangles = found[0].astype(np.float64), found[1].astype(np.int64)
    axes = [coords[axis].values for axis in "zyx"]
    physical = [
        np.interp(places[:, axis], np.arange(len(values)), values)
        for axis, values in enumerate(axes)
    ]
    # The library's order is seen from the lower values in (x, y, z); each descending axis turns space inside out.
    if sum(bool(values[-1] < values[0]) for values in axes) % 2:
        triangles = triangles[:, ::-1]
    return Mesh(
        vertices=np.stack(physical[::-1], axis=-1),
        triangles=triangles,
        name=name,
        value=float(value),
        time=time,
    )
