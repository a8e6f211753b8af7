"""How each level is coded: components by what matters to the network, transforms by trial on bytes.

An error d of an embedding (E numbers) of a level changes the values around it by g . d, with the derivatives g of the network: over the
coreset that is d^T M d, M the mean of g g^T times the values that a vertex of the level weighs in. So the components are the embeddings
times U^T M^(1/2), with U the axes of their covariance after M^(1/2): an error of 1 in any component of any level then costs the same, one
step suits all (reverse water-filling), and a direction that hardly matters to the network takes hardly any bits.
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
from fhash_codec.paper.tables.tiles import Coding, Index, code_tile, components_of, tile_shape
from fhash_codec.paper.tables.trained_tables import Region, TrainedTable
from fhash_formats.transform.axes.spec import TransformSpec
from fhash_formats.transform.tile.encoding import Shape
from fhash_formats.transform.tile.settings import TileSettings

LEAST = 1e-4
"""Of the largest eigenvalue of M: what matters less is coded as if it mattered so much, since the network is not linear."""
MIN_LEVEL = 1e-12
"""The same, of the largest of all levels."""
SMALLEST = 1e-30
"""Least step, whatever the tables."""
TRANSFORMS = (
    (("none", 0), ("none", 0), ("none", 0)),
    (("none", 0), ("9/7", 1), ("9/7", 3)),
    (("haar", 1), ("9/7", 1), ("9/7", 3)),
    (("9/7", 1), ("9/7", 1), ("9/7", 3)),
    (("none", 0), ("5/3", 1), ("5/3", 2)),
    (("none", 0), ("none", 0), ("9/7", 2)),
)
"""What is tried along t, z, and y and x."""
WRONG = 0.8
"""Squared steps of error that weigh as much as a byte."""

Square = npt.NDArray[np.float64]


def choose_codings(
    architecture: Architecture,
    samples: int,
    trained: Sequence[TrainedTable],
    slopes: Floats,
    step: float,
    workers: ThreadPoolExecutor,
) -> list[Coding]:
    """The coding of each level at about a step. slopes: derivatives (features, n) of the network at some of so many samples."""
    size = architecture.embedding_size
    importance: list[Square] = []
    for number, (table, level) in enumerate(zip(trained, architecture.levels, strict=True)):
        own = slopes[number * size : (number + 1) * size].astype(np.float64)
        reach = prod(
            squared_weights(length, resolution)
            for length, resolution in zip(architecture.sizes, level, strict=True)
        )
        counting = sum(len(part) for part in _counting(table))
        importance.append(own @ own.T / own.shape[1] * (samples * reach / max(counting, 1)))
    floor = MIN_LEVEL * max(float(np.trace(matrix)) for matrix in importance) or 1.0
    return [
        _coding(table, matrix, floor, step, workers)
        for table, matrix in zip(trained, importance, strict=True)
    ]


def squared_weights(length: int, resolution: int) -> float:
    """The mean over the vertices of an axis of the summed squared weights by which a level's vertices are interpolated."""
    span = max(length - 1, 1)
    after = np.arange(length) * (resolution - 1) % span / span
    return float((after**2 + (1 - after) ** 2).mean())


def _counting(table: TrainedTable) -> Iterator[Floats]:
    """The embeddings (n, E) that count, of one time node at a time."""
    space = tuple(slice(0, n) for n in table.shape[1:4])
    for node in range(table.shape[0]):
        region: Region = (slice(node, node + 1), *space)
        yield table.read((*region, slice(0, table.shape[4])))[table.cares(region)]


def _coding(
    table: TrainedTable, importance: Square, floor: float, step: float, workers: ThreadPoolExecutor
) -> Coding:
    values, axes = np.linalg.eigh(importance)
    roots = np.sqrt(np.maximum(values, max(LEAST * float(values[-1]), floor)))
    half, inverse = axes * roots @ axes.T, axes / roots @ axes.T
    total, squares, count = np.zeros(len(half)), np.zeros(half.shape), 0
    for part in _counting(table):
        wide = part.astype(np.float64) @ half
        total, squares, count = total + wide.sum(axis=0), squares + wide.T @ wide, count + len(wide)
    mean = total / max(count, 1)
    _, turned = np.linalg.eigh(squares / max(count, 1) - np.outer(mean, mean))
    # What the file has is float32; the way there is its inverse.
    mixing = np.ascontiguousarray((inverse @ turned).T.astype(np.float32))
    unmixing = np.linalg.inv(mixing.T.astype(np.float64))
    center = unmixing @ inverse @ mean
    low, high = center.copy(), center.copy()
    for part in _counting(table):
        if len(part):
            components = part.astype(np.float64) @ unmixing.T
            low, high = (
                np.minimum(low, components.min(axis=0)),
                np.maximum(high, components.max(axis=0)),
            )
    t, z, y, x = table.shape[:4]
    tile = tile_shape((t, z, y, x))
    usual = _spec(TRANSFORMS[0], tile)
    settings = tuple(
        TileSettings(
            transform=usual,
            step=max(step, MIN_STEP_SHARE * float(b - a), SMALLEST),
            center=_single(c),
            low=_single(a),
            high=_single(b),
            offsets=OFFSETS,
        )
        for c, a, b in zip(center, low, high, strict=True)
    )
    return _with_transforms(
        table, Coding(tile=tile, mixing=mixing, unmixing=unmixing, settings=settings), workers
    )


def _with_transforms(table: TrainedTable, coding: Coding, workers: ThreadPoolExecutor) -> Coding:
    """The same with the transform of each component that codes the fullest tile best."""
    grid = [range(-(-n // part)) for n, part in zip(table.shape[:4], coding.tile, strict=True)]
    regions = [_region(index, coding.tile, table.shape) for index in product(*grid)]  # type: ignore[arg-type]
    fullest = max(regions, key=lambda region: int(np.count_nonzero(table.cares(region))))
    components, care = components_of(table, coding, fullest)
    specs = list(dict.fromkeys(_spec(kinds, coding.tile) for kinds in TRANSFORMS))

    def cost(trial: tuple[Floats, TileSettings]) -> float:
        values, settings = trial
        data, decoded = code_tile(values, care, settings)
        error = (decoded[care].astype(np.float64) - values[care]) / settings.step
        return len(data) + float(np.square(error).sum()) / WRONG

    chosen = []
    for values, settings in zip(components, coding.settings, strict=True):
        trials = [replace(settings, transform=spec) for spec in specs]
        costs = list(workers.map(cost, [(values, trial) for trial in trials]))
        chosen.append(trials[costs.index(min(costs))])
    return replace(coding, settings=tuple(chosen))


def _region(index: Index, tile: Shape, shape: Sequence[int]) -> Region:
    return tuple(
        slice(i * n, min((i + 1) * n, length))
        for i, n, length in zip(index, tile, shape, strict=False)
    )


def _spec(kinds: Sequence[tuple[str, int]], tile: Shape) -> TransformSpec:
    """The transform of these kinds and depths along t, z, and y and x, less deep where a tile is short."""
    t, z, y, x = (
        wavelet(*kind, length) for kind, length in zip((*kinds, kinds[-1]), tile, strict=True)
    )
    return TransformSpec(axes=(t, z, y, x))


def _single(value: float) -> float:
    return float(np.float32(value))
