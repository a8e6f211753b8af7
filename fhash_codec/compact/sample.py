"""Some tiles of a series, on which choices are tried before the whole is coded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import prod
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.blocks import Blocks, Care, Values
from fhash_codec.network import usable_threads
from fhash_formats.transform.settings import Settings
from fhash_formats.transform.tile import CodedTile, encode_tile, exact_tile

Item = TypeVar("Item")
Result = TypeVar("Result")

WEIGHT = 0.09
"""Squared steps that a bit is worth to the quantiser (findings: best between 0.07 and 0.11)."""
OFFSETS = (-5, -1, 0)
"""Where magnitudes of 1, 2 and more stand after rate-distortion optimisation, in 1/128 step."""
SLOPE = 5.5
"""dB by which the PSNR falls when the step grows by a factor of e: to begin a search with."""
SMALLEST_STEP = 2.0**-26
"""Of the range: integers beyond 2^30 cannot be coded."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """How tiles are coded besides their settings: see `encode_tile`. exact: without loss, by `exact_tile`."""

    weight: float = WEIGHT
    rounds: int = 0
    passes: int = 1
    error: float | None = None
    filled: bool = False
    exact: bool = False


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What coding some tiles gave: bytes of the streams, squared error and number of the values that count, the largest error."""

    size: int
    squares: float
    count: int
    largest: float
    nonzero: int = 0

    def psnr(self, data_range: float) -> float:
        """In dB; infinite without error."""
        if self.squares == 0 or self.count == 0 or data_range == 0:
            return math.inf
        return 20 * math.log10(data_range) - 10 * math.log10(self.squares / self.count)


def code(values: Values, care: Care, settings: Settings, way: Way) -> tuple[CodedTile, Outcome]:
    """Code one tile and measure it."""
    if way.exact:
        count = values.size if care is None else int(np.count_nonzero(care))
        coded = exact_tile(values)
        return coded, Outcome(size=len(coded.data), squares=0.0, count=count, largest=0.0)
    coded = encode_tile(
        values,
        settings,
        care=care,
        weight=way.weight,
        error=way.error,
        rounds=way.rounds,
        passes=way.passes,
        keep_missing=False,
        filled=way.filled,
    )
    squares, count, largest = _errors(values, coded.decoded, care)
    outcome = Outcome(size=len(coded.data), squares=squares, count=count, largest=largest, nonzero=coded.nonzero)
    return coded, outcome


FEW_TILES, FEW_VERTICES = 8, 12 << 20
"""So few tiles differ too much to stand for each other: all are taken, if together they have at most so many vertices."""
GOLDEN = 0.6180339887498949
BATCH = 16
PIECE = 1 << 14
"""Values whose errors are taken at once: float64 copies of them stay in the cache."""


def _errors(values: Values, decoded: Values, care: Care) -> tuple[float, int, float]:
    """Sum of the squared errors, number and largest of the errors of the values that count."""
    squares, count, largest = 0.0, 0, 0.0
    one, other = values.ravel(), decoded.ravel()
    counts = None if care is None else care.ravel()
    with np.errstate(over="ignore", invalid="ignore"):
        for start in range(0, one.size, PIECE):
            part = slice(start, start + PIECE)
            difference = np.subtract(other[part], one[part], dtype=np.float64)
            if counts is not None:
                difference = difference[counts[part]]
            if difference.size:
                count += difference.size
                largest = max(largest, float(difference.max()), -float(difference.min()))
                squares += float(np.multiply(difference, difference, out=difference).sum())
    return squares, count, largest


def total(outcomes: Sequence[Outcome]) -> Outcome:
    """All of them as one."""
    return Outcome(
        size=sum(o.size for o in outcomes),
        squares=math.fsum(o.squares for o in outcomes),
        count=sum(o.count for o in outcomes),
        largest=max((o.largest for o in outcomes), default=0.0),
        nonzero=sum(o.nonzero for o in outcomes),
    )


class Sample:
    """Tiles in memory.

    Attributes:
        tiles: (values, what counts). share: how many tiles of the series each stands for. blocks: the whole series.
    """

    def __init__(self, blocks: Blocks, most_vertices: int, pool: ThreadPoolExecutor) -> None:
        """Evenly spread tiles of at most so many vertices together, at least one."""
        indices = list(blocks.indices())
        wanted = min(len(indices), max(1, most_vertices // prod(blocks.tile)))
        if prod(blocks.shape) <= FEW_VERTICES and len(indices) <= FEW_TILES:
            wanted = len(indices)
        # By the golden ratio, so that no row or column of the grid is preferred; then in C order, for the reader's sake.
        order = sorted(range(len(indices)), key=lambda number: number * GOLDEN % 1.0)
        chosen = [indices[number] for number in sorted(order[:wanted])]
        tiles = [blocks.read(index) for index in chosen]
        counting = [tile for tile in tiles if tile[1] is None or tile[1].any()]
        self.tiles = counting or tiles[:1]
        self.share = len(indices) / len(chosen)
        self.blocks = blocks
        self._pool = pool

    def map(self, work: Callable[[tuple[Values, Care]], Result]) -> list[Result]:
        """The results for all tiles, in order, by all processors."""
        return list(self._pool.map(work, self.tiles))

    def map_all(self, work: Callable[[tuple[Values, Care]], Result]) -> Iterator[Result]:
        """The results for all tiles of the series, some at a time."""
        indices = list(self.blocks.indices())
        for start in range(0, len(indices), BATCH):
            yield from self._pool.map(work, [self.blocks.read(index) for index in indices[start : start + BATCH]])

    def run(self, settings: Settings, way: Way) -> Outcome:
        """Code all tiles."""
        return total(self.map(lambda tile: code(tile[0], tile[1], settings, way)[1]))

    def decoded(self, settings: Settings, way: Way) -> list[npt.NDArray[np.float32]]:
        """What the tiles decode to, float32."""
        return self.map(lambda tile: code(tile[0], tile[1], settings, way)[0].decoded.astype(np.float32))


def solve_step(sample: Sample, settings: Settings, way: Way, psnr: float, data_range: float, *, tries: int = 5) -> tuple[Settings, Outcome]:
    """Settings with the step at which the sample just reaches a PSNR, within 0.02 dB if that can be had in so many tries."""
    log_step = math.log(settings.step)
    points: list[tuple[float, float]] = []
    best: tuple[float, Settings, Outcome] | None = None
    for _ in range(tries):
        log_step = max(log_step, math.log(data_range * SMALLEST_STEP))
        settings = replace(settings, step=math.exp(log_step))
        outcome = sample.run(settings, way)
        reached = outcome.psnr(data_range)
        if best is None or abs(reached - psnr) < abs(best[0] - psnr):
            best = (reached, settings, outcome)
        if abs(reached - psnr) < 0.02 or math.isinf(reached):
            break
        slope = SLOPE
        if points and abs(points[-1][0] - log_step) > 1e-9:
            slope = min(max(-(reached - points[-1][1]) / (log_step - points[-1][0]), 2.0), 12.0)
        points.append((log_step, reached))
        log_step += (reached - psnr) / slope
    assert best is not None
    return best[1], best[2]


def pool() -> ThreadPoolExecutor:
    """One thread per processor: the native coder lets go of the interpreter."""
    return ThreadPoolExecutor(usable_threads(None), thread_name_prefix="fhash-tile")
