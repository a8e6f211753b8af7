"""Trials of tilings: bytes at equal quality, of a series or of boxes that stand for it."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planned import plan_task, waves

from fhash_codec.compact.choices import tiling_trials
from fhash_codec.compact.choices.tiling_trials import FAR, Trials
from fhash_codec.compact.stages import first_guess, first_settings

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


def test_a_tiling_is_coded_once(
    workers: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials = trials_on(waves((4, 8, 16, 16)), workers)
    size = trials.size((4, 8, 8, 8))
    monkeypatch.setattr(Trials, "_picked", lambda *_: pytest.fail("coded again"))
    assert trials.size((4, 8, 8, 8)) == size
    assert trials.sizes == {(4, 8, 8, 8): size}


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


def test_a_box_counts_as_often_as_its_weight(workers: ThreadPoolExecutor) -> None:
    values = waves((4, 8, 24, 24))
    trials = trials_on(values, workers)
    once = trials.size((4, 8, 24, 24))
    trials._blocks = trials._blocks.boxes(trials.shape, [(0, 0, 0, 0)], [5])
    trials.sizes.clear()
    bases = 0.1 * once  # which the file has once
    assert trials.size((4, 8, 24, 24)) == pytest.approx(5 * once, abs=5 * bases)


def test_a_tiling_far_from_the_quality_of_the_first_is_coded_with_another_step(
    workers: ThreadPoolExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.random.default_rng(2).normal(size=(4, 8, 24, 24)).astype(np.float32)
    trials = trials_on(values, workers)
    settled = trials.settle(None)
    first = trials.sizes.pop((4, 8, 24, 24))
    steps = []
    noted = Trials._note

    def note(self: Trials, sample: Any, outcome: Any, settings: Any) -> None:
        steps.append(settings.step)
        assert self._missing(outcome) < 2.0 - FAR
        noted(self, sample, outcome, settings)

    monkeypatch.setattr(Trials, "_note", note)
    assert trials._psnr is not None
    trials._psnr += 2.0  # as if the first one had been that much better
    assert trials.size((4, 8, 24, 24)) > first
    assert steps[0] < 0.8 * settled.step


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


@pytest.mark.parametrize("promise", [{"max_error_rel": 0.02}, {"ratio": 20.0}])
def test_other_promises_have_sizes(promise: dict[str, float], workers: ThreadPoolExecutor) -> None:
    trials = trials_on(waves((4, 8, 16, 16)), workers, **promise)
    trials.settle(None)
    assert 0 < trials.size((4, 8, 16, 16)) < trials.size((1, 4, 8, 8))
