"""Trials of tilings: bytes at equal quality, of a series or of boxes that stand for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planned import plan_task, waves

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact import attempt as access
from fhash_codec.compact import tilings
from fhash_codec.compact import tilings as tiling_trials
from fhash_codec.compact.attempt import PRICES, PlanTask, Tiling, region_vertices
from fhash_codec.compact.stages import first_guess, first_settings
from fhash_codec.compact.tilings import Trials, choose_tiling, largest_tile
from fhash_codec.config import ACCESSES

Values = npt.NDArray[Any]


@pytest.fixture
def workers() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(2) as pool:
        yield pool


def trials_on(
    values: Values, workers: ThreadPoolExecutor, boxes: int = 0, **promise: float
) -> Trials:
    task = plan_task(values, workers, **promise)
    guess = first_guess(task, task.blocks, first_settings(task, task.blocks))
    blocks = task.blocks
    if boxes:
        t, z, y, x = blocks.shape
        places = [(number * t // boxes, 0, 0, 0) for number in range(boxes)]
        blocks = blocks.boxes((t // boxes, z, y, x), places, [1] * boxes)
    return Trials(task, blocks, guess.settings, guess.coding)


def test_more_cuts_take_more_bytes(workers: ThreadPoolExecutor) -> None:
    trials = trials_on(waves((8, 16, 32, 32)), workers)
    trials.settle((8, 16, 16, 16))
    assert list(trials.sizes) == [(8, 16, 32, 32)]
    tiles = [(8, 16, 32, 32), (8, 8, 16, 16), (8, 8, 8, 8), (2, 8, 8, 8)]
    sizes = [trials.size(tile) for tile in tiles]
    assert sizes == sorted(sizes)


def test_all_boxes_of_a_series_take_the_bytes_of_the_series(workers: ThreadPoolExecutor) -> None:
    values = waves((8, 8, 24, 24))
    tile = (2, 8, 12, 12)
    assert trials_on(values, workers, boxes=2).size(tile) == trials_on(values, workers).size(tile)


def test_under_a_bound_one_tile_keeps_it_with_bases_that_were_fitted_again(
    workers: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Coded without the bound it would take a fraction, and all cuts would seem dear."""
    values = np.random.default_rng(2).normal(size=(4, 8, 24, 24)).astype(np.float32)
    trials = trials_on(values, workers, max_error=0.5)
    errors: list[float] = []
    original = Trials._note

    def noted(self: Trials, sample: Any, outcome: Any, settings: Any) -> None:
        errors.append(outcome.max_error)
        original(self, sample, outcome, settings)

    monkeypatch.setattr(Trials, "_note", noted)
    monkeypatch.setattr(tiling_trials, "refit", lambda _, settings: replace(settings))
    trials.settle(None)
    trials.size((4, 8, 12, 12))
    assert len(errors) == 2
    assert max(errors) <= 0.5


def shell() -> Values:
    """A plateau with a thin shell that grows unevenly; constant at the first step."""
    z, y, x = np.mgrid[:24, :24, :24].astype(np.float32)
    r = np.sqrt((z - 11.5) ** 2 + (y - 11.5) ** 2 + (x - 11.5) ** 2)
    steps = [np.ones_like(r)]
    steps += [1 + 3 * np.exp(-((r - radius) ** 2)) for radius in (2.0, 3.5, 4.0, 6.5, 7.0, 9.0)]
    return np.array(steps, np.float32)


def noise() -> Values:
    return np.random.default_rng(3).normal(size=(4, 24, 32, 32)).astype(np.float32)


KINDS: dict[str, Callable[[], Values]] = {
    "plateau with a shell": shell,
    "noise": noise,
    "one thin axis": lambda: waves((8, 2, 60, 80)),
    "many steps": lambda: waves((160, 8, 10, 12)),
    "few steps": lambda: waves((2, 40, 40, 40)),
}


def chosen(
    values: Values, wish: str, workers: ThreadPoolExecutor, **promise: Any
) -> tuple[Tiling, PlanTask]:
    task = plan_task(values, workers, **promise)
    guess = first_guess(task, task.blocks, first_settings(task, task.blocks))
    return choose_tiling(task, guess.settings, guess.coding, wish), task


@pytest.mark.parametrize("kind", KINDS)
def test_prices_of_trials_are_those_of_files(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The default costs at most a tenth more than one tile, whatever the series is like."""
    monkeypatch.setattr(access, "FAST_ENOUGH", 1 << 12)
    values = KINDS[kind]()

    def bytes_of(**options: Any) -> tuple[int, dict[str, Any]]:
        # 50 dB: at 40 the file of a few steps has 1.5 kB, most of which is no tile
        config = EncodeConfig(effort=2, psnr=50.0, without=("ssim",), **options)
        fhash_codec.encode(values, tmp_path / "a.fhz", config, force=True)
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            return volume.info["bytes"], volume.info["model"].get("tiling", {})

    size, record = bytes_of()
    assert record["tried"] >= 2
    one = bytes_of(tile="whole")[0]
    best = bytes_of(tile="x".join(map(str, record["best"])))[0]
    assert size <= 1.1 * min(one, best)
    assert size / best <= record["price"] + 0.05


def test_a_wish_is_kept_and_faster_ones_have_faster_regions(
    workers: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "FAST_ENOUGH", 1 << 10)
    values = waves((8, 16, 48, 48))
    works = []
    for wish in ACCESSES:
        tiling, task = chosen(values, wish, workers)
        assert tiling.price is not None
        assert tiling.price <= PRICES[wish]
        assert values.shape in [trial.tile for trial in tiling.trials]
        assert len(tiling.trials) <= tilings.TRIALS
        least = min(trial.size for trial in tiling.trials)
        size = next(trial.size for trial in tiling.trials if trial.tile == tiling.tile)
        assert tiling.price == size / least
        works.append(region_vertices(task.blocks.shape, tiling.tile))
    assert works == sorted(works)


def small_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a series of a million vertices a large one."""
    for module in (tilings, access):
        monkeypatch.setattr(module, "MAX_WHOLE_VERTICES", 1 << 19)
    monkeypatch.setattr(tilings, "MAX_VERTICES", 1 << 18)
    monkeypatch.setattr(tilings, "COLUMN_VERTICES", 1 << 20)


def slow_drift() -> Values:
    """Noise in space that changes little with time: only long tiles know it."""
    shape = (64, 32, 32, 32)
    still = np.random.default_rng(5).normal(size=shape[1:])
    moving = 0.02 * np.random.default_rng(6).normal(size=shape)
    return (still + moving).astype(np.float32)


def test_a_large_series_is_tried_on_parts_of_few_steps_and_of_many(
    workers: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_limits(monkeypatch)
    tiling, task = chosen(slow_drift(), "balanced", workers, psnr=25.0)
    base = largest_tile(task.blocks.shape)
    assert tiling.parts[0] == base
    assert base in [trial.tile for trial in tiling.trials]
    assert any(part[0] > base[0] for part in tiling.parts[1:])
    # Few steps alone, as one part of all space has them, would look at the still noise anew.
    assert tiling.tile[0] > 2 * base[0]
    prices = {trial.tile: trial.size for trial in tiling.trials}
    assert prices[base] > 1.5 * prices[tiling.tile]


def test_a_series_larger_than_memory_is_tried_on_windows(
    workers: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_limits(monkeypatch)
    monkeypatch.setattr("fhash_codec.compact.tiles.MAX_BYTES_IN_MEMORY", 1)
    tiling, _ = chosen(slow_drift(), "balanced", workers, psnr=25.0)
    assert tiling.price is not None
    assert tiling.tile[0] > 8
