"""Gradients, shadows and occlusion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frame_field import frame_of, table_of, waves
from frame_field import task_of as plain_task
from numpy.lib.stride_tricks import sliding_window_view
from rarely import rarely

import fhash_codec
from fhash_codec import Renderer, Scene, Volume, native
from fhash_codec.rendering import light as light_module
from fhash_codec.rendering.bricks import FARTHEST, SIDE, Bricks, cells_of, limits_of, smoothed
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
from fhash_codec.rendering.march import (
    MAX_MAGNITUDE,
    TILE,
    MarchInput,
    march_native,
    structure_of,
)
from fhash_codec.rendering.march_task import GRADES, Grading, Lighting, Surface
from fhash_codec.rendering.plan import plan_picture
from fhash_codec.rendering.scenes import AmbientOcclusion, Camera, Shadows
from fhash_codec.rendering.view import Body


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


def lit(values, extinctions, spacing=(1.0, 1.0, 1.0), **more):
    """The light of a frame in a table of extinctions."""
    task = plain_task(values.shape, table_of(extinctions), spacing)
    return light_grid(frame_of(values), task, **more)


@pytest.mark.parametrize("resolution", [1.0, 2.0])
@pytest.mark.parametrize("spacing", [1.0, -0.5])
def test_the_shadow_within_a_slab_is_its_closed_form(resolution, spacing) -> None:
    shape = (41, 9, 9)
    settings = Shadows(strength=0.75, resolution=resolution)
    lamp = UP * np.sign(spacing)
    light = lit(np.ones(shape), [0.05, 0.05], (1, 1, spacing), shadows=settings, lamp=lamp)
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
    light = lit(values, [0.0, 5.0], shadows=Shadows(strength=1.0, resolution=1.0), lamp=lamp)
    lamp_share = light.shares[..., 0]
    assert lamp_share[10, 20, 10] < 0.01
    assert lamp_share[30, 20, 30] > 0.99
    assert lamp_share[10, 20, 30] > 0.99
    assert lamp_share[10, 30, 10] > 0.99


def test_surroundings_take_light_only_where_there_are_any() -> None:
    values = np.zeros((40, 40, 40))
    values[:20] = 1.0
    settings = AmbientOcclusion(strength=0.5, radius=6.0)
    light = lit(values, [0.0, 50.0], ambient_occlusion=settings)
    around = light.shares[:, 10, 10, 1]
    assert np.all(light.shares[..., 0] == 1)
    assert around[5] == pytest.approx(0.5, abs=0.01)
    assert around[-4] == pytest.approx(1.0, abs=0.01)
    assert np.all(np.diff(around[2:-2]) >= -1e-6)


def test_nothing_that_takes_light_leaves_all_of_it() -> None:
    for table in (None, table_of([0.0, 0.0])):
        task = plain_task((5, 5, 5), table)
        light = light_grid(frame_of(np.ones((5, 5, 5))), task, shadows=Shadows(), lamp=UP)
        assert np.all(light.shares == 1)
        assert light.secondary_rays == 0


def test_opacity_by_gradient_takes_as_little_light_as_it_draws() -> None:
    # A ball of even values inside and outside: only its rim has a gradient.
    z, y, x = np.mgrid[-15:16, -15:16, -15:16]
    ball = np.where(np.sqrt(x * x + y * y + z * z) < 9, 1.0, 0.0)

    def lit(grading):
        task = plain_task(ball.shape, table_of([0.0, 0.2]), grading=grading)
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
            plain_task(values.shape, table, grading=grading),
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


def bricks_of(values):
    return Bricks.of(frame_of(values))


def task_of(shape, extinctions, surfaces=()):
    return plain_task(shape, table_of(extinctions), surfaces=surfaces)


@pytest.mark.parametrize("shape", [(20, 17, 33), (9, 8, 10), (1, 30, 2), (1, 1, 1), (70, 70, 70)])
def test_a_brick_has_the_extremes_of_its_vertices(shape) -> None:
    values = np.random.default_rng(3).normal(size=shape).astype(np.float32)
    values[values > 1.5] = np.nan
    bricks = bricks_of(values)
    for at in np.ndindex(bricks.low.shape):
        part = values[tuple(slice(i * SIDE, i * SIDE + SIDE + 1) for i in at)]
        known = part[~np.isnan(part)]
        assert bricks.low[at] == (known.min() if known.size else np.inf)
        assert bricks.high[at] == (known.max() if known.size else -np.inf)
    assert all(
        count == max(-(-(size - 1) // SIDE), 1)
        for count, size in zip(bricks.low.shape, shape, strict=True)
    )


def test_bricks_matter_where_something_can_be_seen() -> None:
    values = np.zeros((33, 33, 33))
    values[22, 2, 10] = 1.0
    values[2, 26, 26] = 0.4
    bricks = bricks_of(values)
    peak = task_of(values.shape, [0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    assert np.argwhere(bricks.matters(peak)).tolist() == [[5, 0, 2]]
    surface = Surface(value=0.3, colour=np.ones(3), opacity=1.0)
    assert bricks.matters(task_of(values.shape, [0.0, 0.0], (surface,))).sum() == 2
    assert not bricks.matters(task_of(values.shape, [0.0, 0.0])).any()
    assert bricks.matters(task_of(values.shape, [1.0, 0.0])).all()


def test_the_distance_is_that_to_the_nearest_brick_that_matters() -> None:
    values = np.zeros((60, 50, 90))
    for z, y, x in ((4, 4, 4), (50, 20, 60), (33, 44, 85)):
        values[z, y, x] = 1.0
    bricks, task = bricks_of(values), task_of(values.shape, [0.0, 0.0, 1.0])
    matters = np.argwhere(bricks.matters(task))
    every = np.array(list(np.ndindex(bricks.low.shape)))
    exact = np.abs(every[:, None] - matters).max(axis=2).min(axis=1)
    assert np.array_equal(bricks.distance(task).ravel(), exact)
    assert np.all(bricks.distance(task_of(values.shape, [0.0, 0.0])) == FARTHEST)


def values(shape: tuple[int, int, int], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


@pytest.mark.parametrize("error", [0.0, 0.01, 0.2])
def test_smoothed_values_stay_within_the_error(error: float) -> None:
    noise = values((9, 11, 20))
    noise[3, 4, 5] = np.nan
    free, found = smoothed(noise, 1.5), smoothed(noise, 1.5, error)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(noise))
    assert np.nanmax(np.abs(free - noise)) > error
    assert np.nanmax(np.abs(found - noise)) <= error + 1e-6
    near = np.abs(free - noise) <= error
    np.testing.assert_allclose(found[near], free[near], atol=1e-6)


def test_errors_cancel_and_what_is_larger_than_they_are_stays() -> None:
    """A plateau with errors becomes flat; a step beside it keeps its height between neighbours."""
    step = np.zeros((16, 16, 16), np.float32)
    step[..., 8:] = 1
    bounded = step + (0.02 * values(step.shape) - 0.01).astype(np.float32)
    free, found = smoothed(bounded, 2.5), smoothed(bounded, 2.5, 0.01)
    plateau = (slice(4, -4), slice(4, -4), slice(0, 3))
    assert np.ptp(found[plateau]) < 0.5 * np.ptp(bounded[plateau])
    heights = found[4:-4, 4:-4, 8] - found[4:-4, 4:-4, 7]
    assert heights.min() > 0.95
    assert (free[..., 8] - free[..., 7]).max() < 0.5


def noise(shape, share_missing=0.0):
    rng = np.random.default_rng(sum(shape))
    values = rng.uniform(0, 0.4, shape).astype(np.float32)
    values[rng.random(shape) < 0.04] = 0.9
    values[rng.random(shape) < share_missing] = np.nan
    return values


def test_limits_lie_around_what_is_seen() -> None:
    values = np.linspace(0, 1, 64).reshape(4, 4, 4)
    bricks = bricks_of(values)
    steps = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 2.0, 3.0]
    np.testing.assert_allclose(
        limits_of(bricks, task_of(values.shape, steps)), [[0.125, 0.375], [0.75, np.inf]]
    )
    # What touches is one.
    np.testing.assert_allclose(
        limits_of(bricks, task_of(values.shape, [1.0, 0.0, 1.0, 0.0, 0.0])), [[-np.inf, 0.75]]
    )
    surface = Surface(value=0.6, colour=np.ones(3), opacity=1.0)
    found = limits_of(bricks, task_of(values.shape, [0.0, 0.0], (surface,)))
    assert found.shape == (1, 2)
    assert found[0, 0] < 0.6 < found[0, 1]
    assert found[0, 1] - found[0, 0] < 1e-5
    assert limits_of(bricks, task_of(values.shape, [0.0, 0.0])).shape == (0, 2)


@pytest.mark.parametrize("shape", [(9, 9, 9), (17, 20, 23), (1, 22, 30), (6, 1, 40), (2, 2, 2)])
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_a_bit_is_set_where_values_of_the_cell_reach_what_is_seen(shape, missing) -> None:
    library = native.library()
    values = noise(shape, missing)
    values[-1, -1, -1] = 0.9
    bricks = bricks_of(values)
    for extinctions, surfaces in (
        ([0.0] * 8 + [1.0] * 3, ()),
        ([0.0] * 8 + [1.0] * 3, (Surface(value=0.97, colour=np.ones(3), opacity=1.0),)),
        (
            [0.0, 0.0],
            (
                Surface(value=0.395, colour=np.ones(3), opacity=1.0),
                Surface(value=0.41, colour=np.ones(3), opacity=1.0),
            ),
        ),
    ):
        task = task_of(shape, extinctions, surfaces)
        cells = cells_of(library, bricks, task, bricks.distance(task))
        limits = limits_of(bricks, task)
        padded = np.pad(values, [(0, int(size == 1)) for size in shape], mode="edge")
        corners = sliding_window_view(padded, (2, 2, 2)).reshape(
            *(max(size - 1, 1) for size in shape), 8
        )
        low, high = (
            np.where(np.isnan(corners), np.inf, corners).min(-1),
            np.where(np.isnan(corners), -np.inf, corners).max(-1),
        )
        exact = np.any(
            [(high > first) & (low < stop) & (low <= high) for first, stop in limits], axis=0
        )
        if cells is None:
            assert exact.mean() > 0.3
            continue
        z, y, x = np.indices(exact.shape)
        bits = (
            cells[z // 4, y // 4, x // 4, z // 2 % 2]
            >> (z % 2 * 16 + y % 4 * 4 + x % 4).astype(np.uint32)
            & 1
        )
        np.testing.assert_array_equal(bits.astype(bool), exact)


def test_where_most_cells_are_seen_they_are_not_looked_for() -> None:
    library = native.library()
    values = noise((17, 17, 17))
    bricks = bricks_of(values)
    for extinctions in ([1.0, 1.0], [0.0, 0.0], [0.0, 1.0] * 20 + [0.0, 0.0, 1.0] * 20):
        task = task_of(values.shape, extinctions)
        assert cells_of(library, bricks, task, bricks.distance(task)) is None


SOURCES = Path(native.__file__).parent


def test_both_sides_have_the_same_tiles() -> None:
    assert f" TILE = {TILE};" in (SOURCES / "march_packet.hpp").read_text(encoding="utf-8")


def test_a_structure_refuses_arrays_of_another_type() -> None:
    values = np.arange(1000, dtype=np.float32)
    structure = structure_of({"values": values, "depth": None, "eye": np.arange(1.0, 4)})
    assert structure.values[999] == 999
    assert not structure.depth
    assert list(structure.eye) == [1.0, 2.0, 3.0]
    with pytest.raises(TypeError, match="'float \\*' must be a pointer to same type"):
        structure_of({"values": np.zeros(3)})
    with pytest.raises(ValueError, match="not C-contiguous"):
        structure_of({"depth": np.zeros((4, 4), dtype=np.float32)[:, ::2]})


COUNTS = (21, 17, 13)


def input_of(values: Any, low: float, high: float, level: float, **place: Any) -> MarchInput:
    """The input for a frame of values, a table and a surface."""
    frame = frame_of(values, **place)
    surfaces = (Surface(value=level, colour=np.ones(3), opacity=1.0),)
    table = table_of([1.0, 1.0], low, high)
    more = {"camera": Camera(), "size": (4, 4), "surfaces": surfaces}
    task = plain_task(COUNTS[::-1], table, (1.0, 2.0, -3.0), **more)
    return MarchInput.of(frame, task, Bricks.of(frame))


def test_places_of_the_domain_are_those_of_the_frame() -> None:
    values = np.zeros((3, 4, 5))
    whole = input_of(np.zeros(COUNTS[::-1]), 0.0, 1.0, 0.5, first=(0, 0, 0))
    part = input_of(values, 0.0, 1.0, 0.5, first=(2, 4, 6), stride=2)
    shift = np.array([6.0, 4.0, 2.0])
    part, whole = part.fields, whole.fields
    np.testing.assert_array_equal(part["eye"], (whole["eye"] - shift) / 2)
    np.testing.assert_array_equal(part["forward"], whole["forward"] / 2)
    np.testing.assert_array_equal(part["box"], (whole["box"] - shift[:, None]) / 2)
    np.testing.assert_array_equal(part["spacing"], 2 * whole["spacing"])
    np.testing.assert_array_equal(part["seen"], [[0, 4], [0, 3], [0, 2]])


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1e38), (-3e38, 3e38), (0.0, 1e-30), (2.0**-130, 2.0**-129)]
)
def test_values_are_scaled_to_what_float32_can_compute_with(low: float, high: float) -> None:
    shares = np.linspace(0, 1, 27).reshape(3, 3, 3)
    given = input_of(low + shares * (high - low), low, high, (low + high) / 2, first=(0, 0, 0))
    assert 1e-28 < given.high - given.low < MAX_MAGNITUDE
    scaled = (given.fields["values"] - given.low) / (given.high - given.low)
    np.testing.assert_allclose(scaled, shares, atol=1e-5)
    assert given.fields["surface"][0, 0] == pytest.approx((given.low + given.high) / 2)


CENTRAL = Lighting(
    ambient=0.2, diffuse=0.8, specular=0.3, specular_power=8.0, lamp=None, central=True
)
CELL = replace(CENTRAL, central=False)
WHITE = np.ones(3)
GRADING = Grading(factors=np.interp(np.arange(1025), [0, 300, 900], [0, 1, 0.3]), top=0.2)
BODY = Body(
    bounds=np.array([[-0.5, 17.3], [-0.5, 40], [-0.5, 40]]),
    planes=np.array([[-0.6, 0.8, 0, -4.5], [0, 0.6, -0.8, -7.25]]),
)
PATHS = {"quickest": 0, "AVX2": 1, "plain": 2}


@pytest.fixture(params=PATHS)
def path(request):
    return PATHS[request.param]


def marched(values, task, path=0, first=(0, 0, 0)):
    frame = frame_of(values, first=first)
    return march_native(frame, task, Bricks.of(frame), path=path)


def task_of_native_march(shape, extinctions, **more):
    table = None if extinctions is None else table_of(extinctions, colour=(0.9, 0.6, 0.3))
    given = {"camera": Camera(azimuth=20.0), "size": (20, 18), "lighting": CENTRAL, **more}
    return plain_task(shape, table, **given)


CASES = {
    "fog": {},
    "shaded": {"shaded": True, "lighting": CELL, "depth": True, "normal": True},
    "central": {"shaded": True, "antialiasing": 2},
    "jitter": {"jitter": True, "step": 1.7},
    "surfaces": {"shaded": True, "surfaces": (Surface(value=0.62, colour=WHITE, opacity=0.4),)},
    "maximum": {"projection": "maximum", "depth": True},
    "minimum": {"projection": "minimum", "depth": True},
    "average": {"projection": "average", "depth": True, "extinctions": [1.0] * 100},
    "attenuated": {"projection": "attenuated", "attenuation": 0.4, "depth": True},
    "graded": {"shaded": True, "grading": GRADING},
    "graded fog": {
        "grading": GRADING,
        "surfaces": (Surface(value=0.62, colour=WHITE, opacity=0.4),),
    },
    "clipped": {"shaded": True, "body": BODY},
    "narrow": {"extinctions": [0.0] * 50 + [1.0] * 3 + [0.0] * 50},
}


@pytest.mark.parametrize("shape", [(14, 17, 22), (1, 30, 30), (30, 30, 1)])
@pytest.mark.parametrize("case", CASES)
def test_all_paths_make_one_picture(path, case, shape) -> None:
    values = waves(shape)
    more = {
        "extinctions": np.concatenate([np.zeros(40), np.linspace(0, 0.4, 60)]),
        "size": (37, 29),
        **CASES[case],
    }
    for first, counts in (((0, 0, 0), shape), ((0, 2, 0), (shape[0], shape[1] + 5, shape[2]))):
        task = task_of_native_march(counts, **more)
        quickest, found = marched(values, task, 0, first), marched(values, task, path, first)
        assert found.rgba[..., 3].max() > 0.01
        np.testing.assert_allclose(found.rgba, quickest.rgba, atol=2e-4)
        for name in ("rays", "samples"):
            assert found.counters[name] == pytest.approx(quickest.counters[name], rel=0.01)
        if task.depth:
            np.testing.assert_array_equal(np.isfinite(found.depth), np.isfinite(quickest.depth))


def test_all_paths_make_one_picture_in_a_grid_of_light(path) -> None:
    values = waves((14, 17, 22))
    for shaded in (False, True):
        task = task_of_native_march(values.shape, np.linspace(0, 0.4, 100), shaded=shaded)
        frame = frame_of(values)
        light = light_grid(frame, task, shadows=Shadows(), lamp=np.array([0, 0, 1.0]))
        task = replace(task, light=light)
        np.testing.assert_allclose(
            marched(values, task, path).rgba, marched(values, task).rgba, atol=2e-5
        )


@pytest.mark.parametrize("step", [0.5, 3.9, *rarely(0.3, 0.9, 2.5, 7.0)])
@pytest.mark.parametrize("jitter", [False, True])
def test_no_surface_is_lost_by_skipping(path, step, jitter) -> None:
    values = waves((27, 30, 38), pace=2.0)
    samples = []
    for camera in (Camera(azimuth=20.0, elevation=10.0), Camera(view="xy", projection="parallel")):
        for level in (0.52, 0.9):
            surface = Surface(value=level, colour=WHITE, opacity=0.5)
            task = task_of_native_march(
                values.shape,
                None,
                camera=camera,
                size=(80, 70),
                step=step,
                jitter=jitter,
                surfaces=(surface,),
            )
            found, everything = (
                marched(values, task, path),
                marched(values, replace(task, skipping=False), path),
            )
            np.testing.assert_allclose(found.rgba, everything.rgba, atol=1e-5)
            samples.append(found.counters["samples"] / everything.counters["samples"])
    if step < 1:
        assert max(samples) < 0.9
