"""Light on a sample: Phong's model against closed forms, and shares between points of a grid."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.stream.phong import LightAt, Phong
from fhash_codec.rendering.task.arrays import NUMPY
from fhash_codec.rendering.task.task import LightGrid, Lighting

ALONG = np.array([[0.0, 0.0, 1.0]])
GREY = np.full((1, 3), 0.5)
FULL = np.ones(1)


def lit(slope: tuple[float, float, float], lamp: np.ndarray | None = None) -> float:
    """The first channel of a grey sample that is lit along z, with a gradient."""
    lighting = Lighting(ambient=0.2, diffuse=0.7, specular=0.3, specular_power=2.0, lamp=lamp)
    phong = Phong(arrays=NUMPY, lighting=lighting, lamp=lamp, scale=np.ones(3), floor=1e-9)
    return float(phong(GREY, np.array([slope]), ALONG, FULL, FULL)[0, 0])


def test_a_surface_that_faces_the_eye_has_all_its_light() -> None:
    np.testing.assert_allclose(lit((0.0, 0.0, -5.0)), 0.5 * 0.9 + 0.3, rtol=1e-12)
    # Two-sided: a gradient that points away counts as well.
    assert lit((0.0, 0.0, 5.0)) == lit((0.0, 0.0, -5.0))


def test_a_surface_seen_from_its_edge_has_ambient_light_alone() -> None:
    np.testing.assert_allclose(lit((3.0, 0.0, 0.0)), 0.5 * 0.2, rtol=1e-12)


def test_without_a_gradient_there_is_ambient_light_alone() -> None:
    np.testing.assert_allclose(lit((0.0, 0.0, 0.0)), 0.5 * 0.2, rtol=1e-12)


def test_an_aslant_surface_follows_the_cosine() -> None:
    cosine = np.cos(0.6)
    slope = (float(np.sin(0.6)), 0.0, float(cosine))
    expected = 0.5 * (0.2 + 0.7 * cosine) + 0.3 * cosine**2
    np.testing.assert_allclose(lit(slope), expected, rtol=1e-12)


def test_light_from_behind_has_no_highlight() -> None:
    np.testing.assert_allclose(lit((0.0, 0.0, 1.0), np.array([0.0, 0.0, 1.0])), 0.5 * 0.9)


def test_shadows_take_the_light_of_the_lamp_and_surroundings_the_ambient_one() -> None:
    lighting = Lighting(ambient=0.2, diffuse=0.7, specular=0.3, specular_power=2.0, lamp=None)
    phong = Phong(arrays=NUMPY, lighting=lighting, lamp=None, scale=np.ones(3), floor=1e-9)
    slope = np.array([[0.0, 0.0, -5.0]])
    np.testing.assert_allclose(phong(GREY, slope, ALONG, 0 * FULL, FULL), 0.5 * 0.2)
    np.testing.assert_allclose(phong(GREY, slope, ALONG, FULL, 0 * FULL), 0.5 * 0.7 + 0.3)


def test_shares_of_light_are_trilinear_and_clamped() -> None:
    z, y, x = np.meshgrid(np.arange(2.0), np.arange(3.0), np.arange(4.0), indexing="ij")
    shares = np.stack([(x + 2 * y + 3 * z) / 20, np.full_like(x, 0.25)], axis=-1)
    grid = LightGrid(shares=shares.astype(np.float32), first=np.array([1.0, 0.0, 0.0]), cell=2.0)
    places = np.array([[1.0, 0.0, 0.0], [4.0, 3.0, 1.0], [99.0, 99.0, 99.0], [-9.0, -9.0, -9.0]])
    lamp, around = LightAt(grid, NUMPY)(places)
    np.testing.assert_allclose(lamp, [0.0, (1.5 + 3 + 1.5) / 20, 10 / 20, 0.0], atol=1e-7)
    np.testing.assert_allclose(around, 0.25)
