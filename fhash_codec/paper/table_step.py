"""Codings of the tables, and their quantiser step: the coarsest one that keeps the promise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import count, product
from math import prod
from operator import itemgetter
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.goal import Bracket, geometric_mean, search
from fhash_codec.compact.tiles import MIN_STEP_SHARE, Coding, Outcome, Tile, code
from fhash_codec.compact.transform import (
    NONE,
    Bases,
    Gram,
    Result,
    TileSample,
    in_plane,
    usual_transform,
)
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.fit import TrainedModel
from fhash_codec.paper.network import Architecture, Layer, Network
from fhash_codec.paper.storage import Bricks, component_name
from fhash_codec.paper.tables import (
    ROUNDS,
    Index,
    LevelCoding,
    Region,
    Samples,
    TiledTable,
    TrainedTable,
    components_of,
    quantised_layers,
    tile_region,
    tile_shape,
    trained_tables,
    write_layers,
    write_mask,
)
from fhash_codec.progress import Progress
from fhash_formats.container import ContainerWriter
from fhash_formats.container.array import transform_codecs
from fhash_formats.support.threads import thread_pool
from fhash_formats.support.values import Single
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile import OFFSETS, WEIGHT
from fhash_formats.transform.tile_format import Shape, TileSettings

MIN_IMPORTANCE = 1e-4
"""Smallest eigenvalue of M that is used, as a share of the largest of the same level.

The network is not linear, so a direction that seems not to matter may still matter a little.
"""
MIN_LEVEL_IMPORTANCE = 1e-12
"""Smallest eigenvalue of M that is used, as a share of the largest trace of M of all levels."""
MIN_STEP = 1e-30
"""Smallest quantiser step, whatever the tables."""
Matrix = npt.NDArray[np.float64]


def choose_codings(
    architecture: Architecture,
    samples: int,
    tables: Sequence[TrainedTable],
    slopes: Single,
    quantiser_step: float,
    workers: ThreadPoolExecutor,
) -> list[LevelCoding]:
    """Choose the coding of each level.

    Args:
        architecture: the sizes of the tables.
        samples: number of samples in the coreset.
        tables: the trained tables, finest first.
        slopes: derivatives (inputs, n) of the value by the network's inputs at some samples.
        quantiser_step: about the step of the coding.
        workers: threads for trials.
    """
    size = architecture.embedding_size
    importances: list[Matrix] = []
    for number, (table, level) in enumerate(zip(tables, architecture.levels, strict=True)):
        level_slopes = slopes[number * size : (number + 1) * size].astype(np.float64)
        weight = prod(
            squared_weights(length, resolution)
            for length, resolution in zip(architecture.sizes, level, strict=True)
        )
        needed = sum(len(embeddings) for embeddings in _needed_embeddings(table))
        importances.append(
            level_slopes
            @ level_slopes.T
            / level_slopes.shape[1]
            * (samples * weight / max(needed, 1))
        )
    floor = MIN_LEVEL_IMPORTANCE * max(float(np.trace(matrix)) for matrix in importances) or 1.0
    return [
        _with_best_transforms(table, _coding(table, importance, floor, quantiser_step), workers)
        for table, importance in zip(tables, importances, strict=True)
    ]


def squared_weights(length: int, resolution: int) -> float:
    """Return the mean of the summed squared interpolation weights at the vertices of an axis.

    Args:
        length: vertices of the box along the axis.
        resolution: vertices of the level along the axis.
    """
    span = max(length - 1, 1)
    after_weight = np.arange(length) * (resolution - 1) % span / span
    return float((after_weight**2 + (1 - after_weight) ** 2).mean())


def _needed_embeddings(table: TrainedTable) -> Iterator[Single]:
    """Yield the needed embeddings (n, E) of each time node."""
    space = tuple(slice(0, n) for n in table.shape[1:4])
    for node in range(table.shape[0]):
        region: Region = (slice(node, node + 1), *space)
        yield table.read((*region, slice(0, table.shape[4])))[table.needed(region)]


def _coding(
    table: TrainedTable, importance: Matrix, floor: float, quantiser_step: float
) -> LevelCoding:
    """Choose components and range of a level, with usual transforms.

    Args:
        table: the trained table.
        importance: the matrix M of the level.
        floor: smallest eigenvalue of M that is used.
        quantiser_step: about the step of the coding.
    """
    mixing, unmixing, center = _mixing(table, importance, floor)
    low, high = _component_range(table, unmixing, center)
    t, z, y, x = table.shape[:4]
    tile = tile_shape((t, z, y, x))
    usual = usual_transform(tile)
    settings = tuple(
        TileSettings(
            transform=usual,
            step=max(quantiser_step, MIN_STEP_SHARE * float(last - first), MIN_STEP),
            center=_single(middle),
            low=_single(first),
            high=_single(last),
            offsets=OFFSETS,
        )
        for middle, first, last in zip(center, low, high, strict=True)
    )
    return LevelCoding(tile=tile, mixing=mixing, unmixing=unmixing, settings=settings)


def _mixing(
    table: TrainedTable, importance: Matrix, floor: float
) -> tuple[Single, Matrix, npt.NDArray[np.float64]]:
    """Return mixing (E, E), unmixing (E, E) and the mean of each component (E,) of a level."""
    values, axes = np.linalg.eigh(importance)
    roots = np.sqrt(np.maximum(values, max(MIN_IMPORTANCE * float(values[-1]), floor)))
    half, inverse = axes * roots @ axes.T, axes / roots @ axes.T
    total, squares, count = np.zeros(len(half)), np.zeros(half.shape), 0
    for embeddings in _needed_embeddings(table):
        weighted = embeddings.astype(np.float64) @ half
        total, squares = total + weighted.sum(axis=0), squares + weighted.T @ weighted
        count += len(weighted)
    mean = total / max(count, 1)
    _, principal = np.linalg.eigh(squares / max(count, 1) - np.outer(mean, mean))
    # The file has the mixing in float32. The unmixing is the inverse of that.
    mixing = np.ascontiguousarray((inverse @ principal).T.astype(np.float32))
    unmixing = np.linalg.inv(mixing.T.astype(np.float64))
    return mixing, unmixing, unmixing @ inverse @ mean


def _component_range(
    table: TrainedTable, unmixing: Matrix, center: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the smallest and the largest needed value of each component, (E,) each.

    Both are `center` where no vertex is needed.
    """
    low, high = center.copy(), center.copy()
    for embeddings in _needed_embeddings(table):
        if len(embeddings):
            components = embeddings.astype(np.float64) @ unmixing.T
            low = np.minimum(low, components.min(axis=0))
            high = np.maximum(high, components.max(axis=0))
    return low, high


def _with_best_transforms(
    table: TrainedTable, coding: LevelCoding, workers: ThreadPoolExecutor
) -> LevelCoding:
    """Return the coding with the transform of each component that codes the fullest tile best.

    A component within a quantiser step around its center decodes to that, whatever the transform.
    """
    chosen = []
    for component, settings in enumerate(coding.settings):
        if settings.high - settings.low < settings.step:
            chosen.append(settings)
            continue
        trials = _Trials(table, coding, component, workers)
        how = Coding(weight=WEIGHT, rounds=0 if trials.allows_bases else ROUNDS)
        chosen.append(choose_transform(trials, settings, how))
    return replace(coding, settings=tuple(chosen))


class _Trials:
    """A `TileSample` of one component of a table: its fullest tile."""

    def __init__(
        self, table: TrainedTable, coding: LevelCoding, component: int, workers: ThreadPoolExecutor
    ) -> None:
        self._table, self._coding, self._component = table, coding, component
        self._workers = workers
        grid = [
            range(-(-length // n)) for length, n in zip(table.shape[:4], coding.tile, strict=True)
        ]
        self._regions = [tile_region(index, coding.tile, table.shape) for index in product(*grid)]  # type: ignore[arg-type]
        counts = [int(np.count_nonzero(table.needed(region))) for region in self._regions]
        self._complete = sum(counts) == prod(table.shape[:4])
        self.tiles = [self._tile(self._regions[counts.index(max(counts))])]
        self.grams: dict[tuple[int, float], Gram] = {}

    @property
    def allows_bases(self) -> bool:
        """Whether all vertices of the table are needed: a basis would describe the others too."""
        return self._complete

    def map_all(self, work: Callable[[Tile], Result]) -> Iterator[Result]:
        """Yield the results of `work` for all tiles of the component."""
        return (work(self._tile(region)) for region in self._regions)

    def run_all(self, trials: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        """Return the size and the error that the tile has with each settings and coding."""
        return list(self._workers.map(lambda trial: code(self.tiles[0], *trial)[1], trials))

    def _tile(self, region: Region) -> Tile:
        components, needed = components_of(self._table, self._coding, region)
        return Tile(components[self._component], None if needed.all() else needed)


def _single(value: float) -> float:
    """Return a number rounded to float32, by the fewest digits that stand for it."""
    return float(str(np.float32(value)))


AIM = 0.4
"""Place in the window at which the search aims, as a share of its width above the lower end."""
SLOPE = 2.0
"""Usual change of the logarithm of the added error for one of the logarithm of the step."""
MIN_SLOPE = 0.5
"""Smallest slope of a secant that is believed."""
MAX_SLOPE = 6.0
"""Largest slope of a secant that is believed."""
MIN_SHARE = 1e-6
"""Smallest added error that counts in the search, as a share of the allowed one."""
CLOSEST = 1 + 1e-5
"""Ratio of two steps that are too close for another one between them."""
LONGEST = 64.0
"""Largest ratio of a step to the one before it."""


@dataclass(frozen=True)
class Window:
    """Mean squared errors that end a search.

    Attributes:
        exact: error before coding.
        least: error below which a smaller file keeps the promise as well.
        allowed: largest error.
    """

    exact: float
    least: float
    allowed: float

    @classmethod
    def of(cls, exact: float, allowed: float, width: float) -> Window:
        """Return the window that begins at an allowed error and is so many dB wide.

        It is narrower where the error before coding leaves less room.
        """
        room = 10 * math.log10(allowed / exact) if exact > 0 else math.inf
        return cls(exact, allowed * 10 ** (-min(width, room / 2) / 10), allowed)

    @property
    def aim(self) -> float:
        """Error that coding should add."""
        return float(self.least**AIM * self.allowed ** (1 - AIM)) - self.exact

    def has_room(self, error: float) -> bool:
        """Return whether an error keeps the promise, and a smaller file may keep it as well."""
        return error < self.least


class StepSearch:
    """Steps to try, one after the other, until the error lies in a window.

    Attributes:
        step: the step to try next.
        best: the largest step that kept the allowed error; None for none so far.
        done: whether another trial would gain nothing.
    """

    def __init__(self, window: Window, step: float, min_step: float) -> None:
        """Begin a search at a step; no step is smaller than `min_step`."""
        self.step = max(step, min_step)
        self.best: float | None = None
        self.done = False
        self._window, self._min_step = window, min_step
        self._bracket = Bracket(min_step, math.inf, middle=geometric_mean)
        self._points: list[tuple[float, float]] = []

    def add(self, error: float) -> bool:
        """Take up the mean squared error that `step` gave, and choose the next step.

        Returns whether the search is done.
        """
        window, step = self._window, self.step
        kept = error <= window.allowed
        if kept and (self.best is None or step > self.best):
            self.best = step
        self._bracket = self._bracket.narrowed(step, too_low=kept)
        added = max(error - window.exact, MIN_SHARE * window.aim)
        self._points.append((math.log(step), math.log(added)))
        at_limit = step <= self._min_step and not kept
        if window.least <= error <= window.allowed or at_limit:
            self.done = True
            return True
        self.step = max(self._next(), self._min_step)
        self.done = self.step in (step, self.best) or self._bracket.high < CLOSEST * max(
            self._bracket.low, self._min_step
        )
        return self.done

    def _next(self) -> float:
        """Return the step at which the aim should be met, inside of what was tried."""
        log_step, log_added = self._points[-1]
        slope = SLOPE
        if len(self._points) > 1:
            other_step, other_added = min(
                self._points[:-1], key=lambda point: abs(point[0] - log_step)
            )
            if other_step != log_step:
                slope = (log_added - other_added) / (log_step - other_step)
            slope = min(max(slope, MIN_SLOPE), MAX_SLOPE)
        change = (math.log(self._window.aim) - log_added) / slope
        longest = math.log(LONGEST)
        prediction = math.exp(log_step + min(max(change, -longest), longest))
        return self._min_step if prediction <= self._min_step else self._bracket.inside(prediction)


MAX_LOSS = 0.1
"""dB that coding may cost over the samples where no PSNR is promised or the promise is lost."""
SAFE = 1e-3
"""dB by which the search aims above a promised PSNR."""
PROMISE_WIDTH = 0.05
"""dB above a promised PSNR within which no smaller file is looked for."""
LOSS_WIDTH = 0.01
"""dB below MAX_LOSS within which no smaller file is looked for."""
GUESS = 1.8
"""Multiple of the step by its formula: most tables' numbers are near 0, and cost less error."""
SAME_CODINGS = 1.5
"""Ratio of two steps up to which the codings that were chosen for one are good for the other."""
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
class Target:
    """The quality that coded tables need.

    Attributes:
        psnr: promised PSNR in dB over the samples, if any.
    """

    psnr: float | None

    def allowed(self, exact_error: float) -> tuple[float, float]:
        """Return the mean squared error that decoded samples may have, and the search's width.

        That is the dB below the error at which the search may end.

        Args:
            exact_error: mean squared error of the tables before they are coded.
        """
        promised = 0.0 if self.psnr is None else 10 ** (-(self.psnr + SAFE) / 10)
        if promised > exact_error:
            return promised, PROMISE_WIDTH
        return max(exact_error * 10 ** (MAX_LOSS / 10), MIN_TABLES_ERROR), LOSS_WIDTH


@dataclass(frozen=True, kw_only=True)
class CodedTables:
    """Trained tables, coded.

    Attributes:
        step: the quantiser step of the finest table, and usually of all.
        tables: the tables, finest first.
        layers: weight and bias of each layer, as the file has them.
        layer_settings: how the weights of each layer are coded; None for plain numbers.
        loss: dB of PSNR over the samples that coding costs.
        error: mean squared error over the samples.
    """

    step: float
    tables: list[TiledTable]
    layers: Sequence[Layer]
    layer_settings: Sequence[TileSettings | None]
    loss: float
    error: float


class _Coding:
    """The coding of trained tables with the largest quantiser step that keeps the allowed error."""

    def __init__(
        self,
        architecture: Architecture,
        trained: Sequence[TrainedTable],
        layers: Sequence[Layer],
        samples: Samples,
        target: Target,
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
        self._allowed, self._width = target.allowed(self._error_before)
        self._quantise_layers()
        self._network_before = self._network(trained)
        self._error_of_all = self._error(self._network_before, self._all)
        self._error_of_some = self._error(self._network_before, self._some)
        self._codings: list[LevelCoding] = []
        self._min_step = MIN_STEP

    def run(self) -> CodedTables:
        """Search for the step on some of the samples, then on all."""
        guess = self._guess()
        self._choose_codings(guess)
        step = self._search(guess, self._some, ROUGH_WIDTH).step
        if not guess / SAME_CODINGS <= step <= guess * SAME_CODINGS:
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
        """Return a multiple of the step of a quantiser with the error step^2 / 12 that adds it.

        The guess takes every number of the tables to contribute equally to the errors of all
        values.
        """
        numbers = sum(prod(table.shape) for table in self._trained)
        added = max(self._allowed - self._error_of_all, 0.0)
        return GUESS * math.sqrt(12 * added * self._samples.total / numbers)

    def _choose_codings(self, step: float) -> None:
        """Choose the coding of each level for about a step."""
        slopes = self._samples.slopes(self._network_before, self._some)
        self._codings = choose_codings(
            self._architecture,
            self._samples.total,
            self._trained,
            slopes,
            step,
            self._workers,
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
        steps = StepSearch(self._window(width), step, self._min_step)
        trials, stage = TRIALS, "trying tables"
        if tiles is self._all:
            trials, stage = TRIALS_OF_ALL, "coding tables"
        numbers = count()

        def run(step: float) -> CodedTables:
            self._progress(stage, min(next(numbers), trials), trials, f"step {step:.3g}")
            return self._coded([self._tiled(level, step) for level in self._levels], tiles)

        def following(coded: CodedTables, number: int) -> float | None:
            done = steps.add(coded.error)
            enough = steps.best is not None and number + 1 >= trials
            return None if done or enough else steps.step

        def prefers(coded: CodedTables, best: CodedTables) -> bool:
            if coded.error > self._allowed:
                return best.error > self._allowed
            return best.error > self._allowed or coded.error > best.error

        return search(run(steps.step), following, run, trials + MORE_TRIALS - 1, prefers)

    def _with_larger_step(self, coded: CodedTables, level: int) -> CodedTables:
        """Return coded tables whose error is nearer to the allowed one, by the step of one level.

        The error of small tables jumps from step to step of all levels.
        """
        window = self._window(self._width)
        steps = StepSearch(window, coded.tables[level].step, self._min_step)

        def run(trial: tuple[int, float]) -> CodedTables:
            number, step = trial
            self._progress("refining tables", number, TRIALS_OF_LEVEL, f"level {level + 1}")
            tables = list(coded.tables)
            tables[level] = self._tiled(level, step)
            return self._coded(tables, self._all)

        def following(refined: CodedTables, number: int) -> tuple[int, float] | None:
            done = steps.add(refined.error)
            room = number > 0 or window.has_room(refined.error)
            return None if done or not room else (number, steps.step)

        return search(
            coded,
            following,
            run,
            TRIALS_OF_LEVEL,
            lambda refined, best: best.error < refined.error <= window.allowed,
        )

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
    samples_of: Coreset,
    model: TrainedModel,
    target: Target,
    progress: Progress,
) -> float:
    """Code and write a trained model; return the dB of PSNR that this costs.

    The quantiser step is the largest that keeps the allowed error.

    samples_of: the training samples.
    target: the quality that the tables need.
    progress: called before each trial.
    """
    coreset = samples_of.lattice or samples_of
    bricks = Bricks(coreset)
    tables = trained_tables(architecture, coreset, bricks, model.fine, model.tables)
    samples = Samples(samples_of, tile_shape(architecture.levels[0]))
    with thread_pool() as workers:
        coding = _Coding(architecture, tables, model.layers, samples, target, workers, progress)
        coded = coding.run()
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
        writer.add_array(
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


PLANE_WAVELETS = (("9/7", 2), ("9/7", 3), ("9/7", 4), ("9/7", 5), ("haar", 3), ("5/3", 2))
"""Kinds and depths tried along y and x.

5/3 wins under tight bounds alone, and is never much better at another depth.
"""
LINE_WAVELETS = (("haar", 1), ("haar", 2), ("9/7", 1), ("9/7", 2), ("9/7", 3), ("5/3", 1))
"""Kinds and depths tried along t and along z."""
ERROR_PRICE = 0.8
"""Squared error in squared steps that is worth a byte."""
BASIS_TEXT = 1.03
"""Bytes in the file for each byte of a packed basis: it stands there as deflated base64."""


Axes = tuple[AxisTransform, AxisTransform, AxisTransform, AxisTransform]
"""Transforms along (t, z, y, x)."""


class TableTiles(TileSample, Protocol):
    """Tiles of a table on which transforms are tried."""

    def run_all(self, trials: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        """Return the size and the error that the tiles have with each settings and coding."""
        ...


def choose_transform(sample: TableTiles, settings: TileSettings, coding: Coding) -> TileSettings:
    """Return settings with the transform of the lowest J on the sample."""
    shape: Shape = sample.tiles[0].values.shape
    bases = Bases(sample, settings)
    best: tuple[float, Axes] = math.inf, settings.transform.axes
    along_z = best[1][1]
    groups = (
        _plane_trials(shape, bases),
        _line_trials(0, shape, bases),
        _line_trials(1, shape, bases),
        _time_again(shape),
    )
    for changes in groups:
        if changes is groups[-1] and best[1][1] is along_z:
            break  # nothing is new since time was chosen
        axes = best[1]
        changed = [_changed(axes, change) for change in changes]
        trials = [
            *([axes] if math.isinf(best[0]) else []),
            *(candidate for candidate in changed if candidate != axes),
        ]
        tried = _tried(sample, settings, trials, coding)
        best = min([best, *tried], key=itemgetter(0))  # the first of several that are alike
    return replace(settings, transform=TransformSpec(axes=best[1]))


def _changed(axes: Axes, change: dict[int, AxisTransform]) -> Axes:
    """Return transforms with some replaced, by the number of the axis."""
    t, z, y, x = (change.get(number, axis) for number, axis in enumerate(axes))
    return t, z, y, x


def basis_bytes(transform: TransformSpec) -> float:
    """Return the bytes that the data's own bases take in the file."""
    packed = (axis.basis.to_bytes() for axis in transform.axes if axis.basis is not None)
    return BASIS_TEXT * sum(map(len, packed))


def _tried(
    sample: TableTiles, settings: TileSettings, trials: Sequence[Axes], coding: Coding
) -> list[tuple[float, Axes]]:
    """Return J of each trial, beside the trial."""

    def cost(axes: Axes, outcome: Outcome) -> float:
        bases = basis_bytes(TransformSpec(axes=axes))
        return outcome.size + bases + outcome.squares / (ERROR_PRICE * settings.step**2)

    of_trials = [replace(settings, transform=TransformSpec(axes=axes)) for axes in trials]
    outcomes = sample.run_all([(each, coding) for each in of_trials])
    return [(cost(*pair), pair[0]) for pair in zip(trials, outcomes, strict=True)]


def _plane_trials(shape: Shape, bases: Bases) -> Iterator[dict[int, AxisTransform]]:
    """Yield the transforms tried along y and x."""
    y, x = shape[2:]
    for kind, depth in PLANE_WAVELETS:
        if 2 ** (depth - 1) < max(y, x):
            yield in_plane(kind, depth, shape)
    if bases.possible(y, x):
        yield {2: bases.along(2), 3: bases.along(3)}


def _time_again(shape: Shape) -> Iterator[dict[int, AxisTransform]]:
    """Yield what is tried along time once more, after the choice along z.

    Of a thin shell that moves, steps have nothing in common; beside a wavelet along z that does no
    good either, this was not seen.
    """
    if shape[0] > 1:
        yield {0: NONE}


def _line_trials(axis: int, shape: Shape, bases: Bases) -> Iterator[dict[int, AxisTransform]]:
    """Yield the transforms tried along one axis."""
    length = shape[axis]
    if length == 1:
        return
    yield {axis: NONE}
    for kind, depth in LINE_WAVELETS:
        if 2 ** (depth - 1) < length:
            yield {axis: AxisTransform(kind=kind, depth=depth)}
    if bases.possible(length):
        yield {axis: bases.along(axis)}
