"""The coding of a level: components that keep its embeddings, one step for all."""

from __future__ import annotations

import json
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
)
from fhash_codec.paper.tables import CoarseTable, components_of, tile_region
from fhash_formats.container import Container


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
