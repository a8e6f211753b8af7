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

import numpy as np

from fhash_codec.compact.blocks import Blocks, Care, Index, Values
from fhash_codec.compact.choice import refit, usual_transform
from fhash_codec.compact.plan import DEFAULT_PSNR, Planned, goal_of, plan
from fhash_codec.compact.sample import SLOPE, SMALLEST_STEP, Outcome, code, pool, total
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset import Extent
from fhash_codec.network import usable_threads
from fhash_codec.progress import Progress
from fhash_codec.selection import Found
from fhash_formats.container import ContainerWriter
from fhash_formats.series import Series
from fhash_formats.transform.settings import Settings
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile import encode_tile

OVERHEAD_BYTES = 4000
"""Of a container without its tiles, roughly; only the search for a ratio needs it."""
MOST_TILES = 4096
"""In one shard; a larger table has a shard for each layer of tiles in time."""
PASSES = 4
"""Most times that the whole is coded to keep a promise that the sample did not foretell."""
SAFE, EXCEEDED = 1e-3, 0.05
"""dB above what was promised: the least to be aimed at, since a promise may not be missed by a rounding; what is worth another pass."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """The coded table: streams in C order of the tiles, how they were made, what they give."""

    planned: Planned
    streams: list[bytes]
    outcome: Outcome


def code_series(series: Series, found: Found, config: EncodeConfig, progress: Progress) -> Table:
    """Plan and code all tiles so that the promise of the settings is kept, if it can be."""
    value_range, extent = found.scanned.value_range, found.extent
    raw_bytes = prod(series.shape) * series.dtype.itemsize
    goal = goal_of(config, value_range, raw_bytes)
    blocks = Blocks(series, extent, series.shape)
    begun = time.perf_counter()
    with pool() as workers:
        planned = plan(blocks, value_range, config, goal, OVERHEAD_BYTES, workers, progress)
        data_range = value_range.high - value_range.low
        tries: list[tuple[float, float]] = []
        best: Table | None = None
        if config.effort == 1 and goal.psnr is not None:
            # One pass should do: aim a little higher than the sample says.
            planned = replace(planned, settings=replace(planned.settings, step=planned.settings.step * (1 - EXCEEDED / SLOPE)))
        for attempt in range(2 * PASSES):
            streams, outcome = _code_all(planned, workers, progress)
            table = Table(planned=planned, streams=streams, outcome=outcome)
            if goal.psnr is None or data_range == 0:
                best = table
                break
            reached = outcome.psnr(data_range)
            missed = reached < goal.psnr + SAFE
            if best is None or best.outcome.psnr(data_range) < goal.psnr + SAFE or (not missed and outcome.size < best.outcome.size):
                best = table
            enough = not missed and reached < goal.psnr + (EXCEEDED if config.effort > 1 else 4 * EXCEEDED)
            if enough or math.isinf(reached) or (attempt >= 1 and not missed):
                break
            if attempt + 1 == PASSES:
                if not missed or all(axis.basis is None for axis in planned.settings.transform.axes):
                    break
                # The data's own bases do not reach this far; wavelets do.
                tries.clear()
                usual = usual_transform(planned.blocks.tile)
                planned = replace(planned, settings=replace(planned.settings, transform=usual))
                continue
            before = planned.settings.step
            planned = replace(planned, settings=_nearer(planned.settings, reached, goal.psnr + SAFE, tries, margin=0.005 * 2**attempt))
            if planned.sample is not None and planned.settings.step < before / 1.5:
                planned = replace(planned, settings=refit(planned.sample, planned.settings))
    assert best is not None
    gains = best.planned.gains
    gains.append({"what": "all tiles", "bytes": best.outcome.size + OVERHEAD_BYTES, "seconds": round(time.perf_counter() - begun, 3)})
    return best


def write_table(writer: ContainerWriter, table: Table, extent: Extent, progress: Progress) -> None:
    """Write the table, and the occupancy where the coreset is not the whole box."""
    blocks, settings = table.planned.blocks, table.planned.settings
    writer.add_sharded(
        "tables/level_1",
        shape=blocks.shape,
        dtype=blocks.dtype,
        chunk_shape=blocks.tile,
        shard_shape=_shard(blocks.tile, blocks.grid),
        chunks=iter(table.streams),
        dimension_names=("t", "z", "y", "x"),
        codecs=[{"name": "fhash.transform", "configuration": settings.to_dict()}, {"name": "crc32c"}],
    )
    if not blocks.complete:
        _write_occupancy(writer, blocks.shape, extent, progress)


def compact_header(table: Table, config: EncodeConfig) -> dict[str, Any]:
    """What a compact file's header says of its model."""
    blocks, settings, outcome = table.planned.blocks, table.planned.settings, table.outcome
    weights = 0 if settings.head is None else sum(layer.weights.size + layer.biases.size for layer in settings.head.layers)
    head = None if settings.head is None else {"hidden": list(settings.head.hidden)}
    return {
        "profile": "compact",
        "levels": [list(blocks.shape)],
        "embedding_size": 1,
        "tables": blocks.dtype.name,
        "parameters": outcome.nonzero + weights,
        "head": head,
        "gains": [{name: value for name, value in gain.items() if config.timings or name != "seconds"} for gain in table.planned.gains],
    }


def promise(config: EncodeConfig) -> dict[str, float]:
    """The promise of the settings by its name."""
    given = {name: getattr(config, name) for name in ("psnr", "max_error", "max_error_rel", "ratio")}
    return {name: value for name, value in given.items() if value is not None} or {"psnr": DEFAULT_PSNR}


def _nearer(settings: Settings, reached: float, psnr: float, tries: list[tuple[float, float]], *, margin: float) -> Settings:
    """A step that should reach a PSNR, by the slope that was seen, a little on the safe side."""
    log_step, slope = math.log(settings.step), SLOPE
    if tries and abs(tries[-1][0] - log_step) > 1e-9:
        slope = min(max(-(reached - tries[-1][1]) / (log_step - tries[-1][0]), 2.0), 12.0)
    tries.append((log_step, reached))
    smallest = math.log((settings.high - settings.low) * SMALLEST_STEP)
    return replace(settings, step=math.exp(max(log_step + (reached - psnr - margin) / slope, smallest)))


def _code_all(planned: Planned, workers: ThreadPoolExecutor, progress: Progress) -> tuple[list[bytes], Outcome]:
    """Code every tile; a few are on their way at a time, so that memory stays bounded."""
    blocks, settings, way = planned.blocks, planned.settings, planned.way
    everything = prod(blocks.grid)
    streams: list[bytes] = []
    outcomes: list[Outcome] = []
    waiting: deque[Future[tuple[bytes, Outcome]]] = deque()

    def work(tile: tuple[Values, Care]) -> tuple[bytes, Outcome]:
        coded, outcome = code(tile[0], tile[1], settings, way)
        return coded.data, outcome

    def collect() -> None:
        data, outcome = waiting.popleft().result()
        streams.append(data)
        outcomes.append(outcome)
        progress("coding", len(streams), everything, "")

    for index in blocks.indices():
        waiting.append(workers.submit(work, blocks.read(index)))
        if len(waiting) > 2 * usable_threads(None):
            collect()
    while waiting:
        collect()
    return streams, total(outcomes)


def _shard(tile: Index, grid: Index) -> tuple[int, ...]:
    """One shard for everything, or for one layer of tiles in time where there are many."""
    layers = grid[0] if prod(grid) <= MOST_TILES else 1
    return (layers * tile[0], *(n * count for n, count in zip(tile[1:], grid[1:], strict=True)))


_MASK = Settings(
    transform=TransformSpec(axes=(AxisTransform(kind="none"),) * 4), step=1.0, center=0.0, low=0.0, high=1.0, offsets=(0, 0, 0)
)
_MASK_VERTICES = 1 << 22


def _write_occupancy(writer: ContainerWriter, shape: tuple[int, ...], extent: Extent, progress: Progress) -> None:
    """One bit per vertex of the box, some steps together, by the coder of the table: exactly."""
    steps = max(1, min(shape[0], _MASK_VERTICES // prod(shape[1:])))

    def streams() -> Iterator[bytes]:
        for start in range(0, shape[0], steps):
            masks = np.zeros((steps, *shape[1:]), dtype=np.uint8)
            for number, key in enumerate(range(start, min(start + steps, shape[0]))):
                masks[number] = extent.mask(key)
            progress("writing occupancy", min(start + steps, shape[0]), shape[0], "")
            yield encode_tile(masks, _MASK).data

    writer.add_sharded(
        "occupancy/mask",
        shape=shape,
        dtype=np.uint8,
        chunk_shape=(steps, *shape[1:]),
        shard_shape=(-(-shape[0] // steps) * steps, *shape[1:]),
        chunks=streams(),
        dimension_names=("t", "z", "y", "x"),
        codecs=[{"name": "fhash.transform", "configuration": _MASK.to_dict()}, {"name": "crc32c"}],
    )
