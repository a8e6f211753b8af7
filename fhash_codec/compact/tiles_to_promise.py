"""The compact profile: series -> coreset -> plan on a sample -> tiles coded in parallel -> container."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import prod
from typing import Any

from fhash_codec.compact.choices.step import SLOPE, nearer
from fhash_codec.compact.choices.transform import refit, usual_transform
from fhash_codec.compact.goal import goal_of
from fhash_codec.compact.plan import Planned, plan
from fhash_codec.compact.tiles.blocks import Blocks, Care, Index, Values
from fhash_codec.compact.tiles.coding import Outcome, code, total
from fhash_codec.compact.tiles.sample import pool
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import FeatureSelection
from fhash_codec.progress import Progress
from fhash_formats.container import ContainerWriter, shard_shape
from fhash_formats.series import Series
from fhash_formats.support.threads import usable_threads

OVERHEAD_BYTES = 3000
"""Of a container without its tiles, roughly; only the search for a ratio needs it."""
PASSES = 4
"""Most times that the whole is coded to keep a promise that the sample did not foretell."""
SAFE, EXCEEDED = 1e-3, 0.05
"""dB above what was promised: the least to be aimed at, since a promise may not be missed by a rounding; what is worth another pass."""
QUICK_AIM, QUICK_ROOM = 0.12, 0.35
"""The same at effort 1, where one pass should do: the foresight is about so precise."""
UNLIKE = 0.3
"""dB by which all tiles may be worse than the sample before what was trained on it is dropped."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """The coded table: streams in C order of the tiles, how they were made, what they give."""

    planned: Planned
    streams: list[bytes]
    outcome: Outcome


def code_series(
    series: Series, found: FeatureSelection, config: EncodeConfig, progress: Progress
) -> Table:
    """Plan and code all tiles so that the promise of the settings is kept, if it can be."""
    value_range, extent = found.scanned.value_range, found.extent
    raw_bytes = prod(series.shape) * series.dtype.itemsize
    goal = goal_of(config, value_range, raw_bytes, OVERHEAD_BYTES)
    blocks = Blocks(series, extent, series.shape)
    begun = time.perf_counter()
    with pool() as workers:
        planned = plan(
            blocks, value_range, config, goal, OVERHEAD_BYTES, workers, progress, found.features
        )
        if goal.psnr is None or goal.data_range == 0:
            streams, outcome = _code_all(planned, workers, progress)
            best = Table(planned=planned, streams=streams, outcome=outcome)
        else:
            best = _to_psnr(
                planned, goal.psnr, quick=config.effort == 1, workers=workers, progress=progress
            )
    gains = best.planned.gains
    gains.append(
        {
            "what": "all tiles",
            "bytes": best.outcome.size + OVERHEAD_BYTES,
            "seconds": round(time.perf_counter() - begun, 3),
        }
    )
    return best


def _to_psnr(
    planned: Planned, psnr: float, *, quick: bool, workers: ThreadPoolExecutor, progress: Progress
) -> Table:
    """Code all tiles until they reach a PSNR.

    Where the tiles turn out to be much worse than the sample said, what was learnt from it is dropped, one after the other: the head, then
    the data's own bases.
    """
    data_range = planned.goal.data_range
    least = psnr + SAFE
    if quick:
        planned = replace(
            planned,
            settings=replace(
                planned.settings, step=planned.settings.step * (1 - QUICK_AIM / SLOPE)
            ),
        )
    best: Table | None = None
    for part in _simpler(planned):
        points: list[tuple[float, float]] = []
        now = part
        for attempt in range(PASSES):
            streams, outcome = _code_all(now, workers, progress)
            reached = outcome.psnr(data_range)
            if best is None or _better(outcome, best.outcome, data_range, least):
                best = Table(planned=now, streams=streams, outcome=outcome)
            missed = reached < least
            if not missed and (
                attempt > 0
                or reached < psnr + (QUICK_ROOM if quick else EXCEEDED)
                or math.isinf(reached)
            ):
                break
            if reached < least - UNLIKE and attempt == 0 and now.settings.head is not None:
                break  # the head does not hold for all tiles
            points.append((math.log(now.settings.step), reached))
            margin = 0.005 * 2**attempt if not quick else EXCEEDED + abs(reached - psnr) / 8
            before = now.settings.step
            now = replace(now, settings=nearer(now.settings, points, least + margin))
            if now.sample is not None and now.settings.step < before / 1.5:
                now = replace(now, settings=refit(now.sample, now.settings))
        if best is not None and best.outcome.psnr(data_range) >= least:
            break
    assert best is not None
    return best


def _simpler(planned: Planned) -> Iterator[Planned]:
    """What was planned, then without its head, then with wavelets alone."""
    settings = planned.settings
    yield planned
    if settings.head is not None:
        settings = replace(settings, head=None)
        yield replace(planned, settings=settings)
    if any(axis.basis is not None for axis in settings.transform.axes):
        yield replace(
            planned, settings=replace(settings, transform=usual_transform(planned.blocks.tile))
        )


def _better(one: Outcome, other: Outcome, data_range: float, least: float) -> bool:
    """Whether an outcome is to be taken instead of another: it keeps the promise in fewer bytes, or misses it by less."""
    reached, before = one.psnr(data_range), other.psnr(data_range)
    if min(reached, before) < least:
        return reached > before
    return one.size < other.size


def write_table(writer: ContainerWriter, table: Table) -> None:
    """Write the table; where the coreset is not the whole box, its tiles say what is in it."""
    blocks, settings = table.planned.blocks, table.planned.settings
    writer.add_sharded(
        "tables/level_1",
        shape=blocks.shape,
        dtype=blocks.dtype,
        chunk_shape=blocks.tile,
        shard_shape=shard_shape(blocks.tile, blocks.grid),
        chunks=iter(table.streams),
        dimension_names=("t", "z", "y", "x"),
        codecs=[
            {"name": "fhash.transform", "configuration": settings.to_dict()},
            {"name": "crc32c"},
        ],
    )


def compact_header(table: Table, config: EncodeConfig) -> dict[str, Any]:
    """What a compact file's header says of its model."""
    blocks, settings, outcome = table.planned.blocks, table.planned.settings, table.outcome
    weights = (
        0
        if settings.head is None
        else sum(layer.weights.size + layer.biases.size for layer in settings.head.layers)
    )
    head = (
        None
        if settings.head is None
        else {"hidden": list(settings.head.hidden), "cross": settings.head.cross}
    )
    return {
        "profile": "compact",
        "levels": [list(blocks.shape)],
        "embedding_size": 1,
        "tables": blocks.dtype.name,
        "parameters": outcome.nonzero + weights,
        "head": head,
        "gains": [
            {name: value for name, value in gain.items() if config.timings or name != "seconds"}
            for gain in table.planned.gains
        ],
    }


def required_features(table: Table) -> list[str]:
    """What a reader of the file must know."""
    return ["transform", *table.planned.settings.features]


def _code_all(
    planned: Planned, workers: ThreadPoolExecutor, progress: Progress
) -> tuple[list[bytes], Outcome]:
    """Code every tile; a few are on their way at a time, so that memory stays bounded."""
    blocks, settings, coding = planned.blocks, planned.settings, planned.coding
    everything = prod(blocks.grid)
    streams: list[bytes] = []
    outcomes: list[Outcome] = []
    waiting: deque[Future[tuple[bytes, Outcome]]] = deque()

    # Of what the search filled already, nothing else is looked for.
    known = (
        {}
        if planned.sample is None or not coding.filled
        else dict(zip(planned.sample.indices, planned.sample.tiles, strict=True))
    )

    def work(tile: Index | tuple[Values, Care]) -> tuple[bytes, Outcome]:
        values, care = blocks.read(tile) if len(tile) == 4 else tile
        coded, outcome = code(values, care, settings, coding)
        return coded.data, outcome

    def collect() -> None:
        data, outcome = waiting.popleft().result()
        streams.append(data)
        outcomes.append(outcome)
        progress("coding", len(streams), everything, "")

    for index in blocks.indices():
        waiting.append(
            workers.submit(
                work,
                known[index] if index in known else index if blocks.held else blocks.read(index),
            )
        )
        if len(waiting) > 2 * usable_threads():
            collect()
    while waiting:
        collect()
    return streams, total(outcomes)
