"""All tiles keep the promise, also where the sample foretold something else."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy.typing as npt
import pytest

from fhash_codec.compact.attempt import GainLog, PlanTask
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.plan import CodingPlan
from fhash_codec.compact.stages import first_settings
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles_to_promise import SAFE, _Aim, _code_to_psnr, code_series
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries

Field = Callable[..., npt.NDArray[Any]]


def outcome(psnr: float, size: int) -> Outcome:
    """Return an outcome of a PSNR over a range of 1."""
    return Outcome(size=size, squares=10 ** (-psnr / 10), count=1, max_error=1.0)


def test_of_two_outcomes_the_smaller_that_keeps_the_promise_is_preferred() -> None:
    aim = _Aim(psnr=40.0, data_range=1.0, quick=False)
    assert aim.prefers(outcome(41, 90), outcome(42, 100))
    assert not aim.prefers(outcome(41, 110), outcome(42, 100))
    assert aim.prefers(outcome(41, 100), outcome(39, 90))
    assert aim.prefers(outcome(39, 100), outcome(38, 90))


@pytest.mark.parametrize("quick", [False, True])
def test_an_aim_is_met_from_above_only(quick: bool) -> None:
    aim = _Aim(psnr=40.0, data_range=1.0, quick=quick)
    assert not aim.is_met(40.0, 3)
    assert aim.is_met(40.0 + SAFE, 0)
    assert aim.is_met(float("inf"), 0)
    # An excess is worth a second pass, but no third.
    assert not aim.is_met(41.0, 0)
    assert aim.is_met(41.0, 1)
    assert aim.next_target(39.0, 0) > aim.min_psnr


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_wrong_step_is_mended(field: Field, factor: float) -> None:
    """The plan has a step that is far too fine or far too coarse."""
    source = field((4, 8, 12, 16))
    series, config = ArraySeries(source), EncodeConfig(psnr=45.0)
    selection = select_features(series, config, silent)
    data_range = float(source.max() - source.min())
    goal = Goal(psnr=45.0, data_range=data_range)
    blocks = Blocks(series, selection.extent, (4, 8, 6, 8))
    with ThreadPoolExecutor(2) as workers:
        task = PlanTask(
            blocks=blocks,
            value_range=selection.scanned.value_range,
            features=selection.features,
            config=config,
            goal=goal,
            fixed_tile=None,
            workers=workers,
            gains=GainLog(0),
        )
        settings = first_settings(task, blocks)
        settings = replace(settings, step=settings.step * factor)
        coding_plan = CodingPlan(
            blocks=blocks, settings=settings, coding=Coding(filled=True), goal=goal
        )
        aim = _Aim(psnr=45.0, data_range=data_range, quick=False)
        table = _code_to_psnr(coding_plan, aim, workers, silent)
    # The second pass corrects it; a third would come too dear for a small excess.
    assert 45.0 <= table.outcome.psnr(data_range) < 48.0
    assert len(table.streams) == 4


def test_the_progress_counts_the_tiles_and_the_gains_end_with_all_of_them(field: Field) -> None:
    series = ArraySeries(field((4, 8, 12, 16)))
    config = EncodeConfig(effort=1, max_error_rel=0.01, tile="4x8x6x8")
    done: list[tuple[str, int, int]] = []

    def progress(what: str, part: int, of: int, _detail: str) -> None:
        done.append((what, part, of))

    selection = select_features(series, config, silent)
    table = code_series(series, selection, config, progress)
    assert [entry for entry in done if entry[0] == "coding"] == [
        ("coding", part, 4) for part in (1, 2, 3, 4)
    ]
    assert [gain["what"] for gain in table.plan.gains] == ["start", "all tiles"]
    assert table.outcome.size == sum(map(len, table.streams))
