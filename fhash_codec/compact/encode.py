"""Encoding by a plan: the loop over tiles, up to a promised quality or a size, and its record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.metadata import version
from math import prod
from typing import Any

import numpy.typing as npt

from fhash_codec.compact.goal import (
    EXCHANGE,
    FINEST_PSNR,
    MAX_STEP_SHARE,
    QUICK_AIM,
    RATIO_SLACK,
    SLOPE,
    Goal,
    SizeSearch,
    goal_of,
    integer_goal,
    promise,
    psnr_search,
    require_reach,
    search,
    step_after_gain,
    with_step,
)
from fhash_codec.compact.head import head_bytes, training_device
from fhash_codec.compact.head_training import BATCH_VOXELS
from fhash_codec.compact.plan import OVERHEAD_BYTES, CodingPlan, plan
from fhash_codec.compact.sample import choose_between
from fhash_codec.compact.tiles import (
    MIN_STEP_SHARE,
    Blocks,
    Index,
    Outcome,
    Tile,
    TileRun,
    Worked,
    code,
    code_tiles,
    fits_memory,
    return_memory,
    total,
)
from fhash_codec.compact.transform import refit, usual_transform
from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import Everything
from fhash_codec.features.occupancy import has_blocks, write_blocks
from fhash_codec.features.selection import FeatureSelection, select_features
from fhash_codec.header import GAIN, HEAD_POINTS, brief_history, describe_source, write_series
from fhash_codec.measure.errors import bulk_of_ranks, find_bulk
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress, stage
from fhash_formats.container import ContainerWriter
from fhash_formats.container.growing import TableParts
from fhash_formats.series import Series
from fhash_formats.support.threads import thread_pool
from fhash_formats.transform.tile import plain_step
from fhash_formats.transform.values import at_origin

DecodedTiles = Mapping[Index, npt.NDArray[Any]]
"""Tiles as they decode, in the type of the source."""


@dataclass(frozen=True, kw_only=True)
class CodedTable:
    """All tiles of a series, coded."""

    plan: CodingPlan
    """Tiles and settings."""
    streams: list[bytes] = field(default_factory=list)
    """Stream of each tile, in C order."""
    outcome: Outcome = field(default_factory=lambda: total([]))
    """Size and error of all tiles."""
    decoded: DecodedTiles = field(default_factory=dict)
    """All tiles as they decode, less the origin, where the plan keeps them."""
    bulk: ValueRange | None = None
    """Bulk of the values that count, in data units; None if they have none."""

    @property
    def in_source(self) -> DecodedTiles:
        """The decoded tiles in the type of the source."""
        origin, dtype = self.plan.blocks.origin, self.plan.blocks.source_dtype
        if not origin:
            return self.decoded
        return {index: at_origin(tile, origin, dtype) for index, tile in self.decoded.items()}

    @cached_property
    def parts(self) -> TableParts:
        """The arrays that the container has of the table."""
        blocks = self.plan.blocks
        return TableParts(
            shape=blocks.shape,
            dtype=blocks.source_dtype,
            tile=blocks.tile,
            settings=replace(self.plan.settings, origin=blocks.origin),
            streams=self.streams,
        )


def model_header(table: CodedTable) -> dict[str, Any]:
    """Return what the header of a compact file says of its model."""
    blocks, head = table.plan.blocks, table.plan.settings.head
    weights = 0 if head is None else head.size
    return {
        "profile": "compact",
        "levels": [list(blocks.shape)],
        "embedding_size": 1,
        "tables": blocks.source_dtype.name,
        "parameters": table.outcome.nonzero + weights,
    }


def search_header(table: CodedTable) -> dict[str, Any]:
    """Return what a header with times says of the search: `gains`, and `tiling` if there is any.

    Keys of `tiling`: `price`, bytes as a multiple of those of the best tiling; `tried`, the number
    of tilings that were priced, 0 where the price is estimated; `coder`, "fast" where the tiles are
    of the fast coder. Tiles that were asked for have the last one alone.
    """
    record: dict[str, Any] = {}
    tiling = table.plan.tiling
    if tiling is not None and tiling.price is not None:
        record = {
            "price": round(tiling.price, 3),
            "tried": tiling.tried,
        }
    if table.plan.coding.fast:
        record["coder"] = "fast"
    gains = [[gain[name] for name in GAIN if name in gain] for gain in table.plan.gains]
    return {"gains": gains, **({"tiling": record} if record else {})}


SIZE_PASSES = 10
"""Times that all tiles are coded at most."""
CodeAll = Callable[[CodingPlan], CodedTable]
"""Function that codes all tiles by a plan."""


@dataclass(frozen=True)
class ByteWindow:
    """Bytes that the tiles of a file may take, from `low` to `high`."""

    low: float
    high: float

    @classmethod
    def of(cls, goal: Goal, overhead: float) -> ByteWindow:
        """Return the window of a promised size. overhead: bytes of the file that are no tiles."""
        assert goal.size is not None
        return cls(goal.size / RATIO_SLACK - overhead, goal.size - overhead)

    def holds(self, table: CodedTable) -> bool:
        """Whether a table lies in the window."""
        return self.low <= table.outcome.size <= self.high

    def prefers(self, table: CodedTable, other: CodedTable) -> bool:
        """Whether a table is nearer to the window; one below it is nearer than one above."""
        size, other_size = table.outcome.size, other.outcome.size
        if max(size, other_size) > self.high:
            return size < other_size
        return size > other_size


def is_exact(table: CodedTable) -> bool:
    """Whether the values decode exactly, whole numbers after rounding: more bytes give nothing."""
    limit = 0.5 if table.plan.blocks.dtype.kind in "iu" else 0.0
    error = table.outcome.max_error
    return error == 0 or error < limit


def code_to_size(table: CodedTable, window: ByteWindow, code_all: CodeAll) -> CodedTable:
    """Code all tiles again with step after step until they take the bytes of a window.

    table: of the step to begin with. It is returned if it fits already, and where it is too small
        although its values are exact. Where no step fits, the best table below the window is, or
        the smallest.
    """
    plan = table.plan
    if plan.goal.data_range <= 0:
        return table
    data_range = max(plan.goal.data_range, 1e-300)
    target = max((window.low + window.high) / 2, 1.0)
    steps = SizeSearch(data_range, (MIN_STEP_SHARE, MAX_STEP_SHARE), target, drifts=False)

    def following(table: CodedTable, _number: int) -> CodingPlan | None:
        settings, size = table.plan.settings, table.outcome.size
        if window.holds(table) or (size < window.low and is_exact(table)):
            return None
        log_step = steps.after(math.log(settings.step), size, too_fine=size > window.high)
        if steps.is_flat:
            return None
        return replace(plan, settings=with_step(settings, math.exp(log_step), plan.goal))

    return search(table, following, code_all, SIZE_PASSES, window.prefers)


PASSES = 4
"""Times that all tiles are coded at most for a promise that the sample did not foretell."""
SAFE = 1e-3
"""dB always added to the PSNR promised, so that rounding cannot break the promise."""
EXCESS = 0.05
"""Excess in dB that is worth another pass, where few bytes are wished for at any cost."""
USUAL_EXCESS = 0.12
"""The same by default. Only series of which a sample was searched miss it, the large ones: a pass
over 1.5 GB took 10 of 33 seconds for 0.9 % of the bytes."""
QUICK_EXCESS = 0.5
"""Excess in dB that is worth another pass at effort 1: it costs 7 % of the bytes, a pass a third of
the seconds."""
MARGIN = 0.005
"""dB added to the PSNR in the second pass; four times as much in each further one."""
SURE = 0.03
"""Share of the bytes from which on it is sure that an MLP saves some: below it, the tiles are coded
without one as well."""
EXCESS_OF_MLP = 0.2
"""Excess in dB that is worth another pass with an MLP, which takes twice the time and saves 1 % of
the bytes."""
MARGIN_OF_MLP = 0.04
"""dB added at least where an MLP makes the PSNR a less smooth function of the step."""
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
        return_memory()
        table = _coded(coding_plan, goal, config, workers, progress)
        if goal.size is not None:
            window = ByteWindow.of(goal, overhead)
            table = code_to_size(table, window, lambda plan: _code_all(plan, workers, progress))
        plain = coding_plan.plain
        doubtful = coding_plan.saved is not None and coding_plan.saved < SURE
        if plain is not None and doubtful and table.plan.settings.head is not None:
            other = _coded(plain, goal, config, workers, progress)
            if other.outcome.size < table.outcome.size + head_bytes(table.plan.settings.head):
                table = other
        if _is_exact_by_chance(table, goal):
            blocks = coding_plan.blocks.retile(coding_plan.blocks.shape)
            about = selection.scanned.value_range.moved(-blocks.origin)
            exactly = integer_goal(0, goal.data_range)
            features = selection.features
            exact = plan(blocks, about, config, exactly, workers, progress, features)
            other = _code_all(replace(exact, goal=goal), workers, progress)
            table = other if other.outcome.size < table.outcome.size else table
    seconds = round(time.perf_counter() - begun, 3)
    size = table.outcome.size + OVERHEAD_BYTES
    gain = dict(zip(GAIN, ("all tiles", size, seconds), strict=True))
    table = replace(table, plan=replace(table.plan, gains=[*table.plan.gains, gain]))
    return replace(table, bulk=bulk)


def _coded(
    coding_plan: CodingPlan,
    goal: Goal,
    config: EncodeConfig,
    workers: ThreadPoolExecutor,
    progress: Progress,
) -> CodedTable:
    """Code all tiles by a plan, again and again where a PSNR is promised, until it is reached."""
    if goal.psnr is None or goal.data_range == 0:
        return _code_all(coding_plan, workers, progress)
    aim = _Aim(psnr=goal.psnr, data_range=goal.data_range)
    if config.effort == 1:
        aim = replace(aim, excess=QUICK_EXCESS, margin=QUICK_AIM)
    elif config.access != "small":
        aim = replace(aim, excess=USUAL_EXCESS)
    if coding_plan.settings.head is not None:
        aim = replace(aim, margin=MARGIN_OF_MLP, excess=max(aim.excess, EXCESS_OF_MLP))
    return _code_to_psnr(coding_plan, aim, workers, progress)


def at_step(table: CodedTable, step: float, progress: Progress) -> CodedTable:
    """Return a table coded by its plan with another step, that of the plain quantiser."""
    settings = table.plan.settings
    step *= settings.step / plain_step(settings)
    if step == settings.step:
        return table
    settings = with_step(settings, step, table.plan.goal)
    with thread_pool() as workers:
        return _code_all(replace(table.plan, settings=settings), workers, progress)


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
    coding_plan = plan(blocks, about, config, asked, workers, progress, selection.features)
    return coding_plan, goal, None if bulk is None else bulk.moved(origin)


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
    excess: float = EXCESS
    """Excess in dB that is worth another pass."""
    margin: float = 0.0
    """dB added to the PSNR in each further pass, at least."""

    @property
    def min_psnr(self) -> float:
        """PSNR in dB that must be reached."""
        return self.psnr + SAFE

    def psnr_of(self, outcome: Outcome) -> float:
        """Return the PSNR of an outcome in dB."""
        return outcome.psnr(self.data_range)

    def is_met(self, psnr: float, attempt: int) -> bool:
        """Whether a PSNR keeps the promise, and in two attempts does not exceed it by much."""
        if psnr < self.min_psnr:
            return False
        return attempt > 1 or psnr < self.psnr + self.excess or math.isinf(psnr)

    def next_target(self, psnr: float, attempt: int) -> float:
        """Return the PSNR to search for after an attempt that reached `psnr`."""
        return self.min_psnr + max(self.margin, MARGIN * float(4**attempt))

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
        if not refined.double:  # an MLP works in float32 only
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
    secants = psnr_search(coding_plan.settings)

    def holds(table: CodedTable) -> bool:
        return _head_holds(table, aim, lambda plan: _code_all(plan, workers, progress))

    def following(table: CodedTable, attempt: int) -> tuple[CodingPlan, str] | None:
        plan, psnr = table.plan, aim.psnr_of(table.outcome)
        if aim.is_met(psnr, attempt):
            return None
        require_reach(plan.goal, plan.settings, table.outcome)
        if psnr < aim.min_psnr - UNLIKE and attempt == 0 and not holds(table):
            return None
        before = plan.settings.step
        step = secants.after(before, psnr, aim.next_target(psnr, attempt))
        plan = replace(plan, settings=replace(plan.settings, step=step))
        if plan.sample is not None and step < before / REFIT_RATIO:
            plan = replace(plan, settings=refit(plan.sample, plan.settings))
        return plan, f"pass {attempt + 2}"

    def run(task: tuple[CodingPlan, str]) -> CodedTable:
        return _code_all(task[0], workers, progress, task[1])

    def prefers(table: CodedTable, other: CodedTable) -> bool:
        return aim.prefers(table.outcome, other.outcome)

    found = search(run((coding_plan, "")), following, run, PASSES - 1, prefers)
    return found if best is None or prefers(found, best) else best


FAR_APART = 2.0
"""dB by which two codings may differ so that their bytes compare by `EXCHANGE`."""


def _head_holds(table: CodedTable, aim: _Aim, code_all: CodeAll) -> bool:
    """Whether the MLP of a table, if any, saves more bytes in all tiles than it takes.

    It may gain much there although all tiles are worse than the sample. What they are without it is
    told by coding them once more.
    """
    if table.plan.plain is None or table.plan.settings.head is None:
        return True
    plain, reached = table.plan.plain, aim.psnr_of(table.outcome)
    with stage("coding", "gain of the MLP in all tiles"):
        without = code_all(plain).outcome
        gain = reached - aim.psnr_of(without)
        if abs(gain) > FAR_APART:
            step = step_after_gain(plain.settings.step, -gain)
            plain = replace(plain, settings=with_step(plain.settings, step, plain.goal))
            without = code_all(plain).outcome
            gain = reached - aim.psnr_of(without)
    return without.size * 2 ** (gain / EXCHANGE) > table.outcome.size + head_bytes(
        table.plan.settings.head
    )


def _simpler_plans(coding_plan: CodingPlan) -> Iterator[CodingPlan]:
    """Yield the plan itself, then without its head, then with wavelets instead of own bases."""
    yield coding_plan
    if coding_plan.plain is not None:
        coding_plan = coding_plan.plain
        yield coding_plan
    settings = coding_plan.settings
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

    def work(source: Index | Tile | TileRun) -> Worked:
        if isinstance(source, TileRun):
            return source.stream, source.outcome, None
        tile = _tile_of(blocks, source)
        coded, outcome = code(tile, coding_plan.settings, coding_plan.coding)
        return coded.data, outcome, coded.decoded if keeps_decoded else None

    indices = list(blocks.indices())
    with stage(
        "coding", "all tiles, once for each step of the quantiser until the promise is kept"
    ):
        coded = code_tiles(
            _sources(coding_plan, indices),
            work,
            workers,
            lambda count: progress("coding", count, len(indices), note),
        )
    kept = zip(indices, coded.decoded, strict=True)
    return CodedTable(
        plan=coding_plan,
        streams=coded.streams,
        outcome=coded.outcome,
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


HEADER_BYTES = 750
"""Bytes that a header has at least beside the description of the source, approximately."""
STEP_BYTES = 5
"""Approximate bytes of the figures of a step in a header."""
WRITINGS = 4
"""Times that a file is written at most for a promised ratio."""


def encode_compact(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    mask: npt.ArrayLike | None,
    progress: Progress,
    complete: Callable[[dict[str, Any], DecodedTiles], dict[str, Any]],
) -> dict[str, Any]:
    """Code the values of a series and write them; the header.

    For a promised ratio they are written again until the whole file has it, where a step of the
    quantiser allows that.

    mask: booleans (t, z, y, x) or (z, y, x), one more feature.
    complete: measures what is written, and returns a header with its quality. Its second argument
        are the tiles whose decoded values are known.
    """
    begun = time.perf_counter()
    selection = select_features(series, config, progress, mask, ranked=not fits_memory(series))
    gaps = selection.extent.fraction < 1
    source = describe_source(series, selection.scanned.value_range, config, gaps=gaps)
    with stage("writing", "coordinates and masks of missing values, tiles, header"):
        described = write_series(
            writer,
            series,
            selection.scanned,
            selection.extent.key_frames,
            everything=any(isinstance(feature, Everything) for feature in selection.features),
        )
    mark = writer.mark()
    overhead = writer.size(source) + HEADER_BYTES + STEP_BYTES * series.shape[0]
    table = code_series(series, selection, config, progress, overhead=overhead)
    if config.ratio is None:  # all is coded, and measuring needs the memory
        table.plan.blocks.forget()
        table = replace(table, plan=replace(table.plan, sample=None))
        return_memory()
    for _ in range(WRITINGS):
        parts = table.parts
        with stage("writing", "tiles"):
            parts.write(writer)
            if has_blocks(parts.settings.mask is not None, map(str, selection.features)):
                extent, size = selection.extent, sum(map(len, parts.streams))
                write_blocks(writer, extent.mask, parts.shape, size)
        seconds = round(time.perf_counter() - begun, 3) if config.timings else None
        own = table_header(series, selection, table, config, seconds)
        own["required_features"] = ["transform"]
        header = complete(source | described | own, table.in_source)
        overhead = writer.size(header) - table.outcome.size
        if config.ratio is None or ByteWindow.of(table.plan.goal, overhead).holds(table):
            break
        other = resized(table, overhead, progress)
        if other.outcome.size == table.outcome.size:
            break
        table = other
        writer.rewind(mark)
    return header


def table_header(
    series: Series,
    selection: FeatureSelection,
    table: CodedTable,
    config: EncodeConfig,
    seconds: float | None,
) -> dict[str, Any]:
    """Return what a header says beside the source and its coordinates, without the quality.

    seconds: duration of the encoding; None if it is not to be told.
    """
    extent = selection.extent
    kept = table.plan.history if table.plan.settings.head is not None else []
    with stage("between steps", "linear or cubic, on steps that are left out"):
        between = choose_between(series, extent, selection.scanned.value_range)
    return {
        "encoder": {
            "version": version("fhash"),
            **({} if seconds is None else {"seconds": seconds}),
        },
        "background": extent.background,
        "feature_bounding_box": [list(span) for span in extent.box],
        "features": [str(feature) for feature in selection.features],
        "coreset_fraction": extent.fraction,
        "model": {
            **model_header(table),
            **(search_header(table) if config.timings else {}),
            **between,
        },
        "config": config.settings() | promise(config, selection.scanned.value_range, table.bulk),
        # The figures are measured on the written bytes, within this bulk.
        "quality": {"bulk": None if table.bulk is None else {"range": list(table.bulk.ends)}},
        "training": training_header(table.plan, config),
        "history": brief_history(kept, HEAD_POINTS) if config.timings else {},
    }


def training_header(coding_plan: CodingPlan, config: EncodeConfig) -> dict[str, Any]:
    """Return what a header says of the training of the MLP.

    The device is "none" where nothing was trained.
    """
    history = coding_plan.history
    if not history:
        return {"seconds": 0 if config.timings else None, "steps": 0, "epochs": 0, "device": "none"}
    last = history[-1]
    seconds, steps, samples = last["seconds"], last["epoch"], last["samples"]
    assert seconds is not None
    assert steps is not None
    assert samples is not None
    return {
        "seconds": round(seconds, 3) if config.timings else None,
        "steps": int(steps),
        "epochs": max(1, round(steps * BATCH_VOXELS / samples)),
        "device": training_device(config),
        **({} if coding_plan.saved is None else {"saved": round(coding_plan.saved, 3)}),
    }
