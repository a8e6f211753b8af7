"""Shadows and surroundings against closed forms, and the native library against numpy."""

import numpy as np
import pytest

from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.scene.scene import AmbientOcclusion, Shadows
from fhash_codec.rendering.task import light as light_module
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.light import light_grid
from fhash_codec.rendering.task.task import GRADES, Frame, Grading, Table
from fhash_formats.errors import InputError

UP = np.array([0.0, 0.0, 1.0])


def frame_of(values, stride=1):
    return Frame(values=np.asarray(values, dtype=np.float32), first=(0, 0, 0), stride=stride)


def grid_of(shape, spacing=(1.0, 1.0, 1.0)):
    return Grid(counts=shape[::-1], origin=np.zeros(3), spacing=np.array(spacing))


def table_of(extinctions):
    return Table(
        low=0.0,
        high=1.0,
        colours=np.ones((len(extinctions), 3), dtype=np.float32),
        extinctions=np.array(extinctions),
    )


@pytest.mark.parametrize("resolution", [1.0, 2.0])
@pytest.mark.parametrize("spacing", [1.0, -0.5])
def test_the_shadow_within_a_slab_is_its_closed_form(resolution, spacing) -> None:
    shape = (41, 9, 9)
    settings = Shadows(strength=0.75, resolution=resolution)
    lamp = UP * np.sign(spacing)
    light = light_grid(
        frame_of(np.ones(shape)),
        grid_of(shape, (1, 1, spacing)),
        table_of([0.05, 0.05]),
        shadows=settings,
        lamp=lamp,
    )
    depth = (40 - np.arange(light.shares.shape[0]) * light.cell) * abs(spacing)
    exact = 1 - 0.75 * (1 - np.exp(-0.05 * depth))
    middle = light.shares[:, light.shares.shape[1] // 2, light.shares.shape[2] // 2]
    np.testing.assert_allclose(middle[:, 0], exact, atol=1e-4)
    assert np.all(middle[:, 1] == 1)
    assert light.cell == resolution
    assert light.secondary_rays == light.shares[..., 0].size


def test_a_block_throws_its_shadow_away_from_the_lamp() -> None:
    values = np.zeros((40, 40, 40))
    values[18:22, 18:22, 18:22] = 1.0
    lamp = np.array([1.0, 0.0, 1.0]) / np.sqrt(2)
    light = light_grid(
        frame_of(values),
        grid_of(values.shape),
        table_of([0.0, 5.0]),
        shadows=Shadows(strength=1.0, resolution=1.0),
        lamp=lamp,
    )
    lamp_share = light.shares[..., 0]
    assert lamp_share[10, 20, 10] < 0.01
    assert lamp_share[30, 20, 30] > 0.99
    assert lamp_share[10, 20, 30] > 0.99
    assert lamp_share[10, 30, 10] > 0.99


def test_surroundings_take_light_only_where_there_are_any() -> None:
    values = np.zeros((40, 40, 40))
    values[:20] = 1.0
    settings = AmbientOcclusion(strength=0.5, radius=6.0)
    light = light_grid(
        frame_of(values), grid_of(values.shape), table_of([0.0, 50.0]), ambient_occlusion=settings
    )
    around = light.shares[:, 10, 10, 1]
    assert np.all(light.shares[..., 0] == 1)
    assert around[5] == pytest.approx(0.5, abs=0.01)
    assert around[-4] == pytest.approx(1.0, abs=0.01)
    assert np.all(np.diff(around[2:-2]) >= -1e-6)


def test_nothing_that_takes_light_leaves_all_of_it() -> None:
    for table in (None, table_of([0.0, 0.0])):
        light = light_grid(
            frame_of(np.ones((5, 5, 5))), grid_of((5, 5, 5)), table, shadows=Shadows(), lamp=UP
        )
        assert np.all(light.shares == 1)
        assert light.secondary_rays == 0


def test_shadows_need_a_lamp() -> None:
    with pytest.raises(InputError, match="lamp"):
        light_grid(
            frame_of(np.ones((5, 5, 5))),
            grid_of((5, 5, 5)),
            table_of([1.0, 1.0]),
            shadows=Shadows(),
        )


def test_opacity_by_gradient_takes_as_little_light_as_it_draws() -> None:
    # A ball of even values inside and outside: only its rim has a gradient.
    z, y, x = np.mgrid[-15:16, -15:16, -15:16]
    ball = np.where(np.sqrt(x * x + y * y + z * z) < 9, 1.0, 0.0)
    settings = {"table": table_of([0.0, 0.2]), "shadows": Shadows(strength=1.0, resolution=1.0)}
    given = frame_of(ball), grid_of(ball.shape)

    def shares(factors):
        grading = Grading(factors=np.array(factors), top=0.4)
        return light_grid(*given, **settings, lamp=UP, grading=grading).shares[..., 0]

    whole = light_grid(*given, **settings, lamp=UP).shares[..., 0]
    np.testing.assert_allclose(shares(np.ones(GRADES + 1)), whole, atol=1e-6)
    rim = shares(np.where(np.arange(GRADES + 1) < GRADES / 2, 0.0, 1.0))
    inside = shares(np.where(np.arange(GRADES + 1) < GRADES / 2, 1.0, 0.0))
    assert whole[3, 15, 15] < rim[3, 15, 15] < 1
    # What both leave is what the whole leaves, along a way through the rim and the inside.
    np.testing.assert_allclose(
        rim[3, 15, 15] * inside[3, 15, 15], whole[3, 15, 15], rtol=1e-5, atol=1e-5
    )
    assert inside[15, 15, 3] == 1


def test_light_is_computed_again_only_for_what_changes_it(monkeypatch) -> None:
    values = np.random.default_rng(5).random((9, 9, 9), dtype=np.float32)
    given, table = frame_of(values), table_of([0.0, 0.3])
    bricks = Bricks.of(given)
    sums, extinctions = [], []
    for name, calls in (("_sums", sums), ("_extinction", extinctions)):
        function = getattr(light_module, name)
        monkeypatch.setattr(
            light_module, name, lambda *a, f=function, calls=calls: calls.append(1) or f(*a)
        )

    def lit(lamp=UP, radius=3.0, table=table, grading=None, bricks=bricks):
        del sums[:], extinctions[:]
        return light_grid(
            given,
            grid_of(values.shape),
            table,
            shadows=Shadows(resolution=1.0),
            lamp=lamp,
            ambient_occlusion=AmbientOcclusion(radius=radius),
            grading=grading,
            bricks=bricks,
        ).shares

    sides = len(light_module.SIDES)
    first = lit()
    assert (len(extinctions), len(sums)) == (1, 1 + sides)
    np.testing.assert_array_equal(lit(), first)
    assert (len(extinctions), len(sums)) == (0, 0)
    moved = lit(lamp=np.array([0.0, 1.0, 0.0]))
    assert (len(extinctions), len(sums)) == (0, 1)
    np.testing.assert_array_equal(moved, lit(lamp=np.array([0.0, 1.0, 0.0]), bricks=None))
    lit(lamp=np.array([0.0, 1.0, 0.0]), radius=4.0)
    assert (len(extinctions), len(sums)) == (0, sides)
    lit(table=table_of([0.0, 0.4]))
    assert (len(extinctions), len(sums)) == (1, 1 + sides)
    lit(grading=Grading(factors=np.ones(GRADES + 1), top=1.0))
    assert len(extinctions) == 1
