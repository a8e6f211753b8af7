"""Coding of trained tables with one quantiser step, as large as the allowed loss permits.

The step is found by trials: the tables are coded, decoded, and the network is compared with the
samples of the coreset.
"""

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
from fhash_codec.paper.tables.codings import MIN_STEP, choose_codings
from fhash_codec.paper.tables.loss import Samples
from fhash_codec.paper.tables.tiles import Index, LevelCoding, TiledTable, tile_shape
from fhash_codec.paper.tables.trained_tables import TrainedTable, trained_tables
from fhash_codec.progress import Progress
from fhash_formats.container import ContainerWriter
from fhash_formats.support.threads import thread_pool

MAX_LOSS = 0.1
"""dB that coding may cost over the samples where no PSNR is promised or the promise is lost."""
SAFE = 1e-3
"""dB by which the search aims above a promised PSNR."""
SAMPLE = 1 << 20
"""About the number of samples on which the step is searched for first."""
TRIALS = 6
"""Steps tried on the sample."""
TRIALS_OF_ALL = 3
"""Steps tried on all samples."""
MORE_TRIALS = 20
"""Further steps tried while none has kept the allowed error."""
CLOSE = 0.98
"""Share of the allowed error from which on another trial is not worth its time."""
MIN_TABLES_ERROR = 1e-20
"""Smallest mean squared error that coding may reach, for tables without any error."""


@dataclass(frozen=True, kw_only=True)
class CodedTables:
    """Trained tables coded with one quantiser step.

    Attributes:
        step: the quantiser step.
        tables: the tables, finest first.
        loss: dB of PSNR over the samples at the key frames that coding costs.
    """

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
    """Code trained tables with the largest quantiser step that keeps the allowed error.

    Args:
        architecture: the sizes of the tables.
        coreset: the training samples.
        fine: finest embeddings (bricks, E, vertices of a brick).
        tables: the coarser tables, each (buckets, E).
        layers: weight and bias of each layer.
        psnr: promised PSNR in dB over the samples. It sets the allowed error if the tables have it
            before they are coded. Without it, coding may cost MAX_LOSS.
        workers: threads for the coding.
        progress: called before each trial.
    """
    bricks = Bricks(coreset)
    trained = trained_tables(architecture, coreset, bricks, fine, tables)
    samples = Samples(coreset, bricks, tile_shape(architecture.levels[0]))
    search = _StepSearch(architecture, trained, layers, samples, psnr, workers, progress)
    some_tiles, all_tiles = samples.choose(SAMPLE), list(samples.counts)
    search.choose_codings(coreset.values.size, some_tiles)
    sampled = search.largest_step(search.step, some_tiles, TRIALS, "trying tables")
    return search.largest_step(sampled.step, all_tiles, TRIALS_OF_ALL, "coding tables")


class _StepSearch:
    """The search for the largest quantiser step that keeps the allowed error.

    Attributes:
        step: first guess of the step.
    """

    def __init__(
        self,
        architecture: Architecture,
        trained: Sequence[TrainedTable],
        layers: Sequence[tuple[Floats, Floats]],
        samples: Samples,
        psnr: float | None,
        workers: ThreadPoolExecutor,
        progress: Progress,
    ) -> None:
        self._architecture, self._trained, self._layers = architecture, trained, layers
        self._samples, self._psnr = samples, psnr
        self._workers, self._progress = workers, progress
        self._exact = self._network(trained)
        self._codings: list[LevelCoding] = []
        self.step = self._min_step = MIN_STEP

    def choose_codings(self, samples: int, tiles: Sequence[Index]) -> None:
        """Guess the step and choose the coding of each level.

        Args:
            samples: number of samples in the coreset.
            tiles: some tiles, on which the error of the tables is measured.
        """
        squares, count = self._samples.squares(self._exact, tiles)
        # First guess: a uniform quantiser with the error step^2 / 12, as if every number of the
        # tables contributed equally to the errors of all values.
        numbers = sum(prod(table.shape) for table in self._trained)
        self.step = math.sqrt(
            12 * (_allowed_error(squares / count, self._psnr) - squares / count) * samples / numbers
        )
        slopes = self._samples.slopes(self._exact, tiles)
        self._codings = choose_codings(
            self._architecture, samples, self._trained, slopes, self.step, self._workers
        )
        self._min_step = max(
            MIN_STEP,
            MIN_STEP_SHARE
            * max(
                settings.high - settings.low
                for coding in self._codings
                for settings in coding.settings
            ),
        )

    def largest_step(
        self, step: float, tiles: Sequence[Index], trials: int, stage: str
    ) -> CodedTables:
        """Return the tables coded with the largest step found that keeps the allowed error.

        If no step keeps it, return those of the last trial.

        Args:
            step: the step to try first.
            tiles: the tiles on which the error counts.
            trials: number of steps to try.
            stage: name of the search for `progress`.
        """
        exact_squares, count = self._samples.squares(self._exact, tiles)
        allowed = _allowed_error(exact_squares / count, self._psnr) * count - exact_squares
        step = max(step, self._min_step)
        bracket = Bracket(self._min_step, math.inf, middle=geometric_mean)
        best: CodedTables | None = None
        for trial in range(trials + MORE_TRIALS):
            self._progress(stage, min(trial, trials), trials, f"step {step:.3g}")
            coded, squares = self._coded(step, tiles, exact_squares)
            share = max(squares - exact_squares, 0.0) / allowed
            if share <= 1 and (best is None or step > best.step):
                best = coded
            bracket = bracket.narrowed(step, too_low=share <= 1)
            last_trial = trial + 1 >= trials
            enough = best is not None and last_trial
            if CLOSE <= share <= 1 or step == self._min_step or enough:
                break
            # The error grows nearly as the square of the step; in small tables it may even fall.
            next_step = step * math.sqrt((1 + CLOSE) / 2 / max(share, 1e-3))
            if last_trial:
                next_step = min(next_step, step / 2)
            step = max(bracket.inside(next_step), self._min_step)
        return best or coded

    def _coded(
        self, step: float, tiles: Sequence[Index], exact_squares: float
    ) -> tuple[CodedTables, float]:
        """Return the tables coded with a step, and their squared error on some tiles.

        Args:
            step: the quantiser step.
            tiles: the tiles.
            exact_squares: the squared error before the tables are coded.
        """
        tables = [
            TiledTable(table, coding.with_step(step), self._workers)
            for table, coding in zip(self._trained, self._codings, strict=True)
        ]
        squares, _ = self._samples.squares(self._network(tables), tiles)
        loss = 0.0
        if exact_squares > 0 and squares > 0:
            loss = 10 * math.log10(squares / exact_squares)
        return CodedTables(step=step, tables=tables, loss=loss), squares

    def _network(self, tables: Sequence[TrainedTable | TiledTable]) -> Network:
        return Network(
            levels=self._architecture.levels,
            embedding_size=self._architecture.embedding_size,
            tables=tables,
            layers=tuple(self._layers),
            box_size=self._architecture.box_size,
            key_frames=self._architecture.key_frames,
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
    """Code trained tables and write them; return the dB of PSNR that this costs.

    The arguments are those of `code_tables`, after the container that is being written.
    """
    with thread_pool() as workers:
        coded = code_tables(architecture, coreset, fine, tables, layers, psnr, workers, progress)
        for level, table in enumerate(coded.tables, start=1):
            _write_table(writer, level, table)
    return coded.loss


def _write_table(writer: ContainerWriter, level: int, table: TiledTable) -> None:
    """Write each component of a coded table; levels count from 1."""
    coding = table.coding
    for component, (settings, mixing) in enumerate(
        zip(coding.settings, coding.mixing.tolist(), strict=True)
    ):
        writer.add_sharded(
            component_name(level, component + 1),
            shape=table.shape[:4],
            dtype=np.float32,
            chunk_shape=coding.tile,
            shard_shape=table.shard,
            chunks=table.streams(component),
            dimension_names=("t", "z", "y", "x"),
            attributes={"mixing": mixing},
            codecs=[
                {"name": "fhash.transform", "configuration": settings.to_dict()},
                {"name": "crc32c"},
            ],
        )


def _allowed_error(exact_error: float, psnr: float | None) -> float:
    """Return the mean squared error that decoded samples may have.

    Args:
        exact_error: mean squared error of the tables before they are coded.
        psnr: promised PSNR in dB, if any.
    """
    promised = 0.0 if psnr is None else 10 ** (-(psnr + SAFE) / 10)
    if promised > exact_error:
        return promised
    return max(exact_error * 10 ** (MAX_LOSS / 10), MIN_TABLES_ERROR)
