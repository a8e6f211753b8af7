"""Isosurfaces of a decoded frame, as triangles, by scikit-image's marching cubes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import AXES, Coordinate
from fhash_formats.writers.vtk import Mesh

__all__ = ["isosurface", "require_marching_cubes"]


def require_marching_cubes() -> Any:
    """The function of scikit-image; raises MissingDependencyError if it is not installed."""
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
    """The surface where a frame (z, y, x) has a value, in physical coordinates.

    coords: positions of the vertices along "z", "y" and "x", ascending or descending, evenly spaced
        or not.
    name, time: what the mesh says of its variable and its time.

    Cells with a vertex that is not finite are left out. Source: Lewiner et al., Efficient
    Implementation of Marching Cubes' Cases with Topological Guarantees, 2003. Raises InputError if
    the frame has no such surface, MissingDependencyError without scikit-image.
    """
    marching_cubes = require_marching_cubes()
    if not math.isfinite(value):
        raise InputError(f"isosurface {value} is not a finite number")
    if min(frame.shape) < 2:
        raise InputError(
            f"a surface needs two vertices along each axis; the region has {frame.shape} (z, y, x)"
        )
    finite = np.isfinite(frame)
    if not finite.any():
        raise InputError("no vertex of the region has a value; no surface")
    places, triangles = _zero_surface(marching_cubes, frame, value, finite)
    if not len(triangles):
        low, high = float(frame[finite].min()), float(frame[finite].max())
        raise InputError(
            f"no surface of the value {value:g} in the region: "
            f"its values run from {low:.6g} to {high:.6g}"
        )
    positions = [coords[axis].values for axis in AXES[1:]]
    physical = [
        np.interp(places[:, axis], np.arange(len(along)), along)
        for axis, along in enumerate(positions)
    ]
    # The library orders the corners of a triangle as seen from the lower values in (x, y, z). Each
    # descending axis turns space inside out.
    if sum(bool(along[-1] < along[0]) for along in positions) % 2:
        triangles = triangles[:, ::-1]
    return Mesh(
        vertices=np.stack(physical[::-1], axis=-1),
        triangles=triangles,
        name=name,
        value=float(value),
        time=time,
    )


def _zero_surface(
    marching_cubes: Any, frame: npt.NDArray[Any], value: float, finite: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Points (n, 3) in vertices (z, y, x), and triangles (m, 3); none if there is no surface."""
    nothing = np.empty((0, 3)), np.empty((0, 3), np.int64)
    # The difference in full precision: the library's float32 has 101325 for 101325.001.
    above = np.where(finite, frame, value).astype(np.float64) - value
    scale = float(np.abs(above).max())
    if not scale:
        return nothing
    try:
        with warnings.catch_warnings():
            # scikit-image up to 0.26 sets shapes, which NumPy 2.5 deprecates
            warnings.simplefilter("ignore", DeprecationWarning)
            points, triangles, *_ = marching_cubes(
                (above / scale).astype(np.float32),
                0.0,
                mask=_last_vertices_of_cells(finite),
                allow_degenerate=False,
            )
    except (RuntimeError, ValueError):  # raised by the library for a surface that is empty
        return nothing
    return points.astype(np.float64), triangles.astype(np.int64)


def _last_vertices_of_cells(finite: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Mask of the cells whose 8 vertices are all finite; a cell is named by its last vertex."""
    cells = np.ones([length - 1 for length in finite.shape], dtype=bool)
    for corner in np.ndindex(2, 2, 2):
        cells &= finite[
            tuple(slice(at, at + length) for at, length in zip(corner, cells.shape, strict=True))
        ]
    mask = np.zeros(finite.shape, dtype=bool)
    mask[1:, 1:, 1:] = cells
    return mask
