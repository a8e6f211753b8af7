"""Trained tables to tiles with one quantiser step, as large as the allowed loss lets it be: searched on what the decoder returns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import prod

import numpy as np

from fhash_codec.compact.choices.search import Bracket, geometric_mean
from fhash_codec.compact.tiles.coding import MIN_STEP_SHARE
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.network import Floats, Network
from fhash_codec.paper.storage import component_name
from fhash_codec.paper.tables.bricks import Bricks
from fhash_codec.paper.tables.codings import SMALLEST, choose_codings
from fhash_codec.paper.tables.loss import Samples
from fhash_codec.paper.tables.tiles import Index, TiledTable, tile_shape
from fhash_codec.paper.tables.trained_tables import TrainedTable, trained_tables
from fhash_codec.progress import Progress
from fhash_formats.container import ContainerWriter
from fhash_formats.support.threads import thread_pool

MAX_LOSS = 0.1
"""dB that the coded tables may cost over the samples, where no PSNR is promised or it is out of reach."""
SAFE = 1e-3
"""dB above a promised PSNR that are aimed at."""
SAMPLE = 1 << 20
"""Samples on which the step is searched for first, about."""
TRIALS, TRIALS_OF_ALL, MORE_TRIALS = 6, 3, 20
"""Steps tried on the sample and on everything, and how many more while none has kept what is allowed."""
CLOSE = 0.98
"""Part of the allowed error from which on it is not worth another trial."""


@dataclass(frozen=True, kw_only=True)
class CodedTables:
    """Tables, finest first, coded with one step so that they cost `loss` dB over the samples at the key frames."""

    step: float
    tables: list[TiledTable]
    loss: float


def code_tables(
    architecture: Architecture,
    coreset: Coreset,
    fine: Floats,
    tables: list[Floats],
    layers: list[tuple[Floats, Floats]],
    psnr: float | None,
    workers: ThreadPoolExecutor,
    progress: Progress,
) -> CodedTables:
    """Code trained tables: fine (bricks, E, vertices of a brick), tables (buckets, E), layers (weight, bias).

    The step is as large as MAX_LOSS allows; with `psnr`, in dB over the samples, as large as keeps it, if the tables themselves do.
    """
    bricks = Bricks(coreset)
    trained = trained_tables(architecture, coreset, bricks, fine, tables)

    def network(sources: Sequence[TrainedTable | TiledTable]) -> Network:
        return Network(
            levels=architecture.levels,
            embedding_size=architecture.embedding_size,
            tables=sources,
            layers=tuple(layers),
            box_size=architecture.box_size,
            key_frames=architecture.key_frames,
        )

    exact = network(trained)
    samples = Samples(coreset, bricks, tile_shape(architecture.levels[0]))
    chosen, everything = samples.chosen(SAMPLE), list(samples.counts)
    own, count = samples.squares(exact, chosen)
    # The error of a plain quantiser, if every number of the tables were as large an error in all the values as the choice makes it.
    numbers = sum(prod(table.shape) for table in trained)
    step = math.sqrt(
        12 * (_allowed(own / count, psnr) - own / count) * coreset.values.size / numbers
    )
    codings = choose_codings(
        architecture, coreset.values.size, trained, samples.slopes(exact, chosen), step, workers
    )
    smallest = max(
        SMALLEST, MIN_STEP_SHARE * max(s.high - s.low for coding in codings for s in coding.settings)
    )

    def nearest(step: float, tiles: Sequence[Index], trials: int, stage: str) -> CodedTables:
        """With the largest step found that keeps what is allowed on some tiles."""
        own, count = samples.squares(exact, tiles)
        allowed = _allowed(own / count, psnr) * count - own
        step, bracket = max(step, smallest), Bracket(smallest, math.inf, middle=geometric_mean)
        best: CodedTables | None = None
        for trial in range(trials + MORE_TRIALS):
            progress(stage, min(trial, trials), trials, f"step {step:.3g}")
            coded = [
                TiledTable(table, coding.with_step(step), workers)
                for table, coding in zip(trained, codings, strict=True)
            ]
            total, _ = samples.squares(network(coded), tiles)
            found = CodedTables(
                step=step,
                tables=coded,
                loss=10 * math.log10(total / own) if own > 0 and total > 0 else 0.0,
            )
            share = max(total - own, 0.0) / allowed
            if share <= 1 and (best is None or step > best.step):
                best = found
            bracket = bracket.narrowed(step, too_low=share <= 1)
            if (
                CLOSE <= share <= 1
                or step == smallest
                or (best is not None and trial + 1 >= trials)
            ):
                break
            # The error grows as the square of the step, nearly; in small tables not even steadily.
            wanted = step * math.sqrt((1 + CLOSE) / 2 / max(share, 1e-3))
            if best is None and trial + 1 >= trials:
                wanted = min(wanted, step / 2)
            step = max(bracket.inside(wanted), smallest)
        return best or found

    return nearest(
        nearest(step, chosen, TRIALS, "trying tables").step,
        everything,
        TRIALS_OF_ALL,
        "coding tables",
    )


def write_coded(
    writer: ContainerWriter,
    architecture: Architecture,
    coreset: Coreset,
    fine: Floats,
    tables: list[Floats],
    layers: list[tuple[Floats, Floats]],
    psnr: float | None,
    progress: Progress,
) -> float:
    """Code trained tables as `code_tables` does and write them; the dB that it costs."""
    with thread_pool() as workers:
        coded = code_tables(architecture, coreset, fine, tables, layers, psnr, workers, progress)
        for level, table in enumerate(coded.tables, start=1):
            for number, (settings, mixing) in enumerate(
                zip(table.coding.settings, table.coding.mixing.tolist(), strict=True)
            ):
                writer.add_sharded(
                    component_name(level, number + 1),
                    shape=table.shape[:4],
                    dtype=np.float32,
                    chunk_shape=table.coding.tile,
                    shard_shape=table.shard,
                    chunks=table.streams(number),
                    dimension_names=("t", "z", "y", "x"),
                    attributes={"mixing": mixing},
                    codecs=[
                        {"name": "fhash.transform", "configuration": settings.to_dict()},
                        {"name": "crc32c"},
                    ],
                )
    return coded.loss


def _allowed(own: float, psnr: float | None) -> float:
    """The mean squared error that the decoded samples may have, above that of the tables themselves."""
    promised = 0.0 if psnr is None else 10 ** (-(psnr + SAFE) / 10)
    return promised if promised > own else max(own * 10 ** (MAX_LOSS / 10), 1e-20)
