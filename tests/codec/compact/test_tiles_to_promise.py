"""All tiles keep the promise, also where the sample foretold something else."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.compact.attempt import GainLog, PlanTask
from fhash_codec.compact.choices.head_samples import Pair
from fhash_codec.compact.choices.head_training import train_head
from fhash_codec.compact.coded_table import CodedTable
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.plan import CodingPlan
from fhash_codec.compact.stages import first_settings
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles.coding import Coding, Outcome, recoded
from fhash_codec.compact.tiles_to_promise import (
    SAFE,
    _Aim,
    _code_all,
    _code_to_psnr,
    _head_holds,
    code_series,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries
from fhash_formats.transform.head.head import NeighbourHead
from fhash_formats.transform.tile.settings import TileSettings

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


def moving_sphere() -> npt.NDArray[Any]:
    """A sphere (4, 24, 32, 32) of sharp edge, which a transform smears and a head mends."""
    t, z, y, x = np.indices((4, 24, 32, 32))
    far = np.sqrt((z - 12) ** 2 + (y - 16) ** 2 + (x - 10 - 3 * t) ** 2)
    return np.tanh(9 - far).astype(np.float32)


def test_a_head_holds_where_it_gains_in_all_tiles() -> None:
    """One that was trained on the tiles saves more than it takes; one for noise does not."""
    series = ArraySeries(moving_sphere())
    config = EncodeConfig(psnr=38.0, effort=2, tile="2x24x32x32", without=("transform",))
    aim = _Aim(psnr=38.0, data_range=2.0, quick=False)
    with ThreadPoolExecutor(2) as workers:
        selection = select_features(series, config, silent)
        table = code_series(series, selection, config, silent)
        blocks, settings = table.plan.blocks, table.plan.settings
        assert _head_holds(table, aim, workers)  # it has none
        pairs = []
        for index, stream in zip(blocks.indices(), table.streams, strict=True):
            tile = blocks.read(index)
            pairs.append(Pair(recoded(tile, stream, settings).decoded, tile.values, None))
        head = trained(pairs, settings)
        assert _head_holds(_recoded(table, replace(settings, head=head), workers), aim, workers)
        noise = np.random.default_rng(0).normal(size=(2, 24, 32, 32)).astype(np.float32)
        head = trained([Pair(noise, -noise, None)], settings)
        table = _recoded(table, replace(settings, head=head), workers)
        assert not _head_holds(table, aim, workers)


def trained(pairs: list[Pair], settings: TileSettings) -> NeighbourHead:
    """A small head for some tiles."""
    low, high = settings.low, settings.high
    found = train_head(pairs, low=low, high=high, updates=300, samples=60_000, hidden=(4, 4))
    assert found is not None
    return found.head


def _recoded(table: CodedTable, settings: TileSettings, workers: ThreadPoolExecutor) -> CodedTable:
    """All tiles of a table with other settings."""
    return _code_all(replace(table.plan, settings=settings, sample=None), workers, silent)


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
