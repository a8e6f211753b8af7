"""The coding of each level: components by their importance, transforms by trial on bytes.

An error d of an embedding (E numbers) of a level changes the values around it by g . d, with the
derivatives g of the network by the embedding. Over the coreset the squared error is d^T M d, where
the importance M is the mean of g g^T times the number of values that a vertex of the level weighs
in. The components are therefore the embeddings times U^T M^(1/2), with U the principal axes of
their covariance after multiplication by M^(1/2). An error of 1 in any component of any level then
costs the same, so one quantiser step suits all (reverse water-filling), and a direction that hardly
matters to the network takes hardly any bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from math import prod

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.choices.bases import Gram, Result
from fhash_codec.compact.choices.transform import (
    choose_transform,
    usual_transform,
)
from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.compact.tiles.coding import MIN_STEP_SHARE, Coding, Outcome, code
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.network import Floats
from fhash_codec.paper.tables.tiles import (
    ROUNDS,
    LevelCoding,
    components_of,
    tile_region,
    tile_shape,
)
from fhash_codec.paper.tables.trained_tables import Region, TrainedTable
from fhash_formats.transform.tile.integers import OFFSETS, WEIGHT
from fhash_formats.transform.tile.settings import TileSettings

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
    slopes: Floats,
    quantiser_step: float,
    workers: ThreadPoolExecutor,
    *,
    quick: bool = False,
) -> list[LevelCoding]:
    """Choose the coding of each level.

    Args:
        architecture: the sizes of the tables.
        samples: number of samples in the coreset.
        tables: the trained tables, finest first.
        slopes: derivatives (inputs, n) of the value by the network's inputs at some samples.
        quantiser_step: about the step of the coding.
        workers: threads for trials.
        quick: tries few transforms.
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
        _with_best_transforms(
            table, _coding(table, importance, floor, quantiser_step), workers, quick=quick
        )
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


def _needed_embeddings(table: TrainedTable) -> Iterator[Floats]:
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
) -> tuple[Floats, Matrix, npt.NDArray[np.float64]]:
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
    table: TrainedTable, coding: LevelCoding, workers: ThreadPoolExecutor, *, quick: bool
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
        chosen.append(choose_transform(trials, settings, how, quick=quick)[0])
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
        self.grams: dict[tuple[int, float, int | None], Gram] = {}

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
