"""The data's own bases: fitted on all lines, or on some that stand for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Blocks, Coding, Index, Outcome, Tile
from fhash_codec.compact.transform import (
    Bases,
    Gram,
    choose_transform,
    estimated_step,
    gram_of,
    likely_transform,
    refit,
    usual_transform,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.features.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries
from fhash_formats.transform.encoding import OFFSETS
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import TileSettings


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


@pytest.mark.parametrize("tile", [(6, 10, 20, 20), (6, 20, 40, 40)], ids=str)
def test_the_estimated_step_reaches_the_psnr(tile: tuple[int, int, int, int]) -> None:
    rng = np.random.default_rng(0)
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (6, 20, 40, 40)), indexing="ij")
    source = np.tanh(
        9 * (x + 0.4 * np.sin(5 * y + 2 * t) - 0.5 - 0.2 * z)
    ) + 0.02 * rng.standard_normal(t.shape)
    source = source.astype(np.float32)
    series = ArraySeries(source)
    selection = select_features(series, EncodeConfig(), silent)
    blocks = Blocks(series, selection.extent, tile)
    low, high = float(source.min()), float(source.max())
    settings = TileSettings(
        transform=usual_transform(tile), step=1.0, center=0.0, low=low, high=high, offsets=OFFSETS
    )
    coding = Coding(filled=True)
    with ThreadPoolExecutor(2) as workers:
        sample = Sample(blocks, source.size, workers)
        for psnr in (40.0, 55.0):
            step = estimated_step(
                blocks, settings, coding, psnr=psnr, data_range=high - low, workers=workers
            )
            reached = sample.run(TileSettings(**{**vars(settings), "step": step}), coding).psnr(
                high - low
            )
            assert reached == pytest.approx(psnr, abs=0.6)


def planes(shape: tuple[int, int, int], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    values = np.random.default_rng(sum(shape)).normal(3.0, 40.0, shape).astype(dtype)
    if values.dtype.kind == "f":
        values.flat[:: max(1, values.size // 5)] = [np.nan, np.inf, -np.inf, 1.0, 0.0, 2.0][
            : len(values.flat[:: max(1, values.size // 5)])
        ]
    return values


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16])
@pytest.mark.parametrize("shape", [(1, 1, 6), (200, 20, 1), (3, 37, 70), (2, 128, 65), (70, 9, 3)])
def test_lines_are_added_one_after_the_other(
    shape: tuple[int, int, int], dtype: npt.DTypeLike
) -> None:
    values = planes(shape, dtype)
    gram = gram_of(values, 0.3)
    lines = values.astype(np.float64).transpose(1, 0, 2).reshape(shape[1], -1) - 0.3
    lines[~np.isfinite(lines)] = 0.0
    added = np.zeros_like(gram)
    for plane in np.split(lines, shape[0], axis=1):
        for line in plane.T:
            added += line[:, None] * line
    np.testing.assert_array_equal(gram, added)
    # Sums of n products in another order differ by n roundings of the largest sum at most.
    bound = lines.shape[1] * np.finfo(np.float64).eps * np.max(np.sum(lines * lines, axis=1))
    np.testing.assert_allclose(gram, lines @ lines.T, rtol=0, atol=bound)


class Hats:
    """One tile, linear between every second vertex of y and x: all details of 5/3 are 0."""

    shape = tile = (1, 1, 65, 65)
    in_memory = False

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, 0, 0)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        values = np.zeros((65, 65))
        values[::2, ::2] = np.random.default_rng(0).normal(size=(33, 33))
        values[1::2, ::2] = (values[:-1:2, ::2] + values[2::2, ::2]) / 2
        values[:, 1::2] = (values[:, :-1:2] + values[:, 2::2]) / 2
        return Tile(values.astype(np.float32).reshape(self.tile), None)


def test_hats_are_transformed_by_5_3() -> None:
    settings = TileSettings(
        transform=usual_transform(Hats.tile), step=1e-3, center=0.0, low=-5.0, high=5.0
    )
    with ThreadPoolExecutor(1) as workers:
        sample = Sample(Hats(), 1 << 20, workers)
        chosen, _ = choose_transform(sample, settings, Coding())
    assert [axis.kind for axis in chosen.transform.axes] == ["none", "none", "5/3", "5/3"]
    # Without bases of the data's own there is nothing to fit.
    assert refit(sample, chosen) is chosen


class FewShapes:
    """One tile in which each line along x is a sum of two patterns that no wavelet has."""

    shape = tile = (1, 8, 24, 40)
    in_memory = True

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, 0, 0)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        rng = np.random.default_rng(1)
        values = rng.normal(size=(8 * 24, 2)) @ rng.normal(size=(2, 40))
        return Tile(values.astype(np.float32).reshape(self.tile), None)


def test_few_patterns_get_a_basis_of_their_own() -> None:
    settings = TileSettings(
        transform=usual_transform(FewShapes.tile), step=0.01, center=0.0, low=-9.0, high=9.0
    )
    with ThreadPoolExecutor(1) as workers:
        sample = Sample(FewShapes(), 1 << 20, workers)
        chosen, cost = choose_transform(sample, settings, Coding())
        assert chosen.transform.axes[3].kind == "klt"
        usual = sample.run(settings, Coding())
        assert cost < usual.size
        assert refit(sample, chosen) is not chosen


def test_a_likely_transform_is_found_by_four_trials() -> None:
    hats = Hats()
    with ThreadPoolExecutor(1) as pool:
        sample = Sample(hats, 1 << 20, pool)  # type: ignore[arg-type]
        settings = TileSettings(
            transform=usual_transform(hats.shape), step=0.1, center=0.0, low=-4.0, high=4.0
        )
        # A series that is not in memory has no bases, and keeps the usual transform.
        assert likely_transform(sample, settings, Coding()) == settings
