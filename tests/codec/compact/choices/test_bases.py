"""The data's own bases: fitted on all lines, or on some that stand for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from fhash_codec.compact.choices.bases import MAX_BASIS_LENGTH, Bases, CountedBases, Gram
from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile.settings import TileSettings


class OneTile:
    """A sample of one tile whose lines along each axis are multiples of one line."""

    allows_bases = True

    def __init__(self) -> None:
        lines = [np.cos(np.arange(n) * 0.7) + 1.5 for n in (6, 9, 12, 20)]
        values = np.einsum("t,z,y,x->tzyx", *lines)
        self.lines, self.tiles = lines, [Tile(values.astype(np.float32), None)]
        self.grams: dict[tuple[int, float, int | None], Gram] = {}

    def map_all(self, work: Callable[[Tile], Any]) -> Iterator[Any]:
        yield from map(work, self.tiles)

    def run_all(self, trials: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        raise NotImplementedError


SETTINGS = TileSettings(
    transform=TransformSpec(axes=(AxisTransform(kind="none"),) * 4),
    step=0.1,
    center=0.0,
    low=0.0,
    high=40.0,
    offsets=(0,) * 6,
    double=False,
)


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize("lines", [None, 40])
def test_a_basis_holds_the_lines_of_its_axis(axis: int, lines: int | None) -> None:
    sample = OneTile()
    basis = Bases(sample, SETTINGS, lines).along(axis).basis
    assert basis is not None
    assert basis.rank == 1
    vector, line = basis.synthesis.reshape(-1), sample.lines[axis]
    overlap = abs(vector @ line) / np.linalg.norm(vector) / np.linalg.norm(line)
    assert overlap == pytest.approx(1.0, abs=1e-3)


def test_long_axes_and_single_vertices_have_none() -> None:
    bases = Bases(OneTile(), SETTINGS)
    assert bases.possible(2, MAX_BASIS_LENGTH)
    assert not bases.possible(1, 5)
    assert not bases.possible(5, MAX_BASIS_LENGTH + 1)
    assert not CountedBases(in_memory=False).possible(5)
    counted = CountedBases(in_memory=True)
    counted.along(2)
    assert counted.fitted == {2}
