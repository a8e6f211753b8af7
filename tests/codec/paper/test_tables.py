"""Coded tables: their tiles, their loss, and the step that keeps a promise."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import fhash_codec
from fhash_codec import FhashWarning, QualityError
from fhash_codec.features import occupancy
from fhash_codec.features.occupancy import unpack
from fhash_codec.paper import tables as small_parts
from fhash_codec.paper.encode import select
from fhash_codec.paper.model import decode_region
from fhash_codec.paper.storage import finest_frame, mix_components
from fhash_codec.paper.table_step import MAX_LOSS, StepSearch, Window, choose_codings
from fhash_codec.paper.tables import (
    MIN_WEIGHTS,
    WEIGHT_STEPS,
    CoarseTable,
    Samples,
    components_of,
    quantised_layers,
    tile_region,
    tile_shape,
)
from fhash_codec.progress import silent
from fhash_formats.container import Container
from fhash_formats.series import ArraySeries


@pytest.mark.parametrize("key", range(5))
def test_regions_are_those_of_the_frame(random_model, key) -> None:
    bricks, coreset = random_model.bricks, random_model.selection.coreset
    size = random_model.selection.architecture.box_size
    box = tuple((0, n) for n in size)
    mask, values = bricks.mask(key, box), bricks.samples(key, box)
    occupied = unpack(coreset.occupancy[key], size)
    assert not (occupied & ~mask).any()
    assert (mask & ~occupied).any()  # the fringe
    assert 0 < mask.mean() < 1
    to_unit = random_model.selection.scanned.value_range.to_unit
    frame = random_model.field[(key, *(slice(low, high) for low, high in coreset.box))]
    np.testing.assert_array_equal(values[mask], to_unit(frame[mask]))
    for region in (((1, 4), (0, 3), (7, 11)), ((3, 4), (5, 6), (2, 3))):
        inner = tuple(slice(*span) for span in region)
        np.testing.assert_array_equal(bricks.mask(key, region), mask[inner])
        np.testing.assert_array_equal(bricks.samples(key, region), values[inner])
        np.testing.assert_array_equal(
            bricks.embeddings(random_model.fine, key, region),
            finest_frame(coreset, random_model.fine, key)[inner],
        )


@pytest.fixture(scope="module")
def samples(random_model) -> Samples:
    selection = random_model.selection
    tile = (2, *tile_shape(selection.architecture.levels[0])[1:3], 8)
    return Samples(selection.coreset, random_model.bricks, tile)


def test_errors_are_those_of_the_clipped_values_at_all_samples(random_model, samples) -> None:
    network = random_model.network()
    squares, count = samples.squares(network, list(samples.counts))
    box = tuple((0, n) for n in network.box_size)
    coreset = random_model.selection.coreset
    masks = [unpack(coreset.occupancy[key], network.box_size) for key in range(5)]
    # Samples of the fringe do not count: the promise is about the coreset.
    assert coreset.values.size > count == sum(int(mask.sum()) for mask in masks)
    assert sum(samples.counts.values()) == count
    direct = 0.0
    for key, mask in enumerate(masks):
        unit = np.clip(decode_region(network, key, box).astype(np.float64), 0, 1)
        error = unit - random_model.bricks.samples(key, box)
        direct += float((error[mask] ** 2).sum())
    assert squares == pytest.approx(direct)


def layers(rows: int, columns: int):
    random = np.random.default_rng(0)
    return [
        (
            random.standard_normal((rows, columns)).astype(np.float32),
            random.standard_normal(rows).astype(np.float32),
        ),
        (np.ones((1, rows), np.float32), np.zeros(1, np.float32)),
    ]


def worst(changed, original) -> float:
    return max(
        float(np.square(a - b).mean()) for (a, _), (b, _) in zip(changed, original, strict=True)
    )


@pytest.mark.parametrize("allowed", [1e-2, 1e-4, 1e-6])
def test_the_largest_step_that_is_allowed_is_taken(allowed) -> None:
    original = layers(32, MIN_WEIGHTS // 32)
    quantised, settings = quantised_layers(
        original, lambda changed: worst(changed, original), allowed
    )
    first, last = settings
    assert first is not None
    assert last is None  # too small to gain anything
    assert worst(quantised, original) <= allowed
    np.testing.assert_array_equal(quantised[1][0], original[1][0])
    np.testing.assert_array_equal(quantised[0][1], original[0][1])
    # Twice the step would have been too large.
    assert first.step > 0.8 * np.sqrt(12 * allowed) / 2 or first.step >= WEIGHT_STEPS[0] / 2


def test_layers_that_no_step_keeps_stay_as_they_are() -> None:
    original = layers(32, 32)
    quantised, settings = quantised_layers(original, lambda _: 1.0, 0.5)
    assert settings == [None, None]
    assert quantised[0][0] is original[0][0]


@pytest.mark.parametrize("vertices", [1, 5000, 1 << 22])
def test_the_mask_is_the_occupancy(tmp_path, waves, coded_config, monkeypatch, vertices) -> None:
    monkeypatch.setattr(small_parts, "MASK_VERTICES", vertices)
    config = replace(coded_config, epochs=1, features=("interval:50:150",), dilation=0)
    path = tmp_path / "a.fhz"
    fhash_codec.encode(waves(), path, config)
    coreset = select(ArraySeries(waves()), config, silent).coreset
    with Container.open(path) as container:
        assert "occupancy/bits" not in container.arrays
        mask = container.arrays["occupancy/mask"].read(
            tuple(slice(0, n) for n in container.arrays["occupancy/mask"].shape)
        )
    for step, bits in zip(mask, coreset.occupancy, strict=True):
        np.testing.assert_array_equal(step != 0, occupancy.unpack(bits, coreset.box.shape))
    with fhash_codec.open(path) as volume:
        both = volume.occupancy(0.5)
        np.testing.assert_array_equal(both, volume.occupancy(0) | volume.occupancy(1))


def decoded(path) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return volume[...]


@pytest.mark.parametrize(
    "index",
    [np.s_[3], np.s_[1:4, 2:7, 3:11, 5:17], np.s_[:, 8, ::-2, 19], np.s_[4, 3:5, 4:6, 7:9]],
    ids=str,
)
def test_a_region_is_that_slice_of_the_whole_bit_for_bit(pair, index) -> None:
    path = pair["coded"][1]
    whole = decoded(path)
    with fhash_codec.open(path) as volume:
        np.testing.assert_array_equal(volume[index], whole[index])


def test_points_and_times_between_are_as_smooth_as_before(waves, pair) -> None:
    random = np.random.default_rng(0)
    points = {
        axis: random.random(300) * (n - 1) for axis, n in zip("tzyx", waves().shape, strict=True)
    }
    with fhash_codec.open(pair["coded"][1]) as volume, fhash_codec.open(pair["exact"][1]) as other:
        values, slopes = volume.sample(**points, gradient=True)
        expected = other.sample(**points)
        finite = np.isfinite(expected)
        assert finite.sum() > 30
        np.testing.assert_array_equal(finite, np.isfinite(values))
        assert np.isfinite(slopes[finite]).all()
        span = float(np.ptp(waves()))
        assert np.sqrt(np.mean((values - expected)[finite] ** 2)) < 0.05 * span


def test_the_coreset_does_not_depend_on_what_is_not_needed(random_model) -> None:
    for table in random_model.trained[:2]:
        region = tuple(slice(0, n) for n in table.shape[:4])
        assert (~table.needed(region)).sum() > 50
    one, other = random_model.network(fill=5.0), random_model.network(fill=-7.0)
    box = tuple((0, n) for n in one.box_size)
    for key in range(5):
        mask = random_model.bricks.mask(key, box)
        np.testing.assert_array_equal(
            decode_region(one, key, box)[mask], decode_region(other, key, box)[mask]
        )


def test_components_keep_the_embeddings_and_lie_in_their_range(random_model) -> None:
    architecture = random_model.selection.architecture
    slopes = np.random.default_rng(1).standard_normal((architecture.inputs, 200), np.float32)
    samples = random_model.selection.coreset.values.size
    with ThreadPoolExecutor(2) as workers:
        codings = choose_codings(architecture, samples, random_model.trained, slopes, 0.01, workers)
    assert {settings.step for coding in codings for settings in coding.settings} == {0.01}
    for table, coding in zip(random_model.trained, codings, strict=True):
        product = coding.unmixing @ coding.mixing.T
        np.testing.assert_allclose(product, np.eye(len(product)), atol=1e-9)
        region = tile_region((0, 0, 0, 0), coding.tile, table.shape)
        components, needed = components_of(table, coding, region)
        assert needed.shape == coding.tile == components[0].shape
        inside = tuple(slice(0, axis.stop) for axis in region)
        embeddings = table.read((*region, slice(0, 2)))
        # Each of the two float32 products and the sums lose a rounding step or so.
        largest = max(float(np.abs(component).max()) for component in components)
        tolerance = 8 * np.finfo(np.float32).eps * largest * float(np.abs(coding.mixing).max())
        mixed = mix_components(components, coding.mixing)[inside]
        np.testing.assert_allclose(mixed, embeddings, atol=tolerance, rtol=1e-6)
        for component, settings in zip(components, coding.settings, strict=True):
            slack = 1e-6 * (settings.high - settings.low)
            values = component[needed]
            assert (values >= settings.low - slack).all()
            assert (values <= settings.high + slack).all()


def test_the_transform_of_a_component_suits_its_numbers(random_model) -> None:
    """A basis of their own suits a pattern whose strength changes at random."""
    architecture = random_model.selection.architecture
    slopes = np.ones((2, 200), np.float32)
    random = np.random.default_rng(0)
    pattern = random.standard_normal((16, 1, 1, 1)) * random.standard_normal((1, 8, 12, 12))
    chosen = {}
    for name, needed in (
        ("complete", np.ones(pattern.shape, bool)),
        ("part", np.broadcast_to(np.arange(12) < 9, pattern.shape)),
    ):
        both = np.stack([pattern, 0.5 * pattern], axis=-1).astype(np.float32)
        one = replace(architecture, levels=(pattern.shape,), box_size=(8, 12, 12), key_frames=16)
        with ThreadPoolExecutor(2) as workers:
            [coding] = choose_codings(
                one, pattern.size, [CoarseTable(both, needed)], slopes, 0.05, workers
            )
        chosen[name] = coding.settings[1].transform.axes
    assert chosen["complete"][0].kind == "klt"
    # Where vertices are not needed, a basis would describe them too.
    assert all(axis.basis is None for axis in chosen["part"])


@pytest.fixture(scope="module")
def rough_waves(waves) -> np.ndarray:
    """Waves with noise: their tables hold many coefficients, so that their error hardly jumps."""
    noise = np.random.default_rng(0).normal(0, 3, (5, 9, 12, 20))
    return waves() + noise.astype(np.float32)


def test_the_loss_is_within_its_limit_and_what_is_said(pair) -> None:
    (exact, _), (coded, path) = pair["exact"], pair["coded"]
    loss = exact["psnr"] - coded["psnr"]
    assert exact["tables_loss_db"] is None
    assert coded["tables_loss_db"] <= MAX_LOSS + 1e-4
    if len(coded["key_frames"]) == 5:
        assert coded["tables_loss_db"] == pytest.approx(loss, abs=2e-4)
    else:
        # The search sees key frames alone.
        between, other = (run["quality"]["between"] for run in (coded, exact))
        loss = other["psnr_key_frames"] - between["psnr_key_frames"]
        assert loss <= MAX_LOSS + 1e-3
    with fhash_codec.open(path) as volume:
        assert volume.info["model"]["tables_loss_db"] == coded["tables_loss_db"]
        assert volume.info["model"]["tables"] == "transform"
        assert volume.info["required_features"] == ["transform"]
        assert "occupancy/mask" in volume.container.arrays
        assert coded["bytes"] < 0.75 * exact["bytes"]
        assert volume.verify() == len(volume.info["arrays"])
    with fhash_codec.open(path) as volume, fhash_codec.open(pair["exact"][1]) as other:
        for t in (0, 1.5, 4):
            np.testing.assert_array_equal(volume.occupancy(t), other.occupancy(t))


@pytest.mark.parametrize("below", [1.0, 6.0])
def test_a_promise_is_kept_and_no_more(rough_waves, coded_config, tmp_path, below) -> None:
    source = rough_waves
    config = replace(coded_config, epochs=10)
    free = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    wanted = free["psnr"] - below
    figures = fhash_codec.encode(source, tmp_path / "b.fhz", replace(config, psnr=wanted))
    assert wanted <= figures["psnr"] < wanted + 0.1
    assert figures["bytes"] < free["bytes"]
    lost = free["psnr"] + free["tables_loss_db"] - figures["psnr"]
    assert figures["tables_loss_db"] == pytest.approx(lost, abs=1e-3)


def test_a_promise_out_of_reach_costs_no_bytes(waves, coded_config, tmp_path) -> None:
    config = replace(coded_config, epochs=2)
    free = fhash_codec.encode(waves(), tmp_path / "a.fhz", config)
    with (
        pytest.warns(FhashWarning, match="ends at its limit of 0 more seconds: the model has"),
        pytest.raises(QualityError, match="150 dB were asked for") as missed,
    ):
        fhash_codec.encode(
            waves(), tmp_path / "b.fhz", replace(config, psnr=150.0, train_on_seconds=0)
        )
    assert "Training ended at its limit of --train-on-seconds 0: more may help" in str(missed.value)
    assert missed.value.figures["tables_loss_db"] <= MAX_LOSS + 1e-4
    assert missed.value.figures["bytes"] <= free["bytes"] + 40  # the texts of the settings


def test_training_goes_on_for_a_promise(rough_waves, coded_config, tmp_path) -> None:
    config = replace(coded_config, epochs=10)
    free = fhash_codec.encode(rough_waves, tmp_path / "a.fhz", config)
    wanted = free["psnr"] + 1.0
    with pytest.warns(FhashWarning, match=r"training goes on for \d+ epochs"):
        figures = fhash_codec.encode(rough_waves, tmp_path / "b.fhz", replace(config, psnr=wanted))
    assert wanted <= figures["psnr"] < wanted + 0.1
    with fhash_codec.open(tmp_path / "b.fhz") as volume:
        assert volume.info["training"]["epochs"] > 10


def test_other_readers_see_what_is_needed(pair) -> None:
    with Container.open(pair["coded"][1]) as container:
        json.dumps(container.header)
        size = container.header["model"]["embedding_size"]
        names = [name for name in container.arrays if name.startswith("tables/")]
        assert len(names) == size * len(container.header["model"]["levels"])
        assert container.arrays["tables/level_1/component_1"].shape == tuple(
            container.header["model"]["levels"][0]
        )


TRIALS = 12


def searched(
    window: Window, error: Callable[[float], float], step: float, min_step: float = 1e-12
) -> tuple[StepSearch, int]:
    search = StepSearch(window, step, min_step)
    trials = 0
    while not search.done and trials < TRIALS:
        search.add(error(search.step))
        trials += 1
    return search, trials


@pytest.mark.parametrize("start", [1e-6, 1e-2, 1.0, 1e5])
@pytest.mark.parametrize("power", [1.0, 1.7, 2.0, 3.0])
@pytest.mark.parametrize("room", [0.1, 1.0, 20.0])
def test_the_search_ends_in_the_window(start, power, room) -> None:
    exact = 1e-5
    window = Window.of(exact, exact * 10 ** (room / 10), 0.05)
    search, trials = searched(window, lambda step: exact + 1e-4 * step**power, start)
    assert search.done
    assert search.best is not None
    error = exact + 1e-4 * search.best**power
    assert window.allowed * 10 ** (-0.05 / 10) <= error <= window.allowed
    assert trials <= TRIALS


def test_a_jump_over_the_window_keeps_the_allowed_side() -> None:
    window = Window.of(1e-6, 1e-5, 0.05)
    search, _ = searched(window, lambda step: 1e-6 + (1e-6 if step < 3 else 1e-3), 1.0)
    assert search.best is not None
    assert 2.0 < search.best < 3.0


def test_nothing_below_the_smallest_step_is_tried() -> None:
    window = Window.of(1e-6, 1e-5, 0.05)
    search, trials = searched(window, lambda step: 1.0, 1.0, min_step=0.5)
    assert search.best is None
    assert search.done
    assert search.step == 0.5
    assert trials < TRIALS
