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

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from math import prod

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.choices.transform import wavelet
from fhash_codec.compact.tiles.coding import MIN_STEP_SHARE, OFFSETS
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.network import Floats
from fhash_codec.paper.tables.tiles import (
    LevelCoding,
    code_tile,
    components_of,
    tile_region,
    tile_shape,
)
from fhash_codec.paper.tables.trained_tables import Region, TrainedTable
from fhash_formats.transform.axes.spec import TransformSpec
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

MIN_IMPORTANCE = 1e-4
"""Smallest eigenvalue of M that is used, as a share of the largest of the same level.

The network is not linear, so a direction that seems not to matter may still matter a little.
"""
MIN_LEVEL_IMPORTANCE = 1e-12
"""Smallest eigenvalue of M that is used, as a share of the largest trace of M of all levels."""
MIN_STEP = 1e-30
"""Smallest quantiser step, whatever the tables."""
TRANSFORMS = (
    (("none", 0), ("none", 0), ("none", 0)),
    (("none", 0), ("9/7", 1), ("9/7", 3)),
    (("haar", 1), ("9/7", 1), ("9/7", 3)),
    (("9/7", 1), ("9/7", 1), ("9/7", 3)),
    (("none", 0), ("5/3", 1), ("5/3", 2)),
    (("none", 0), ("none", 0), ("9/7", 2)),
)
"""Transforms to try: (kind, depth) along t, along z, and along both y and x."""
SQUARED_STEPS_A_BYTE = 0.8
"""Squared error, in squared quantiser steps, that is worth a byte when transforms are compared."""

Matrix = npt.NDArray[np.float64]


def choose_codings(
    architecture: Architecture,
    samples: int,
    tables: Sequence[TrainedTable],
    slopes: Floats,
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
        _choose_coding(table, importance, floor, quantiser_step, workers)
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


def _choose_coding(
    table: TrainedTable,
    importance: Matrix,
    floor: float,
    quantiser_step: float,
    workers: ThreadPoolExecutor,
) -> LevelCoding:
    """Choose components, range and transforms of a level.

    Args:
        table: the trained table.
        importance: the matrix M of the level.
        floor: smallest eigenvalue of M that is used.
        quantiser_step: about the step of the coding.
        workers: threads for trials.
    """
    mixing, unmixing, center = _mixing(table, importance, floor)
    low, high = _component_range(table, unmixing, center)
    t, z, y, x = table.shape[:4]
    tile = tile_shape((t, z, y, x))
    plain = _spec(TRANSFORMS[0], tile)
    settings = tuple(
        TileSettings(
            transform=plain,
            step=max(quantiser_step, MIN_STEP_SHARE * float(last - first), MIN_STEP),
            center=_single(middle),
            low=_single(first),
            high=_single(last),
            offsets=OFFSETS,
        )
        for middle, first, last in zip(center, low, high, strict=True)
    )
    coding = LevelCoding(tile=tile, mixing=mixing, unmixing=unmixing, settings=settings)
    return _with_best_transforms(table, coding, workers)


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
    table: TrainedTable, coding: LevelCoding, workers: ThreadPoolExecutor
) -> LevelCoding:
    """Return the coding with the transform of each component that codes the fullest tile best."""
    grid = [range(-(-length // n)) for length, n in zip(table.shape[:4], coding.tile, strict=True)]
    regions = [tile_region(index, coding.tile, table.shape) for index in product(*grid)]  # type: ignore[arg-type]
    fullest = max(regions, key=lambda region: int(np.count_nonzero(table.needed(region))))
    components, needed = components_of(table, coding, fullest)
    specs = list(dict.fromkeys(_spec(kinds, coding.tile) for kinds in TRANSFORMS))

    def cost(trial: tuple[Floats, TileSettings]) -> float:
        component, settings = trial
        data, decoded = code_tile(component, needed, settings)
        error = (decoded[needed].astype(np.float64) - component[needed]) / settings.step
        return len(data) + float(np.square(error).sum()) / SQUARED_STEPS_A_BYTE

    chosen = []
    for component, settings in zip(components, coding.settings, strict=True):
        trials = [replace(settings, transform=spec) for spec in specs]
        costs = list(workers.map(cost, [(component, trial) for trial in trials]))
        chosen.append(trials[costs.index(min(costs))])
    return replace(coding, settings=tuple(chosen))


def _spec(kinds: Sequence[tuple[str, int]], tile: Shape) -> TransformSpec:
    """Return the transform of some TRANSFORMS, less deep along short axes of a tile."""
    t, z, y, x = (
        wavelet(*kind, length) for kind, length in zip((*kinds, kinds[-1]), tile, strict=True)
    )
    return TransformSpec(axes=(t, z, y, x))


def _single(value: float) -> float:
    """Return a number rounded to float32, by the fewest digits that stand for it."""
    return float(str(np.float32(value)))
