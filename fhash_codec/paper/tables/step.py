"""Coding of trained tables with one quantiser step, as large as the allowed loss permits.

The step is found by trials (`step_search.py`): the tables are coded, decoded, and the network is
compared with the samples of the coreset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import prod

import numpy as np

from fhash_codec.compact.tiles.coding import MIN_STEP_SHARE
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.network import Floats, Layer, Network
from fhash_codec.paper.storage import component_name
from fhash_codec.paper.tables.bricks import Bricks
from fhash_codec.paper.tables.codings import MIN_STEP, choose_codings
from fhash_codec.paper.tables.loss import Samples
from fhash_codec.paper.tables.small_parts import quantised_layers, write_layers, write_mask
from fhash_codec.paper.tables.step_search import StepSearch, Window
from fhash_codec.paper.tables.tiles import Index, LevelCoding, TiledTable, tile_shape
from fhash_codec.paper.tables.trained_tables import TrainedTable, trained_tables
from fhash_codec.progress import Progress
from fhash_formats.container import ContainerWriter
from fhash_formats.container.coding import transform_codecs
from fhash_formats.support.threads import thread_pool
from fhash_formats.transform.tile.settings import TileSettings

MAX_LOSS = 0.1
"""dB that coding may cost over the samples where no PSNR is promised or the promise is lost."""
SAFE = 1e-3
"""dB by which the search aims above a promised PSNR."""
PROMISE_WIDTH = 0.05
"""dB above a promised PSNR within which no smaller file is looked for."""
LOSS_WIDTH = 0.01
"""dB below MAX_LOSS within which no smaller file is looked for."""
ROUGH_WIDTH = 1.0
"""Width in dB of the window for the step at which the codings are chosen."""
SAMPLE_WIDTH = 0.1
"""Width in dB of the window on a sample."""
SAMPLE = 1 << 20
"""About the number of samples on which the step is searched for first."""
TRIALS = 4
"""Steps tried on the sample, before and after the codings are chosen."""
TRIALS_OF_ALL = 12
"""Steps tried on all samples."""
TRIALS_OF_LEVEL = 6
"""Steps of one level that are tried where no step of all levels ends in the window."""
ROUNDS_OF_LEVELS = 2
"""Largest number of times that every level is gone through for such a step."""
MORE_TRIALS = 20
"""Further steps tried while none has kept the allowed error."""
LAYERS_SHARE = 0.04
"""Share of the error that coding may add, for the quantised layers."""
LAYER_TILES = 8
"""About the number of tiles at which the error of the layers is measured."""
MIN_TABLES_ERROR = 1e-20
"""Smallest mean squared error that coding may reach, for tables without any error."""


@dataclass(frozen=True, kw_only=True)
class CodedTables:
    """Trained tables, coded.

    Attributes:
        step: the quantiser step of the finest table, and usually of all.
        tables: the tables, finest first.
        layers: weight and bias of each layer, as the file has them.
        layer_settings: how the weights of each layer are coded; None for plain numbers.
        loss: dB of PSNR over the samples at the key frames that coding costs.
        error: mean squared error over the samples.
    """

    step: float
    tables: list[TiledTable]
    layers: Sequence[Layer]
    layer_settings: Sequence[TileSettings | None]
    loss: float
    error: float


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
        fine: finest embeddings (E, samples), in the order of `Coreset.values`.
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
    return _Coding(architecture, trained, layers, samples, psnr, workers, progress).run()


class _Coding:
    """The coding of trained tables with the largest quantiser step that keeps the allowed error."""

    def __init__(
        self,
        architecture: Architecture,
        trained: Sequence[TrainedTable],
        layers: Sequence[Layer],
        samples: Samples,
        psnr: float | None,
        workers: ThreadPoolExecutor,
        progress: Progress,
    ) -> None:
        self._architecture, self._trained, self._layers = architecture, trained, layers
        self._samples = samples
        self._workers, self._progress = workers, progress
        self._all, self._some = list(samples.counts), samples.choose(SAMPLE)
        progress("measuring the model", 0, 1, "")
        self._error_before = self._error(self._network(trained), self._all)
        # All samples decide whether the promise can be kept: some may be far easier than the rest.
        self._allowed, self._width = _allowed_error(self._error_before, psnr)
        self._quantise_layers()
        self._network_before = self._network(trained)
        self._error_of_all = self._error(self._network_before, self._all)
        self._error_of_some = self._error(self._network_before, self._some)
        self._codings: list[LevelCoding] = []
        self._min_step = MIN_STEP

    def run(self) -> CodedTables:
        """Search for the step on some of the samples, then on all."""
        step = self._guess()
        self._choose_codings(step, quick=True)
        step = self._search(step, self._some, ROUGH_WIDTH).step
        self._choose_codings(step)
        if len(self._some) < len(self._all):
            step = self._search(step, self._some, SAMPLE_WIDTH).step
        coded = self._search(step, self._all, self._width)
        for _ in range(ROUNDS_OF_LEVELS):
            before = coded
            for level in self._levels:
                coded = self._with_larger_step(coded, level)
            if coded is before:
                break
        return coded

    def _quantise_layers(self) -> None:
        """Replace the layers by those that the file will have."""
        few = self._some[:: -(-len(self._some) // LAYER_TILES)]
        before = self._error(self._network(self._trained), few)

        def error(layers: Sequence[Layer]) -> float:
            return self._error(self._network(self._trained, layers), few)

        added = LAYERS_SHARE * (self._allowed - self._error_before)
        self._layers, self._layer_settings = quantised_layers(self._layers, error, before + added)

    def _guess(self) -> float:
        """Return the step of a uniform quantiser with the error step^2 / 12 that adds the error.

        The guess takes every number of the tables to contribute equally to the errors of all
        values.
        """
        numbers = sum(prod(table.shape) for table in self._trained)
        added = max(self._allowed - self._error_of_all, 0.0)
        return math.sqrt(12 * added * self._samples.total / numbers)

    def _choose_codings(self, step: float, *, quick: bool = False) -> None:
        """Choose the coding of each level for about a step, by few trials if `quick`."""
        slopes = self._samples.slopes(self._network_before, self._some)
        self._codings = choose_codings(
            self._architecture,
            self._samples.total,
            self._trained,
            slopes,
            step,
            self._workers,
            quick=quick,
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

    def _search(self, step: float, tiles: Sequence[Index], width: float) -> CodedTables:
        """Return the coded tables whose error is nearest to the allowed one, and not above it.

        If no step keeps it, return those of the last trial. The step is the largest that keeps it,
        but for small tables, whose error jumps up and down.

        Args:
            step: the step to try first.
            tiles: the tiles on which the error counts.
            width: dB above the least allowed PSNR at which the search ends.
        """
        search = StepSearch(self._window(width), step, self._min_step)
        trials, stage = TRIALS, "trying tables"
        if tiles is self._all:
            trials, stage = TRIALS_OF_ALL, "coding tables"
        best: CodedTables | None = None
        for trial in range(trials + MORE_TRIALS):
            step = search.step
            self._progress(stage, min(trial, trials), trials, f"step {step:.3g}")
            coded = self._coded([self._tiled(level, step) for level in self._levels], tiles)
            done = search.add(coded.error)
            if coded.error <= self._allowed and (best is None or coded.error > best.error):
                best = coded
            if done or (best is not None and trial + 1 >= trials):
                break
        return best or coded

    def _with_larger_step(self, coded: CodedTables, level: int) -> CodedTables:
        """Return coded tables whose error is nearer to the allowed one, by the step of one level.

        The error of small tables jumps from step to step of all levels.
        """
        window = self._window(self._width)
        search = StepSearch(window, coded.tables[level].step, self._min_step)
        done = search.add(coded.error)
        if done or not window.has_room(coded.error):
            return coded
        best = coded
        for trial in range(TRIALS_OF_LEVEL):
            self._progress("refining tables", trial, TRIALS_OF_LEVEL, f"level {level + 1}")
            tables = list(coded.tables)
            tables[level] = self._tiled(level, search.step)
            refined = self._coded(tables, self._all)
            done = search.add(refined.error)
            if best.error < refined.error <= window.allowed:
                best = refined
            if done:
                break
        return best

    @property
    def _levels(self) -> range:
        return range(len(self._trained))

    def _window(self, width: float) -> Window:
        """Return the window of a search that ends so many dB above the least allowed PSNR."""
        return Window.of(min(self._error_of_all, self._allowed), self._allowed, width)

    def _tiled(self, level: int, step: float) -> TiledTable:
        """Return the table of a level, to be coded with a step of a few digits."""
        step = float(f"{step:.6g}")
        return TiledTable(self._trained[level], self._codings[level].with_step(step), self._workers)

    def _coded(self, tables: list[TiledTable], tiles: Sequence[Index]) -> CodedTables:
        """Return coded tables with their error, which is measured on some tiles."""
        error = self._error(self._network(tables), tiles)
        if tiles is not self._all:
            # Coding adds about the same error everywhere, unlike training.
            error += self._error_of_all - self._error_of_some
        loss = 0.0
        if error > 0 and self._error_before > 0:
            loss = 10 * math.log10(error / self._error_before)
        return CodedTables(
            step=tables[0].step,
            tables=tables,
            layers=self._layers,
            layer_settings=self._layer_settings,
            loss=loss,
            error=error,
        )

    def _error(self, network: Network, tiles: Sequence[Index]) -> float:
        """Return the mean squared error of a network at the samples of some tiles."""
        squares, count = self._samples.squares(network, tiles)
        return squares / count

    def _network(
        self, tables: Sequence[TrainedTable | TiledTable], layers: Sequence[Layer] | None = None
    ) -> Network:
        return Network(
            levels=self._architecture.levels,
            embedding_size=self._architecture.embedding_size,
            tables=tables,
            layers=tuple(self._layers if layers is None else layers),
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
    """Code and write a trained model; return the dB of PSNR that this costs.

    The arguments are those of `code_tables`, after the container that is being written.
    """
    with thread_pool() as workers:
        coded = code_tables(architecture, coreset, fine, tables, layers, psnr, workers, progress)
        for level, table in enumerate(coded.tables, start=1):
            _write_table(writer, level, table)
    write_layers(writer, coded.layers, coded.layer_settings)
    write_mask(writer, coreset)
    return coded.loss


def _write_table(writer: ContainerWriter, level: int, table: TiledTable) -> None:
    """Write each component of a coded table; levels count from 1."""
    coding = table.coding
    for component, (settings, mixing) in enumerate(
        zip(coding.settings, coding.mixing, strict=True)
    ):
        writer.add_sharded(
            component_name(level, component + 1),
            shape=table.shape[:4],
            dtype=np.float32,
            chunk_shape=coding.tile,
            shard_shape=table.shard,
            chunks=table.streams(component),
            dimension_names=("t", "z", "y", "x"),
            attributes={"mixing": [float(str(number)) for number in mixing]},
            codecs=transform_codecs(settings),
        )


def _allowed_error(exact_error: float, psnr: float | None) -> tuple[float, float]:
    """Return the mean squared error that decoded samples may have, and the width of the search.

    Args:
        exact_error: mean squared error of the tables before they are coded.
        psnr: promised PSNR in dB, if any.

    Returns:
        The error, and the dB below it at which the search may end.
    """
    promised = 0.0 if psnr is None else 10 ** (-(psnr + SAFE) / 10)
    if promised > exact_error:
        return promised, PROMISE_WIDTH
    return max(exact_error * 10 ** (MAX_LOSS / 10), MIN_TABLES_ERROR), LOSS_WIDTH
