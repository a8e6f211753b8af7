"""Gradients, shadows and occlusion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from frame_field import frame_of, table_of, task_of

import fhash_codec
from fhash_codec import Renderer, Scene, Volume
from fhash_codec.rendering import light as light_module
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.light import (
    DEVIATIONS,
    FLATTEST,
    QUIETEST,
    STEEPEST,
    coding_noise,
    factors_at_vertices,
    flatness,
    light_grid,
    slope_scale,
    smoothing,
)
from fhash_codec.rendering.march_task import GRADES, Grading
from fhash_codec.rendering.plan import plan_picture
from fhash_codec.rendering.scenes import AmbientOcclusion, Shadows
from fhash_formats.errors import InputError


def grid(*spacing: float) -> Grid:
    return Grid(counts=(9, 9, 9), origin=np.zeros(3), spacing=np.array(spacing))


def test_no_gradient_is_too_steep_to_be_squared_in_float32() -> None:
    factors = slope_scale(grid(1e-14, 1, 1), 1e-30, 0.0, 10.0)
    assert np.abs(factors).max() * 10.0 <= STEEPEST
    assert np.isfinite(np.float32(STEEPEST) ** 2)


def test_noise_of_rounding_is_not_lit() -> None:
    assert flatness(0.0, 1.0, 0.0, 1.0) == (1.0, FLATTEST)
    span, floor = flatness(1000.0, 1001.0, 1000.0, 1001.0)
    assert span == 1.0
    # Half of a unit in the last place of 1001 in float32, in both of two values.
    assert floor >= float(np.spacing(np.float32(1001)))
    assert flatness(5.0, 5.0, 5.0, 5.0)[0] == pytest.approx(1.0)


def test_errors_of_coding_are_not_lit() -> None:
    assert flatness(0.0, 4.0, 0.0, 4.0, 1e-9)[1] == FLATTEST
    quiet = flatness(0.0, 4.0, 0.0, 4.0, 4 * QUIETEST)
    assert quiet == (4.0, QUIETEST)
    # Above it the noise that smoothing leaves counts, and it grows with the noise to the end.
    floors = [flatness(0.0, 4.0, 0.0, 4.0, 4 * share)[1] for share in (0.0011, 0.02, 0.5, 100.0)]
    assert floors == sorted(floors)
    assert floors[0] < floors[1] <= QUIETEST * (1 + 1e-12)
    assert floors[3] <= 1.0


def test_values_are_smoothed_as_far_as_their_noise_needs() -> None:
    assert smoothing(4.0, 4 * QUIETEST) == 0.0
    assert smoothing(4.0, 4 * QUIETEST * 1.001) == DEVIATIONS[0]
    deviations = [smoothing(4.0, 4 * share) for share in (0.003, 0.01, 0.02)]
    assert deviations == sorted(set(deviations))
    assert DEVIATIONS[0] < deviations[0] < deviations[2] < DEVIATIONS[1]
    assert smoothing(4.0, 400.0) == DEVIATIONS[1]


LINEAR = Grading(factors=np.linspace(0.0, 1.0, GRADES + 1), top=2.0)


def test_a_gradient_is_a_share_of_the_range_in_the_distance_of_two_vertices(volume: Volume) -> None:
    scene = {"transfer_function": {"gradient_opacity": [[0.1, 0.2], [0.5, 1]]}}
    for scale in (1.0, 3.0):
        plan = Renderer(volume).plan(Scene.from_dict({**scene, "scale": [scale] * 3}))
        grading = plan.task.grading
        assert grading is not None
        assert grading.top == pytest.approx(
            0.5 * (volume.value_range.high - volume.value_range.low) / scale
        )
        np.testing.assert_allclose(grading.factors[[0, 205, 1024]], [0.2, 0.2, 1.0], atol=1e-3)
    assert Renderer(volume).plan(Scene()).task.grading is None


def test_factors_at_vertices_are_those_of_their_gradients() -> None:
    z, y, x = np.mgrid[:5, :6, :7].astype(np.float32)
    slope = np.ascontiguousarray(0.5 * x - 0.3 * y + 0.4 * z)
    spacing = np.array([1.0, -0.5, 2.0])
    steep = np.sqrt(0.5**2 + 0.6**2 + 0.2**2)
    np.testing.assert_allclose(factors_at_vertices(slope, LINEAR, spacing), steep / 2, atol=1e-5)
    assert np.all(factors_at_vertices(40 * slope, LINEAR, spacing) == 1)
    assert np.all(factors_at_vertices(np.ones((1, 1, 1), np.float32), LINEAR, spacing) == 0)


def test_neighbours_that_are_missing_do_not_count() -> None:
    row = np.array([[[0.0, 1.0, np.nan, 5.0, np.nan, np.nan, 8.0, 9.0]]], dtype=np.float32)
    factors = factors_at_vertices(row, LINEAR, np.ones(3))[0, 0]
    np.testing.assert_allclose(factors, [0.5, 0.5, 0, 0, 0, 0, 0.5, 0.5], atol=1e-6)


def test_gradients_near_zero_are_all_beyond_the_last_factor_or_zero(volume: Volume) -> None:
    """Their inverse would be infinite, and infinity times a gradient of 0 is no number."""
    scene = Scene.from_dict({"transfer_function": {"gradient_opacity": [[0, 0], [5e-324, 1]]}})
    grading = Renderer(volume).plan(scene).task.grading
    assert grading is not None
    assert grading.top > 0
    row = np.array([[[3.0, 3.0, 3.0, 4.0]]], dtype=np.float32)
    for spacing in (np.ones(3), np.full(3, 1e-30)):
        assert factors_at_vertices(row, grading, spacing).tolist() == [[[0, 0, 1, 1]]]


UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("resolution", [1.0, 2.0])
@pytest.mark.parametrize("spacing", [1.0, -0.5])
def test_the_shadow_within_a_slab_is_its_closed_form(resolution, spacing) -> None:
    shape = (41, 9, 9)
    settings = Shadows(strength=0.75, resolution=resolution)
    lamp = UP * np.sign(spacing)
    light = light_grid(
        frame_of(np.ones(shape)),
        task_of(shape, table_of([0.05, 0.05]), (1, 1, spacing)),
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
        task_of(values.shape, table_of([0.0, 5.0])),
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
        frame_of(values), task_of(values.shape, table_of([0.0, 50.0])), ambient_occlusion=settings
    )
    around = light.shares[:, 10, 10, 1]
    assert np.all(light.shares[..., 0] == 1)
    assert around[5] == pytest.approx(0.5, abs=0.01)
    assert around[-4] == pytest.approx(1.0, abs=0.01)
    assert np.all(np.diff(around[2:-2]) >= -1e-6)


def test_nothing_that_takes_light_leaves_all_of_it() -> None:
    for table in (None, table_of([0.0, 0.0])):
        light = light_grid(
            frame_of(np.ones((5, 5, 5))), task_of((5, 5, 5), table), shadows=Shadows(), lamp=UP
        )
        assert np.all(light.shares == 1)
        assert light.secondary_rays == 0


def test_shadows_need_a_lamp() -> None:
    with pytest.raises(InputError, match="lamp"):
        light_grid(
            frame_of(np.ones((5, 5, 5))),
            task_of((5, 5, 5), table_of([1.0, 1.0])),
            shadows=Shadows(),
        )


def test_opacity_by_gradient_takes_as_little_light_as_it_draws() -> None:
    # A ball of even values inside and outside: only its rim has a gradient.
    z, y, x = np.mgrid[-15:16, -15:16, -15:16]
    ball = np.where(np.sqrt(x * x + y * y + z * z) < 9, 1.0, 0.0)

    def lit(grading):
        task = task_of(ball.shape, table_of([0.0, 0.2]), grading=grading)
        shadows = Shadows(strength=1.0, resolution=1.0)
        return light_grid(frame_of(ball), task, shadows=shadows, lamp=UP).shares[..., 0]

    def shares(factors):
        return lit(Grading(factors=np.array(factors), top=0.4))

    whole = lit(None)
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
            task_of(values.shape, table, grading=grading),
            shadows=Shadows(resolution=1.0),
            lamp=lamp,
            ambient_occlusion=AmbientOcclusion(radius=radius),
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


def test_the_errors_of_a_bounded_file_are_noise(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random((1, 12, 12, 12)).astype(np.float32)
    for config, factor in (({"max_error": 0.1}, 2), ({"max_error_rel": 0.1}, 2), ({"psnr": 30}, 0)):
        path = tmp_path / "a.fhz"
        fhash_codec.encode(values, path, fhash_codec.EncodeConfig(effort=1, **config))
        with fhash_codec.open(path) as volume:
            largest = volume.container.header["quality"]["max_abs_error"]
            assert largest > 0.01
            assert coding_noise(volume) == pytest.approx(factor * largest)
            assert plan_picture(volume, Scene()).task.noise == pytest.approx(factor * largest)
        path.unlink()
