"""The comparison picture: exact colours at control points, and every vertex in its place."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from fhash_codec.gallery import GALLERY_SERIES, OUTSIDE, PICTURES, VIRIDIS, Pair, colours, compare
from fhash_codec.isosurface import isosurface
from fhash_codec.rendering.grid import Grid
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import Coordinate
from fhash_formats.writers.vtk import Mesh


def test_colours_hit_their_control_points_and_clip_beyond_the_ends() -> None:
    count = len(VIRIDIS)
    expected = [tuple(bytes.fromhex(point)) for point in VIRIDIS]
    got = colours(np.linspace(2.0, 5.0, count), 2.0, 5.0, VIRIDIS)
    assert [tuple(map(int, colour)) for colour in got] == expected
    assert tuple(colours(-99.0, 2.0, 5.0, VIRIDIS)) == expected[0]
    assert tuple(colours(99.0, 2.0, 5.0, VIRIDIS)) == expected[-1]


@pytest.mark.parametrize("shape", [(48, 48), (7, 31), (1, 1), (300, 400)])
def test_picture_shows_original_decoded_and_error_of_each_pair(shape: tuple[int, int]) -> None:
    original = np.linspace(0.0, 1.0, shape[0] * shape[1]).reshape(shape)
    decoded = np.full(shape, np.nan)
    decoded[-1, 0] = original[-1, 0]
    image = compare(
        [Pair(label=f"t = {n}", original=original, decoded=decoded) for n in range(3)],
        title="a",
        subtitle="b",
        quantity="c",
    )
    pixels = np.asarray(image)
    lowest, highest = (np.array(list(bytes.fromhex(VIRIDIS[end]))) for end in (0, -1))
    columns = [x for x in range(image.width) if (pixels[:, x] == OUTSIDE).all(axis=-1).any()]
    assert image.mode == "RGB"
    assert 600 < image.width < 2000
    assert columns or shape == (1, 1)
    assert (pixels == highest).all(axis=-1).any()
    assert (pixels == lowest).all(axis=-1).any()


def test_picture_of_nothing_decoded_and_of_a_constant_has_no_invalid_number() -> None:
    flat = np.full((6, 5), 3.0)
    compare(
        [Pair(label="", original=flat, decoded=np.full((6, 5), np.nan))],
        title="",
        subtitle="",
        quantity="",
    )
    compare(
        [Pair(label="", original=flat, decoded=flat)],
        title="",
        subtitle="",
        quantity="",
        footer="x",
    )


@pytest.mark.parametrize("name", sorted(set(GALLERY_SERIES) - {"blast"}))
def test_a_series_has_values_and_is_the_same_again(name: str) -> None:
    first, second = GALLERY_SERIES[name].make(), GALLERY_SERIES[name].make()
    assert first.shape == (first.shape[0], *first.read(0).shape)
    np.testing.assert_array_equal(first.read(1), second.read(1))
    assert 0.3 < np.isfinite(first.read(0)).mean() <= 1
    assert first.coords["t"].attributes["units"] == "s"


def test_there_is_a_plane_a_depth_and_uneven_axes() -> None:
    grids = {name: Grid.of(GALLERY_SERIES[name].make().coords) for name in ("sea", "ocean", "jet")}
    assert grids["sea"].flat
    assert grids["sea"].warp is None
    for name in ("ocean", "jet"):
        assert grids[name].warp is not None
        assert grids[name].scale[2] < 0


def test_every_picture_is_of_a_series() -> None:
    assert {picture.series for picture in PICTURES} == set(GALLERY_SERIES)
    assert len({picture.name for picture in PICTURES}) == len(PICTURES)


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
