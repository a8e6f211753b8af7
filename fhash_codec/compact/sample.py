"""Some tiles of a series, on which choices are tried before the whole is coded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from math import prod
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.blocks import Blocks, Care, Values
from fhash_codec.compact.filling import fill
from fhash_codec.network import usable_threads
from fhash_codec.normalise import power_of_two
from fhash_codec.sums import squared_errors
from fhash_formats.transform.settings import Settings
from fhash_formats.transform.tile import CodedTile, encode_tile, exact_tile

Item = TypeVar("Item")
Result = TypeVar("Result")

WEIGHT = 0.09
"""Squared steps that a bit is worth to the quantiser (findings: best between 0.07 and 0.11)."""
OFFSETS = (-5, -1, 0)
"""Where magnitudes of 1, 2 and more stand after rate-distortion optimisation, in 1/128 step."""
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
    density: int = 1
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
        coded = exact_tile(
            values,
            occupied=None
            if settings.mask is None
            else np.ones(values.shape, bool)
            if care is None
            else care,
        )
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
        density=way.density,
    )
    # Scaled, so that neither huge nor tiny ranges over- or underflow.
    scale = power_of_two(settings.high - settings.low)
    count, squares, largest = squared_errors(values, coded.decoded, care, scale)
    outcome = Outcome(
        size=len(coded.data),
        squares=squares / scale**2,
        count=count,
        largest=largest / scale,
        nonzero=coded.nonzero,
    )
    return coded, outcome


GOLDEN = 0.6180339887498949
BATCH = 16
CHEAPEST = 0.05
"""What a tile is taken to cost at the least, as a part of the mean: the cheapest must be represented, too."""


def total(outcomes: Sequence[Outcome], weights: Sequence[int] | None = None) -> Outcome:
    """All of them as one. weights: how many tiles each stands for, 1 if left out."""
    pairs = list(zip(weights or [1] * len(outcomes), outcomes, strict=True))
    return Outcome(
        size=sum(weight * o.size for weight, o in pairs),
        squares=math.fsum(weight * o.squares for weight, o in pairs),
        count=sum(weight * o.count for weight, o in pairs),
        largest=max((o.largest for o in outcomes), default=0.0),
        nonzero=sum(weight * o.nonzero for weight, o in pairs),
    )


def strata(costs: Sequence[float], number: int) -> list[tuple[int, int]]:
    """At most so many of the tiles, each with the number of tiles that it stands for, in the order of the tiles.

    costs: what each tile costs, roughly. Tiles of similar cost form a stratum, which its middle one stands for; all strata cost about the
    same, so that a dear tile stands for itself, and a cheap one for many.
    """
    order = np.argsort(costs, kind="stable")
    floor = CHEAPEST * float(np.mean(costs)) or 1.0
    so_far = np.cumsum(np.asarray(costs, dtype=np.float64)[order] + floor)
    groups = np.minimum((so_far / so_far[-1] * number * (1 - 1e-12)).astype(int), number - 1)
    chosen = []
    for group in np.unique(groups):
        members = order[groups == group]
        chosen.append((int(members[len(members) // 2]), len(members)))
    return sorted(chosen)


class Sample:
    """Tiles in memory that stand for all.

    Attributes:
        tiles: (values, what counts). indices: which tiles these are. weights: how many tiles of the series each stands for.
        complete: whether these are all that count.
        counted: vertices that count, of the whole series, roughly. blocks: the whole series.
    """

    def __init__(
        self,
        blocks: Blocks,
        most_vertices: int,
        pool: ThreadPoolExecutor,
        costs: Sequence[float] | None = None,
    ) -> None:
        """Tiles of at most so many vertices together, at least one.

        costs: what each tile costs, roughly, in C order; tiles are then chosen by it (`strata`), else spread evenly.
        """
        indices = list(blocks.indices())
        wanted = min(len(indices), max(1, most_vertices // prod(blocks.tile)))
        if wanted == len(indices):
            chosen = [(number, 1) for number in range(wanted)]
        elif costs is not None:
            chosen = strata(costs, wanted)
        else:
            # By the golden ratio, so that no row or column of the grid is preferred; then in C order, for the reader's sake.
            order = sorted(range(len(indices)), key=lambda number: number * GOLDEN % 1.0)
            weights = [
                len(indices) * (place + 1) // wanted - len(indices) * place // wanted
                for place in range(wanted)
            ]
            chosen = list(zip(sorted(order[:wanted]), weights, strict=True))
        found = [
            (indices[number], blocks.read(indices[number]), weight) for number, weight in chosen
        ]
        found = [one for one in found if one[1][1] is None or one[1][1].any()] or found[:1]
        self.indices, self.tiles, self.weights = (
            [one[0] for one in found],
            [one[1] for one in found],
            [one[2] for one in found],
        )
        self.complete = wanted == len(indices)
        self.counted = sum(
            weight * (values.size if care is None else int(np.count_nonzero(care)))
            for _, (values, care), weight in found
        )
        self.blocks = blocks
        self._pool, self._costs, self._source = pool, costs, self.tiles
        self._filling: tuple[Settings, int] | None = None

    def wider(self, most_vertices: int) -> Sample:
        """A sample of more tiles, up to so many vertices together and filled alike; this one where it has them all."""
        if self.complete:
            return self
        other = Sample(self.blocks, most_vertices, self._pool, self._costs)
        return other if self._filling is None else other.filled(*self._filling)

    def filled(self, settings: Settings, density: int) -> Sample:
        """The same tiles with values that suit the settings where they do not count, whatever stood there before; see `fill`."""
        if self.blocks.complete:
            return self
        other = copy(self)
        other._filling = settings, density
        other.tiles = list(
            self._pool.map(lambda tile: fill(tile[0], tile[1], settings, density), self._source)
        )
        return other

    def map(self, work: Callable[[tuple[Values, Care]], Result]) -> list[Result]:
        """The results for all tiles, in order, by all processors."""
        return list(self._pool.map(work, self.tiles))

    def map_all(self, work: Callable[[tuple[Values, Care]], Result]) -> Iterator[Result]:
        """The results for all tiles of the series, some at a time."""
        indices = list(self.blocks.indices())
        if self.blocks.held:
            yield from self._pool.map(lambda index: work(self.blocks.read(index)), indices)
            return
        for start in range(0, len(indices), BATCH):
            yield from self._pool.map(
                work, [self.blocks.read(index) for index in indices[start : start + BATCH]]
            )

    def run(self, settings: Settings, way: Way) -> Outcome:
        """Code the tiles; what coding the whole series would give."""
        return self.run_all([(settings, way)])[0]

    def run_all(self, trials: Sequence[tuple[Settings, Way]]) -> list[Outcome]:
        """What each of some ways to code the tiles would give: at once, so that a few large tiles keep all processors busy, too."""
        jobs = [(tile, *trial) for trial in trials for tile in self.tiles]
        found = list(self._pool.map(lambda job: code(*job[0], *job[1:])[1], jobs))
        number = len(self.tiles)
        return [
            total(found[start : start + number], self.weights)
            for start in range(0, len(found), number)
        ]

    def decoded(self, settings: Settings, way: Way) -> list[npt.NDArray[np.float32]]:
        """What the tiles decode to, float32."""
        return self.map(
            lambda tile: code(tile[0], tile[1], settings, way)[0].decoded.astype(np.float32)
        )


def pool() -> ThreadPoolExecutor:
    """One thread per processor: the native coder lets go of the interpreter."""
    return ThreadPoolExecutor(usable_threads(None), thread_name_prefix="fhash-tile")
