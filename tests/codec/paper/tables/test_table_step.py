"""The coding of a level: components that keep its embeddings, one step for all."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import fhash_codec
from fhash_codec import FhashWarning, QualityError
from fhash_codec.paper.storage import mix_components
from fhash_codec.paper.table_step import (
    MAX_LOSS,
    StepSearch,
    Window,
    choose_codings,
    squared_weights,
)
from fhash_codec.paper.tables import CoarseTable, components_of, tile_region
from fhash_formats.container import Container


@pytest.mark.parametrize(("length", "resolution"), [(1, 1), (5, 3), (5, 5), (9, 2), (20, 7)])
def test_squared_weights_are_those_of_the_interpolation(length, resolution) -> None:
    position = np.arange(length) * (resolution - 1) / max(length - 1, 1)
    # Vertex r of the level weighs 1 - |position - r| where that is positive.
    weights = np.maximum(1 - np.abs(position[:, None] - np.arange(resolution)), 0)
    assert squared_weights(length, resolution) == pytest.approx((weights**2).sum(axis=1).mean())


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


def decoded(path) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return volume[...]


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


def test_by_default_coded_tables_have_few_levels_and_take_fewer_bytes(
    rough_waves, coded_config, tmp_path
) -> None:
    source = rough_waves
    config = replace(coded_config, epochs=30, psnr=38.0)
    published = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    config = replace(config, fold=0, embedding_size=0)
    figures = fhash_codec.encode(source, tmp_path / "b.fhz", config)
    assert 38.0 <= figures["psnr"] < 38.1
    assert figures["bytes"] < 0.75 * published["bytes"]
    with fhash_codec.open(tmp_path / "b.fhz") as volume:
        model = volume.info["model"]
        assert (model["fold"], model["embedding_size"]) == (8, 1)
        assert model["levels"] == [[5, 9, 12, 20], [2, 2, 2, 3]]
        assert volume.info["config"]["fold"] == 0


def test_training_goes_on_for_a_promise(rough_waves, coded_config, tmp_path) -> None:
    config = replace(coded_config, epochs=10)
    free = fhash_codec.encode(rough_waves, tmp_path / "a.fhz", config)
    wanted = free["psnr"] + 1.0
    with pytest.warns(FhashWarning, match=r"training goes on for \d+ epochs"):
        figures = fhash_codec.encode(rough_waves, tmp_path / "b.fhz", replace(config, psnr=wanted))
    assert wanted <= figures["psnr"] < wanted + 0.1
    with fhash_codec.open(tmp_path / "b.fhz") as volume:
        assert volume.info["training"]["epochs"] > 10


@pytest.mark.parametrize(
    "shape", [(1, 1, 1, 1), (3, 1, 1, 1), (1, 1, 1, 7), (2, 2, 2, 2), (7, 3, 5, 11)]
)
def test_every_shape_comes_back(coded_config, tmp_path, shape) -> None:
    source = np.random.default_rng(0).random(shape, dtype=np.float32)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", coded_config)
    back = decoded(tmp_path / "a.fhz")
    assert back.shape == shape
    assert np.isfinite(back).all()
    assert figures["max_abs_error"] == pytest.approx(np.abs(back - source).max(), rel=1e-5)


def test_a_constant_series_comes_back_exactly(coded_config, tmp_path) -> None:
    figures = fhash_codec.encode(np.full((3, 4, 5, 6), 7.25), tmp_path / "a.fhz", coded_config)
    assert (decoded(tmp_path / "a.fhz") == 7.25).all()
    assert figures["rmse"] == 0


def test_the_same_input_gives_the_same_bytes(waves, coded_config, tmp_path) -> None:
    for name in ("a.fhz", "b.fhz"):
        fhash_codec.encode(
            waves((3, 6, 7, 8)), tmp_path / name, replace(coded_config, epochs=2, timings=False)
        )
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()


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


def test_a_course_that_is_no_power_takes_a_few_more_trials() -> None:
    window = Window.of(1e-6, 3e-5, 0.05)
    # The error bends twice, as that of tables does in which whole levels become zero.
    search, _ = searched(
        window,
        lambda step: 1e-6 + 2e-5 * math.tanh(step) ** 2 + 1e-5 * max(step - 2, 0.0) ** 3,
        1e-3,
    )
    assert search.done
    assert search.best is not None
    assert search.best > 2


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


@pytest.mark.parametrize(("exact", "width"), [(0.0, 0.05), (9.99e-6, 0.00217), (1e-6, 0.05)])
def test_a_window_leaves_room_for_what_coding_adds(exact, width) -> None:
    window = Window.of(exact, 1e-5, 0.05)
    assert exact < window.least < window.allowed == 1e-5
    assert 10 * math.log10(window.allowed / window.least) == pytest.approx(width, rel=0.01)
    assert 0 < window.aim < window.allowed - exact
