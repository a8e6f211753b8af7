"""The surface of a value as triangles in physical coordinates."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from fhash_codec.isosurface import isosurface
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import Coordinate
from fhash_formats.writers.vtk import Mesh


def coords(turned: str = "") -> dict[str, Coordinate]:
    values = {
        axis: np.linspace(-extent, extent, count)
        for axis, extent, count in (("x", 1.5, 31), ("y", 1.6, 33), ("z", 1.7, 35))
    }
    return {
        axis: Coordinate(name=axis, values=at[::-1].copy() if axis in turned else at)
        for axis, at in values.items()
    }


def distance(axes: dict[str, Coordinate]) -> np.ndarray:
    z, y, x = np.meshgrid(*(axes[axis].values for axis in "zyx"), indexing="ij")
    return np.sqrt(x**2 + y**2 + z**2)


def outwards(mesh: Mesh) -> np.ndarray:
    """Whether the corners of each triangle run counterclockwise as seen from outside the ball."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    return (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1) > 0


@pytest.mark.parametrize("turned", ["", "x", "zy", "xyz"])
def test_a_sphere_is_one_closed_surface_seen_from_the_lower_values(turned: str) -> None:
    axes = coords(turned)
    mesh = isosurface(-distance(axes), -1.0, axes, name="d", time=3.0)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1.0, rtol=0, atol=2e-3)
    assert (mesh.name, mesh.value, mesh.time) == ("d", -1.0, 3.0)
    assert np.all(outwards(mesh))
    assert not np.any(outwards(isosurface(distance(axes), 1.0, axes)))
    edges = np.sort(
        np.concatenate([mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1
    )
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)


@pytest.mark.parametrize(("factor", "offset"), [(1e-3, 101325.0), (1e-200, 0.0), (1e200, 0.0)])
def test_values_that_float32_does_not_tell_apart(factor: float, offset: float) -> None:
    axes = coords()
    mesh = isosurface(distance(axes) * factor + offset, factor + offset, axes)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1.0, rtol=0, atol=3e-3)


@pytest.mark.parametrize(
    ("frame", "value", "message"),
    [
        (
            np.zeros((4, 4, 4)),
            1.0,
            "no surface of the value 1 in the region: its values run from 0 to 0",
        ),
        (np.zeros((4, 4, 4)), 0.0, "no surface of the value 0"),
        (np.arange(64.0).reshape(4, 4, 4), 64.0, "from 0 to 63"),
        (np.full((4, 4, 4), np.nan), 1.0, "no vertex of the region has a value"),
        (np.zeros((1, 4, 4)), 0.0, "two vertices along each axis"),
        (np.zeros((4, 4, 4)), np.nan, "not a finite number"),
    ],
)
def test_surfaces_that_are_not_there(frame: np.ndarray, value: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        isosurface(frame, value, coords())


def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fhash\[mesh\]'"):
        isosurface(np.zeros((4, 4, 4)), 0.0, coords())
