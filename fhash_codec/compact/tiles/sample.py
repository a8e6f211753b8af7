"""Some tiles of a series, on which choices are tried before the whole is coded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from math import prod
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.tiles.blocks import Blocks, Care, Values
from fhash_codec.compact.tiles.coding import Coding, Outcome, code, total
from fhash_codec.compact.tiles.filling import fill
from fhash_formats.support.threads import usable_threads
from fhash_formats.transform.tile.settings import TileSettings

Item = TypeVar("Item")
Result = TypeVar("Result")


GOLDEN = 0.6180339887498949
BATCH = 16
CHEAPEST = 0.05
"""What a tile is taken to cost at the least, as a part of the mean: the cheapest must be represented, too."""


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
        self._filling: tuple[TileSettings, int] | None = None

    def wider(self, most_vertices: int) -> Sample:
        """A sample of more tiles, up to so many vertices together and filled alike; this one where it has them all."""
        if self.complete:
            return self
        other = Sample(self.blocks, most_vertices, self._pool, self._costs)
        return other if self._filling is None else other.filled(*self._filling)

    def filled(self, settings: TileSettings, density: int) -> Sample:
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

    def run(self, settings: TileSettings, coding: Coding) -> Outcome:
        """Code the tiles; what coding the whole series would give."""
        return self.run_all([(settings, coding)])[0]

    def run_all(self, trials: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        """What each of some ways to code the tiles would give: at once, so that a few large tiles keep all processors busy, too."""
        jobs = [(tile, *trial) for trial in trials for tile in self.tiles]
        found = list(self._pool.map(lambda job: code(*job[0], *job[1:])[1], jobs))
        number = len(self.tiles)
        return [
            total(found[start : start + number], self.weights)
            for start in range(0, len(found), number)
        ]

    def decoded(self, settings: TileSettings, coding: Coding) -> list[npt.NDArray[np.float32]]:
        """What the tiles decode to, float32."""
        return self.map(
            lambda tile: code(tile[0], tile[1], settings, coding)[0].decoded.astype(np.float32)
        )


def pool() -> ThreadPoolExecutor:
    """One thread per processor: the native coder lets go of the interpreter."""
    return ThreadPoolExecutor(usable_threads(), thread_name_prefix="fhash-tile")
