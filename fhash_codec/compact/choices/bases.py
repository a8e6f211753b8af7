"""The data's own bases along the axes of a tile, which compete as transforms of short axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.choices.gram import Gram, gram_of
from fhash_codec.compact.choices.quantiser import plain_step
from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.stage_clock import stage
from fhash_formats.transform.axes.basis import MAX_LENGTH, Basis, fit_basis
from fhash_formats.transform.axes.spec import AxisTransform
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["MAX_BASIS_LENGTH", "Bases", "CountedBases", "Gram", "Result", "TileSample"]

Result = TypeVar("Result")
MAX_BASIS_LENGTH = 128
"""Longest axis in vertices that gets a basis of the data's own: longer factors cost too much."""


class TileSample(Protocol):
    """Tiles on which transforms are tried, such as a `Sample`.

    Attributes:
        tiles: the tiles, all of one shape.
        grams: products of the lines of all tiles, by axis, centre and limit of lines, once they
            were computed: bases for other steps are fitted to them again.
    """

    tiles: list[Tile]
    grams: dict[tuple[int, float, int | None], Gram]

    @property
    def allows_bases(self) -> bool:
        """Whether bases of the data's own may be computed."""
        ...

    def map_all(self, work: Callable[[Tile], Result]) -> Iterator[Result]:
        """Yield the results of `work` for all tiles that the sample stands for."""
        ...

    def run_all(self, trials: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        """Return the size and the error that the tiles have with each settings and coding."""
        ...


class Bases:
    """The data's own bases along the axes of a tile, computed when they are asked for."""

    def __init__(
        self, sample: TileSample, settings: TileSettings, lines: int | None = None
    ) -> None:
        """Begin without any. lines: of each tile, that a basis is fitted on; None for all."""
        self._sample, self._settings, self._lines = sample, settings, lines
        self._cache: dict[int, AxisTransform] = {}

    def possible(self, *lengths: int) -> bool:
        """Whether axes of these lengths can have a basis; only a series in memory can."""
        allowed = self._sample.allows_bases
        return allowed and min(lengths) > 1 and max(lengths) <= MAX_BASIS_LENGTH

    def along(self, axis: int) -> AxisTransform:
        """Return the basis along an axis, as precise as the step of the settings needs."""
        if axis not in self._cache:
            with stage("bases", "the data's own bases, which compete as transforms of short axes"):
                basis = self._fitted(axis)
            self._cache[axis] = AxisTransform(kind="klt", basis=basis)
        return self._cache[axis]

    def _fitted(self, axis: int) -> Basis:
        """Return the basis of all tiles.

        A direction that the basis drops cannot be restored by any coefficient.
        """
        grams, key = self._sample.grams, (axis, self._settings.center, self._lines)
        if key not in grams:
            length = self._sample.tiles[0].values.shape[axis]
            gram = np.zeros((length, length))
            for tile_gram in self._sample.map_all(lambda tile: self._gram(tile.values, axis)):
                gram += tile_gram
            grams[key] = gram
        return fit_basis(grams[key], plain_step(self._settings))

    def _gram(self, values: npt.NDArray[np.generic], axis: int) -> Gram:
        """Return the products of the lines of a tile along an axis, (length, length)."""
        # Values that do not count are kept: zeroing them would create an edge that dominates.
        planes = _some_lines(values, axis, self._lines)
        share = values.size / planes.size
        return gram_of(planes, self._settings.center) * share


def _some_lines(
    values: npt.NDArray[np.generic], axis: int, limit: int | None
) -> npt.NDArray[np.generic]:
    """Return the lines of a tile along axis 1 of planes, or about every n-th of them.

    limit: number of lines from which on some are left out; None for none.
    """
    before, length = math.prod(values.shape[:axis]), values.shape[axis]
    planes = values.reshape(before, length, -1)
    after = planes.shape[2]
    if limit is not None and before * after > limit:
        leap = -(-before * after // limit)
        along = min(leap, after)
        planes = planes[:: -(-leap // along), :, ::along]
    return planes


class CountedBases(Bases):
    """Bases that are counted and not fitted.

    Attributes:
        fitted: axes along which the encoder would fit one.
    """

    def __init__(self, in_memory: bool) -> None:
        self.fitted: set[int] = set()
        self._in_memory = in_memory

    def possible(self, *lengths: int) -> bool:
        """Whether axes of these lengths can have a basis."""
        return self._in_memory and min(lengths) > 1 and max(lengths) <= MAX_BASIS_LENGTH

    def along(self, axis: int) -> AxisTransform:
        """Return what stands for a basis along an axis, other than the usual one, and count it."""
        self.fitted.add(axis)
        return AxisTransform(kind="haar", depth=1)


assert MAX_BASIS_LENGTH <= MAX_LENGTH
