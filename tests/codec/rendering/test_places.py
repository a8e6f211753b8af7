"""Pictures of volumes in their true places: uneven and downward axes, planes, in every mode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, Scene
from fhash_codec.rendering.renderer import Renderer
from fhash_formats.series import ArraySeries, Coordinate

EVEN = np.linspace(-1, 1, 27)
UNEVEN = np.sign(EVEN) * np.abs(EVEN) ** 1.7
LINEAR = {"opacity": [[0.0, 0.0], [1.0, 0.4]], "unit_distance": 0.05}


def ball(z: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A ball of radius 0.6 about the middle, with a soft surface."""
    radius = np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2)
    return np.asarray(1 / (1 + np.exp((radius - 0.6) / 0.08)))


def written(path: Path, values: np.ndarray, config: EncodeConfig, **coords: Any) -> Path:
    """A container of one step or more, with coordinates (values, attributes) or values."""
    axes = {"t": np.arange(len(values)), **coords}
    made = {}
    for axis, given in axes.items():
        at, attributes = given if isinstance(given, tuple) else (given, {})
        made[axis] = Coordinate(
            name=axis, values=np.asarray(at, dtype=np.float64), attributes=attributes
        )
    series = ArraySeries(values.astype(np.float32), name="q", units="K", coords=made)
    fhash_codec.encode(series, path, config)
    return path


def picture(path: Path, **scene: Any) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return Renderer(volume).render(Scene.from_dict({"size": [48, 48], **scene})).rgba


FINE = EncodeConfig(effort=1, psnr=70)


@pytest.mark.parametrize("descending", [False, True])
def test_a_ball_on_uneven_axes_is_the_ball_on_even_ones(tmp_path: Path, descending: bool) -> None:
    x = UNEVEN[::-1] if descending else UNEVEN
    uneven = written(tmp_path / "u.fhz", ball(UNEVEN, EVEN, x)[None], FINE, z=UNEVEN, y=EVEN, x=x)
    even = written(tmp_path / "e.fhz", ball(EVEN, EVEN, EVEN)[None], FINE, z=EVEN, y=EVEN, x=EVEN)
    wrong = written(tmp_path / "w.fhz", ball(UNEVEN, EVEN, x)[None], FINE, z=EVEN, y=EVEN, x=EVEN)
    for scene in (
        {"transfer_function": LINEAR},
        {"transfer_function": {"nothing": True}, "effects": {"isosurfaces": [{"value": 0.5}]}},
        {"transfer_function": LINEAR, "effects": {"shading": True}, "camera": {"zoom": 3.0}},
    ):
        found, expected, other = (picture(path, **scene) for path in (uneven, even, wrong))
        error = float(np.sqrt(np.mean((found - expected) ** 2)))
        assert error < 0.02
        assert error < 0.2 * float(np.sqrt(np.mean((other - expected) ** 2)))


def test_every_level_draws_uneven_axes_alike(tmp_path: Path) -> None:
    axis, even = UNEVEN[::2], EVEN[::2]
    values = ball(axis, even, even)[None]
    path = written(tmp_path / "u.fhz", values, FINE, z=axis, y=even, x=even)
    scene = {"size": [16, 16], "transfer_function": LINEAR}
    fine, coarse = (picture(path, **scene, march={"lod": lod}) for lod in (0, 1))
    assert np.abs(coarse - fine).mean() < 0.03


def test_a_network_is_sampled_where_uneven_axes_say(tmp_path: Path) -> None:
    axis, even = UNEVEN[::3], EVEN[::3]
    values = np.repeat(ball(even, even, axis)[None], 2, axis=0)
    config = EncodeConfig(profile="paper", features=("interval:0.3:2",), epochs=8, width=8)
    path = written(tmp_path / "p.fhz", values, config, z=even, y=even, x=axis)
    scene = {"size": [12, 12], "transfer_function": LINEAR, "effects": {"shading": True}}
    cache, arm, stream = (
        picture(path, **scene, march={"mode": mode}) for mode in ("cache", "arm", "stream")
    )
    assert cache[..., 3].max() > 0.2
    np.testing.assert_allclose(arm, stream, atol=0.01)
    assert np.abs(arm - cache).mean() < 0.03


def test_depths_are_drawn_downwards(tmp_path: Path) -> None:
    depth = np.array([5.0, 10, 50, 200, 500, 1000, 2000, 3000, 4000, 5000])
    values = np.zeros((1, 10, 12, 12))
    values[:, 0] = 1
    shown = {"opacity": [[0.0, 0.0], [0.5, 0.0], [1.0, 1.0]]}
    units = {"units": "km"}
    rest = {"y": (np.arange(12.0), units), "x": (np.arange(12.0), units)}
    rows = {}
    for positive in ("down", "up"):
        z = depth / 500, {"units": "km", "positive": positive}
        path = written(tmp_path / f"{positive}.fhz", values, FINE, z=z, **rest)
        seen = picture(path, transfer_function=shown, camera={"view": "xz"})[..., 3]
        rows[positive] = np.average(np.arange(48), weights=seen.sum(axis=1))
    assert rows["down"] < 24 < rows["up"]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_plane_is_an_opaque_picture_of_its_values(tmp_path: Path, axis: int) -> None:
    across, up = np.meshgrid(np.linspace(0, 1, 24), np.linspace(0, 1, 18))
    plane = across * up
    plane[9:, 12:] = np.nan
    values = np.expand_dims(plane, axis)[None].repeat(2, axis=0)
    values[1] *= 0.5
    coords = {
        name: np.arange(n, dtype=float) for name, n in zip("zyx", values.shape[1:], strict=True)
    }
    path = written(tmp_path / "f.fhz", values, FINE, **coords)
    shown = {"size": [96, 72], "transfer_function": {"colours": "grey"}}
    cache = picture(path, **shown)
    assert cache[40:68, 4:90, 3].min() > 0.99
    # Right and up in the picture are right and up of the axes; there the values are missing.
    assert cache[4:30, 56:92, 3].max() == 0
    brightness = cache[60, 4:90, 0]
    assert np.all(np.diff(brightness[::8]) > 0)
    assert picture(path, **shown, step=1)[60, 80, 0] < 0.7 * brightness[76]


@pytest.mark.parametrize("shape", [(1, 1, 9), (1, 9, 1), (9, 1, 1), (1, 1, 1)])
def test_lines_and_points_are_seen(tmp_path: Path, shape: tuple[int, int, int]) -> None:
    values = np.linspace(1, 2, int(np.prod(shape))).reshape((1, *shape))
    coords = {name: np.arange(n, dtype=float) for name, n in zip("zyx", shape, strict=True)}
    seen = picture(written(tmp_path / "l.fhz", values, FINE, **coords))[..., 3]
    assert seen.max() > 0.99
    assert (seen > 0.99).sum() >= 45
