"""Coding of all tiles of a series, so that the promise is kept on the whole and not just a sample.

The tiles are coded once for a bound. For a PSNR or a size they are coded again, with other steps,
until they reach it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import prod
from typing import Any

from fhash_codec.compact.choices.head_prospects import HEAD_BYTES
from fhash_codec.compact.choices.search import EXCHANGE, SLOPE
from fhash_codec.compact.choices.step import FINEST_PSNR, psnr_search, require_reach, with_step
from fhash_codec.compact.choices.transform import refit, usual_transform
from fhash_codec.compact.coded_table import CodedTable
from fhash_codec.compact.goal import Goal, goal_of, integer_goal
from fhash_codec.compact.plan import CodingPlan, plan
from fhash_codec.compact.tiles.blocks import Blocks, Index, Tile, Values
from fhash_codec.compact.tiles.coding import (
    MIN_STEP_SHARE,
    Outcome,
    code,
    measured,
    recoded,
    total,
)
from fhash_codec.compact.tiles.known import TileRun
from fhash_codec.compact.tiles_to_size import ByteWindow, code_to_size, is_exact
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import FeatureSelection
from fhash_codec.header import GAIN
from fhash_codec.measure.bulk import bulk_of_ranks, find_bulk
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress
from fhash_codec.stage_clock import stage
from fhash_formats.series import Series
from fhash_formats.support.threads import map_ahead, thread_pool, usable_threads

__all__ = ["all_tiles", "code_series", "plan_series", "resized"]

OVERHEAD_BYTES = 2000
"""Approximate bytes of a container without its tiles, for the sizes after each stage."""
PASSES = 4
"""Times that all tiles are coded at most for a promise that the sample did not foretell."""
SAFE = 1e-3
"""dB always added to the PSNR promised, so that rounding cannot break the promise."""
EXCESS = 0.05
"""Excess in dB that is worth another pass."""
QUICK_AIM = 0.12
"""dB added to the PSNR at effort 1, where one pass should do: the precision of the estimate."""
QUICK_EXCESS = 0.35
"""Excess in dB that is worth another pass at effort 1."""
MARGIN = 0.005
"""dB added to the PSNR in the second pass; doubled in each further one."""
UNLIKE = 0.3
"""dB by which all tiles may be worse than the sample before the gain of the head is looked at."""
NEAR_MISS = 0.1
"""dB by which the search may miss the promise so that a finer step is tried, and no other plan."""
FIRST_FINER = 1.1
"""Factor of the first finer step where the search has missed the promise, at most; then its square.

After a near miss it is the one that should do, by half of the usual slope.
"""
MAX_FINER = 2.0
"""Largest such factor."""
REFIT_RATIO = 1.5
"""Ratio by which the step must fall before the data's own bases are made anew."""


def code_series(
    series: Series,
    selection: FeatureSelection,
    config: EncodeConfig,
    progress: Progress,
    *,
    overhead: int = OVERHEAD_BYTES,
) -> CodedTable:
    """Plan and code all tiles so that the promise of the settings is kept, if it can be.

    overhead: approximate bytes of the file that are no tiles; only a promised ratio needs it.

    Raises InputError for a promise that is seen to be out of reach.
    """
    begun = time.perf_counter()
    with thread_pool() as workers:
        coding_plan, goal, bulk = plan_series(
            series, selection, config, workers, progress, overhead=overhead
        )
        if goal.psnr is None or goal.data_range == 0:
            table = _code_all(coding_plan, workers, progress)
            if goal.size is not None:
                window = ByteWindow.of(goal, overhead)
                table = code_to_size(table, window, lambda plan: _code_all(plan, workers, progress))
        else:
            aim = _Aim(psnr=goal.psnr, data_range=goal.data_range, quick=config.effort == 1)
            table = _code_to_psnr(coding_plan, aim, workers, progress)
        if _is_exact_by_chance(table, goal):
            blocks = coding_plan.blocks.retile(coding_plan.blocks.shape)
            about = selection.scanned.value_range.moved(-blocks.origin)
            exactly = integer_goal(0, goal.data_range)
            exact = plan(
                *(blocks, about, config, exactly, OVERHEAD_BYTES),
                *(workers, progress, selection.features),
            )
            other = _code_all(replace(exact, goal=goal), workers, progress)
            table = other if other.outcome.size < table.outcome.size else table
    seconds = round(time.perf_counter() - begun, 3)
    gain = dict(zip(GAIN, (*all_tiles(table.outcome.size), seconds), strict=True))
    table = replace(table, plan=replace(table.plan, gains=[*table.plan.gains, gain]))
    return replace(table, bulk=bulk)


def _is_exact_by_chance(table: CodedTable, goal: Goal) -> bool:
    """Whether a PSNR or a ratio left no error of integers, which cost less if none is allowed.

    A strict bound tries both as it codes each tile.
    """
    plain = goal.error is None and not (table.plan.coding.error or table.plan.settings.labels)
    return plain and table.plan.blocks.dtype.kind in "iu" and is_exact(table)


def plan_series(
    series: Series,
    selection: FeatureSelection,
    config: EncodeConfig,
    workers: ThreadPoolExecutor,
    progress: Progress,
    *,
    overhead: int = OVERHEAD_BYTES,
) -> tuple[CodingPlan, Goal, ValueRange | None]:
    """Return the plan of a series, its promise, and the bulk of its values; None without one.

    Plan and promise are of the values less the origin of the plan's blocks. Arguments and errors
    are those of `code_series`.
    """
    value_range = selection.scanned.value_range
    raw_bytes = prod(series.shape) * (series.source_dtype or series.dtype).itemsize
    origin = value_range.origin(series.source_dtype or series.dtype)
    blocks = Blocks(series, selection.extent, series.shape, origin)
    about = value_range.moved(-origin)
    integers = blocks.dtype.kind in "iu"
    with stage("bulk", "range of the middle 98 % of the values, which has a promise of its own"):
        if blocks.in_memory or selection.ranks is None:
            bulk = find_bulk(blocks.counted_values, about, whole=integers)
        else:  # the series was too long to be read for this alone
            bulk = bulk_of_ranks(selection.ranks, value_range, whole=integers)
            bulk = None if bulk is None else bulk.moved(-origin)
    goal = goal_of(config, about, raw_bytes, overhead, bulk, integers=integers)
    # No step of the quantiser reaches such a PSNR, and integers can be exact.
    beyond = integers and goal.psnr is not None and goal.psnr > FINEST_PSNR
    asked = integer_goal(0, goal.data_range) if beyond else goal
    coding_plan = plan(
        blocks, about, config, asked, OVERHEAD_BYTES, workers, progress, selection.features
    )
    return coding_plan, goal, None if bulk is None else bulk.moved(origin)


def all_tiles(size: int) -> list[Any]:
    """Return the last entry of a header's gains: tiles of so many bytes."""
    return ["all tiles", size + OVERHEAD_BYTES]


def resized(table: CodedTable, overhead: int, progress: Progress) -> CodedTable:
    """Return a table of the promised ratio, now that the bytes besides the tiles are known.

    overhead: bytes of the file that are no tiles.
    """
    with thread_pool() as workers:
        window = ByteWindow.of(table.plan.goal, overhead)
        other = code_to_size(table, window, lambda plan: _code_all(plan, workers, progress))
    return replace(other, bulk=table.bulk)


@dataclass(frozen=True, kw_only=True)
class _Aim:
    """The PSNR promised, and how near to it all tiles should come."""

    psnr: float
    """PSNR in dB."""
    data_range: float
    """Range of the values, in data units."""
    quick: bool
    """Whether one pass should do."""

    @property
    def min_psnr(self) -> float:
        """PSNR in dB that must be reached."""
        return self.psnr + SAFE

    def psnr_of(self, outcome: Outcome) -> float:
        """Return the PSNR of an outcome in dB."""
        return outcome.psnr(self.data_range)

    def is_met(self, psnr: float, attempt: int) -> bool:
        """Whether a PSNR keeps the promise, and in the first attempt does not exceed it by much."""
        if psnr < self.min_psnr:
            return False
        excess = QUICK_EXCESS if self.quick else EXCESS
        return attempt > 0 or psnr < self.psnr + excess or math.isinf(psnr)

    def next_target(self, psnr: float, attempt: int) -> float:
        """Return the PSNR to search for after an attempt that reached `psnr`."""
        if self.quick:
            return self.min_psnr + (EXCESS + abs(psnr - self.psnr) / 8)
        return self.min_psnr + MARGIN * float(2**attempt)

    def prefers(self, outcome: Outcome, other: Outcome) -> bool:
        """Whether an outcome keeps the promise in fewer bytes, or misses it by less."""
        psnr, other_psnr = self.psnr_of(outcome), self.psnr_of(other)
        if min(psnr, other_psnr) < self.min_psnr:
            return psnr > other_psnr
        return outcome.size < other.size


def _code_to_psnr(
    coding_plan: CodingPlan, aim: _Aim, workers: ThreadPoolExecutor, progress: Progress
) -> CodedTable:
    """Code all tiles until they reach a PSNR.

    Where they turn out much worse than the sample, what was learned from it is dropped, one after
    the other: the head, then the data's own bases.
    """
    if aim.quick:
        step = coding_plan.settings.step * (1 - QUICK_AIM / SLOPE)
        coding_plan = replace(coding_plan, settings=replace(coding_plan.settings, step=step))
    best: CodedTable | None = None
    for simpler_plan in _simpler_plans(coding_plan):
        best = _search_psnr(simpler_plan, aim, best, workers, progress)
        if aim.psnr_of(best.outcome) >= aim.min_psnr - NEAR_MISS:
            break
    assert best is not None
    return _rescued(best, aim, workers, progress)


def _rescued(
    best: CodedTable, aim: _Aim, workers: ThreadPoolExecutor, progress: Progress
) -> CodedTable:
    """Return a table that keeps the promise, by ever finer steps, where the search has missed it.

    At the level of the noise of a series the PSNR hardly depends on the step, and then much.
    """
    missing = aim.min_psnr - aim.psnr_of(best.outcome)
    table, finer = best, min(FIRST_FINER, math.exp(2 * (missing + 2 * MARGIN) / SLOPE))
    while aim.psnr_of(table.outcome) < aim.min_psnr:
        settings = table.plan.settings
        require_reach(table.plan.goal, settings, table.outcome)
        step = max(settings.step / finer, (settings.high - settings.low) * MIN_STEP_SHARE)
        if step >= settings.step:
            break
        finer = min(finer**2, MAX_FINER)
        refined = with_step(replace(settings, head=None), step, table.plan.goal)
        if not refined.double:  # a head works in float32 only
            refined = replace(refined, head=settings.head)
        table = _code_all(replace(table.plan, settings=refined), workers, progress)
        if aim.prefers(table.outcome, best.outcome):
            best = table
    return best


def _search_psnr(
    coding_plan: CodingPlan,
    aim: _Aim,
    best: CodedTable | None,
    workers: ThreadPoolExecutor,
    progress: Progress,
) -> CodedTable:
    """Code all tiles with step after step; the best table of these and of the one given."""
    search = psnr_search(coding_plan.settings)
    for attempt in range(PASSES):
        note = f"pass {attempt + 1}" if attempt else ""
        table = _code_all(coding_plan, workers, progress, note)
        psnr = aim.psnr_of(table.outcome)
        if best is None or aim.prefers(table.outcome, best.outcome):
            best = table
        if aim.is_met(psnr, attempt):
            break
        require_reach(coding_plan.goal, coding_plan.settings, table.outcome)
        settings = coding_plan.settings
        unlike = psnr < aim.min_psnr - UNLIKE and attempt == 0
        if unlike and not _head_holds(table, aim, workers):
            break
        search.add(settings.step, psnr)
        step = search.step_for(aim.next_target(psnr, attempt))
        coding_plan = replace(coding_plan, settings=replace(settings, step=step))
        if coding_plan.sample is not None and step < settings.step / REFIT_RATIO:
            refitted = refit(coding_plan.sample, coding_plan.settings)
            coding_plan = replace(coding_plan, settings=refitted)
    assert best is not None
    return best


def _head_holds(table: CodedTable, aim: _Aim, workers: ThreadPoolExecutor) -> bool:
    """Whether the head of a table, if any, saves more bytes in all tiles than it takes.

    It may gain much there although all tiles are worse than the sample. What the tiles are without
    it is measured by decoding them once more.
    """
    settings, blocks = table.plan.settings, table.plan.blocks
    if settings.head is None:
        return True
    plain = replace(settings, head=None)

    def measure(job: tuple[bytes, Index | Tile]) -> Outcome:
        stream, source = job
        tile = _tile_of(blocks, source)
        return measured(tile, recoded(tile, stream, plain), plain, table.plan.coding)

    sources = (_readable(blocks, index) for index in blocks.indices())
    jobs = zip(table.streams, sources, strict=True)
    with stage("coding", "gain of the head in all tiles"):
        without = total(list(map_ahead(workers, measure, jobs, 2 * usable_threads())))
    gain = aim.psnr_of(table.outcome) - aim.psnr_of(without)
    size = table.outcome.size
    own = len(settings.head.to_bytes()) + HEAD_BYTES
    return size * (2 ** (gain / EXCHANGE) - 1) > own


def _simpler_plans(coding_plan: CodingPlan) -> Iterator[CodingPlan]:
    """Yield the plan itself, then without its head, then with wavelets instead of own bases."""
    settings = coding_plan.settings
    yield coding_plan
    if settings.head is not None:
        settings = replace(settings, head=None)
        yield replace(coding_plan, settings=settings)
    if any(axis.basis is not None for axis in settings.transform.axes):
        transform = usual_transform(coding_plan.blocks.tile)
        yield replace(coding_plan, settings=replace(settings, transform=transform))


def _code_all(
    coding_plan: CodingPlan,
    workers: ThreadPoolExecutor,
    progress: Progress,
    note: str = "",
) -> CodedTable:
    """Code every tile; few tiles are worked on at a time, so that memory stays bounded.

    note: for the progress.
    """
    blocks, keeps_decoded = coding_plan.blocks, coding_plan.keeps_decoded

    def work(source: Index | Tile | TileRun) -> tuple[bytes, Outcome, Values | None]:
        if isinstance(source, TileRun):
            return source.stream, source.outcome, None
        tile = _tile_of(blocks, source)
        coded, outcome = code(tile, coding_plan.settings, coding_plan.coding)
        return coded.data, outcome, coded.decoded if keeps_decoded else None

    streams: list[bytes] = []
    decoded_tiles: list[Values | None] = []
    outcomes: list[Outcome] = []
    indices = list(blocks.indices())
    sources = _sources(coding_plan, indices)
    with stage(
        "coding", "all tiles, once for each step of the quantiser until the promise is kept"
    ):
        for data, outcome, values in map_ahead(workers, work, sources, 2 * usable_threads()):
            streams.append(data)
            outcomes.append(outcome)
            decoded_tiles.append(values)
            progress("coding", len(streams), len(indices), note)
    kept = zip(indices, decoded_tiles, strict=True)
    return CodedTable(
        plan=coding_plan,
        streams=streams,
        outcome=total(outcomes),
        decoded={index: values for index, values in kept if values is not None},
    )


def _sources(coding_plan: CodingPlan, indices: Sequence[Index]) -> Iterator[Index | Tile | TileRun]:
    """Yield what each tile is made of, in C order: its stream, where the search has coded it so.

    Else it is the tile that the search has filled, or one that is read here, or its index where the
    workers may read it themselves.
    """
    blocks, sample = coding_plan.blocks, coding_plan.sample
    filled: dict[Index, Tile] = {}
    known: dict[Index, TileRun] = {}
    if sample is not None and coding_plan.coding.filled:
        filled = dict(zip(sample.indices, sample.tiles, strict=True))
        if not coding_plan.keeps_decoded:
            known = sample.coded(coding_plan.settings, coding_plan.coding)
    for index in indices:
        if index in known:
            yield known[index]
        elif index in filled:
            yield filled[index]
        else:
            yield _readable(blocks, index)


def _readable(blocks: Blocks, index: Index) -> Index | Tile:
    """Return a tile, or its index where the workers may read it themselves."""
    return index if blocks.in_memory else blocks.read(index)


def _tile_of(blocks: Blocks, source: Index | Tile) -> Tile:
    """Return the tile that `_readable` stands for."""
    return source if isinstance(source, Tile) else blocks.read(source)
