"""Tiles: their values and masks, their coding, samples of them, and the price of their shapes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from math import prod
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
from reference import value_between
from untrained_heads import some_head

import fhash_codec
from fhash_codec import (
    DamagedFileError,
    EncodeConfig,
    InputError,
    RegionError,
)
from fhash_codec.boxes import Box
from fhash_codec.compact import sample as sample_module
from fhash_codec.compact import tiles as module
from fhash_codec.compact.attempt import (
    FAST_ENOUGH,
    MAX_WHOLE_VERTICES,
    PRICES,
    even_tile,
    parse_tile,
    region_vertices,
    tiles_to_try,
)
from fhash_codec.compact.model import CompactModel, PlainArray
from fhash_codec.compact.sample import Sample, fill, strata
from fhash_codec.compact.tiles import (
    MIN_STEP_SHARE,
    Blocks,
    Coding,
    Index,
    Known,
    Outcome,
    Run,
    Tile,
    TileRun,
    code,
    coding_of,
    on_trellis,
)
from fhash_codec.compact.transform import magnitudes_of, scale_of, usual_transform
from fhash_codec.config import ACCESS
from fhash_codec.features.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.container import Container
from fhash_formats.series import ArraySeries, StepsSeries
from fhash_formats.transform.tile import OFFSETS, decode_tile
from fhash_formats.transform.tile_format import TileSettings

SHAPE = (5, 6, 7, 8)
VALUES = np.random.default_rng(0).normal(size=SHAPE).astype(np.float32)


def blocks_of(tile: tuple[int, int, int, int], features: tuple[str, ...] = ("all",)) -> Blocks:
    series = StepsSeries(ArraySeries(VALUES), range(len(VALUES)))  # read by frames, as a file is
    config = EncodeConfig(features=features, dilation=0)
    return Blocks(series, select_features(series, config, silent).extent, tile)


@pytest.mark.parametrize("in_memory", [True, False])
def test_tiles_make_up_the_box_and_repeat_its_border(
    monkeypatch: pytest.MonkeyPatch, in_memory: bool
) -> None:
    if not in_memory:
        monkeypatch.setattr("fhash_codec.compact.tiles.MAX_BYTES_IN_MEMORY", 1)
    blocks = blocks_of((2, 4, 7, 5))
    assert blocks.in_memory == in_memory
    assert blocks.complete
    padded = np.pad(VALUES, [(0, 1), (0, 2), (0, 0), (0, 2)], mode="edge")
    inside = np.pad(np.ones(SHAPE, bool), [(0, 1), (0, 2), (0, 0), (0, 2)])
    for index in blocks.indices():
        span = tuple(slice(i * n, (i + 1) * n) for i, n in zip(index, blocks.tile, strict=True))
        tile = blocks.read(index)
        np.testing.assert_array_equal(tile.values, padded[span])
        if inside[span].all():
            assert tile.counted is None
        else:
            np.testing.assert_array_equal(tile.counted, inside[span])
        assert tile.counted_vertices == np.count_nonzero(inside[span])


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("features", [("all",), ("interval:0:10",)])
def test_boxes_are_parts_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch, in_memory: bool, features: tuple[str, ...]
) -> None:
    if not in_memory:
        monkeypatch.setattr("fhash_codec.compact.tiles.MAX_BYTES_IN_MEMORY", 1)
    blocks = blocks_of((5, 3, 7, 4), features)
    places = [(0, 0, 0, 4), (2, 3, 1, 0), (9, 9, 9, 9)]  # the last one ends at the border
    boxes = blocks.boxes((3, 2, 4, 4), places, [2, 1, 5])
    assert boxes.in_memory
    assert (boxes.shape, boxes.tile, boxes.grid) == ((3, 2, 4, 4), (3, 2, 4, 4), (3, 1, 1, 1))
    whole = blocks.retile(SHAPE).read((0, 0, 0, 0))
    lows = [*places[:2], tuple(m - n for m, n in zip(SHAPE, (3, 2, 4, 4), strict=True))]
    halves = boxes.retile((2, 2, 4, 2))  # two layers of each box: the second one is half full
    assert halves.grid == (6, 1, 1, 2)
    for number, low in enumerate(lows):
        region = tuple(slice(at, at + n) for at, n in zip(low, (3, 2, 4, 4), strict=True))
        part = boxes.read((number, 0, 0, 0))
        np.testing.assert_array_equal(part.values, whole.values[region])
        if part.counted is not None and whole.counted is not None:
            np.testing.assert_array_equal(part.counted, whole.counted[region])
        last = halves.read((2 * number + 1, 0, 0, 1))
        np.testing.assert_array_equal(last.values[:1], whole.values[region][2:, :, :, 2:])
        assert last.counted is not None
        assert not last.counted[1:].any()
        assert halves.weight((2 * number + 1, 0, 0, 1)) == [2, 1, 5][number]


@pytest.mark.parametrize("features", [("all",), ("interval:0:1",)])
def test_an_array_in_memory_is_neither_copied_nor_written(features: tuple[str, ...]) -> None:
    array = VALUES.copy()
    series = ArraySeries(array)
    config = EncodeConfig(features=features, dilation=0)
    blocks = Blocks(series, select_features(series, config, silent).extent, SHAPE)
    tile, expected = blocks.read((0, 0, 0, 0)), blocks_of(SHAPE, features).read((0, 0, 0, 0))
    np.testing.assert_array_equal(tile.values, expected.values)
    np.testing.assert_array_equal(
        np.ones(1) if tile.counted is None else tile.counted,
        np.ones(1) if expected.counted is None else expected.counted,
    )
    if features == ("all",):
        assert np.shares_memory(tile.values, array)
        with pytest.raises(ValueError, match="read-only"):
            tile.values[0, 0, 0, 0] = 0
    assert array.flags.writeable


NOISE_SHAPE = (2, 8, 12, 16)
NOISE = np.random.default_rng(0).normal(size=NOISE_SHAPE).cumsum(axis=3).astype(np.float32)
SETTINGS = TileSettings(
    transform=usual_transform(NOISE_SHAPE),
    step=0.5,
    center=0.0,
    low=float(NOISE.min()),
    high=float(NOISE.max()),
    offsets=OFFSETS,
)


def test_the_outcome_is_that_of_the_decoded_values() -> None:
    counted = np.random.default_rng(1).random(NOISE_SHAPE) < 0.7
    coded, outcome = code(Tile(NOISE, counted), SETTINGS, Coding())
    errors = (coded.decoded.astype(np.float64) - NOISE)[counted]
    assert outcome.size == len(coded.data)
    assert outcome.count == errors.size
    assert outcome.squares == pytest.approx((errors**2).sum())
    assert outcome.max_error == pytest.approx(np.abs(errors).max())
    expected = 10 * math.log10(9.0 / (errors**2).mean())
    assert outcome.psnr(3.0) == pytest.approx(expected)


def lattice_values(kind: str) -> np.ndarray:
    """Values of one kind, float64 (3, 12, 12, 12)."""
    rng = np.random.default_rng(0)
    t, z, y, x = np.mgrid[0:3, 0:12, 0:12, 0:12].astype(np.float64)
    smooth = np.sin(t / 4 + z / 5) * np.cos(y / 6) + x / 20
    return {
        "smooth": smooth,
        "far from zero": smooth + 300,
        "noise": rng.random(x.shape),
        "spikes": np.where(rng.random(x.shape) < 0.001, 1e3, smooth),
        "jump": (x > 7) + 0.01 * smooth,
        "plateau": np.where(t + z + y + x == 0, 0, 1) + 1e-3 * rng.random(x.shape),
    }[kind]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", ["smooth", "far from zero", "noise", "spikes", "jump", "plateau"])
def test_finer_steps_give_a_higher_psnr_to_the_finest(kind: str, dtype: type[np.floating]) -> None:
    """The error is that of a uniform quantiser or less, within 1 dB, down to MIN_STEP_SHARE.

    Beyond it coefficients do not fit the coder's integers, and tiles are exact.
    """
    values = lattice_values(kind).astype(dtype)
    low, high = float(values.min()), float(values.max())
    settings = replace(
        SETTINGS,
        transform=usual_transform(values.shape),
        center=float(np.float32((low + high) / 2)),
        low=low,
        high=high,
        double=True,
    )
    finest = -round(math.log2(MIN_STEP_SHARE))
    before = 0.0
    for exponent in [16, finest - 2, finest - 1, finest, finest + 6]:
        step = (high - low) * 2.0**-exponent
        stepped = replace(settings, step=step)
        psnr = code(Tile(values, None), stepped, Coding())[1].psnr(high - low)
        assert psnr >= 20 * math.log10(2.0**exponent * math.sqrt(12)) - 1
        assert psnr > before or math.isinf(psnr)
        before = psnr
    assert math.isinf(before)


KNOWN_SETTINGS = TileSettings(
    transform=usual_transform((2, 4, 8, 8)), step=1.0, center=0.0, low=0.0, high=16.0
)
OUTCOME = Outcome(size=3, squares=1.0, count=10, max_error=0.5)


def run(settings: TileSettings, coding: Coding, stream: bytes = b"abc") -> Run:
    return Run(settings, coding, [TileRun(stream, OUTCOME)])


def test_a_head_changes_no_stream_but_under_a_bound() -> None:
    headed = replace(KNOWN_SETTINGS, head=some_head())
    for coding, same in ((Coding(), True), (Coding(error=0.5), False)):
        runs = Known()
        first = run(KNOWN_SETTINGS, coding)
        runs.keep(first)
        assert runs.run(headed, coding) is None
        assert (runs.same_streams(headed, coding) is first) == same
        assert runs.same_streams(KNOWN_SETTINGS, coding) is first


def test_the_oldest_runs_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_BYTES", 10)
    runs, steps = Known(), (1.0, 2.0, 3.0, 4.0)
    for step in steps:
        runs.keep(run(replace(KNOWN_SETTINGS, step=step), Coding(), b"abcd"))
    found = [runs.run(replace(KNOWN_SETTINGS, step=step), Coding()) is not None for step in steps]
    assert found == [False, False, True, True]


WAVE_SHAPE = (4, 12, 20, 24)
WAVE_SETTINGS = TileSettings(
    transform=usual_transform(WAVE_SHAPE),
    step=0.05,
    center=0.5,
    low=0.0,
    high=1.0,
    offsets=OFFSETS,
)
IN_CORESET = np.indices(WAVE_SHAPE)[1] <= 6


def wave() -> npt.NDArray[Any]:
    """Return a wave that is noisy where z > 6, values from 0 to 1."""
    t, z, y, x = np.indices(WAVE_SHAPE)
    noise = np.random.default_rng(3).normal(size=WAVE_SHAPE)
    return (0.5 + 0.3 * np.sin(0.3 * x + 0.2 * t) * np.cos(0.2 * y) + 0.15 * noise * (z > 6)).clip(
        0, 1
    )


@pytest.mark.parametrize("density", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8])
def test_vertices_that_count_stay_and_all_others_have_a_value(dtype: Any, density: int) -> None:
    values = (wave() * (200 if dtype == np.uint8 else 1)).astype(dtype)
    settings = WAVE_SETTINGS
    if dtype == np.uint8:
        settings = replace(WAVE_SETTINGS, high=200.0, center=100.0, step=10.0)
    else:
        values[:, 9, 3:6] = np.nan
        values[:, 2, 2, 2] = np.inf
    filled, counted = fill(Tile(values, IN_CORESET), settings, density)
    assert filled.dtype == values.dtype
    assert np.isfinite(filled).all()
    np.testing.assert_array_equal(counted, IN_CORESET & np.isfinite(values))
    np.testing.assert_array_equal(filled[counted], values[counted])


@pytest.mark.parametrize("counted", [None, np.ones(WAVE_SHAPE, bool), np.zeros(WAVE_SHAPE, bool)])
def test_a_tile_of_which_all_or_nothing_counts_stays(counted: npt.NDArray[np.bool_] | None) -> None:
    tile = Tile(wave(), counted)
    assert fill(tile, WAVE_SETTINGS, 2) is tile


class Row:
    """A row of tiles; all values of a tile are its number."""

    complete, in_memory, tile = True, True, (1, 1, 10, 100)

    def __init__(self, tiles: int) -> None:
        self.tiles = tiles
        self.shape = (1, 1, 10 * tiles, 100)

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, number, 0) for number in range(self.tiles)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        return Tile(np.full(self.tile, index[2], np.float32), None)


ROW_SETTINGS = TileSettings(
    transform=usual_transform(Row.tile), step=1.0, center=0.0, low=0.0, high=16.0
)


def test_an_expensive_tile_stands_for_itself_and_a_cheap_one_for_many() -> None:
    """The sample must have the one tile in which everything happens, and count it once."""
    costs = [1.0] * 16
    costs[11] = 400.0
    with ThreadPoolExecutor(1) as workers:
        sample = Sample(Row(16), 4_000, workers, costs)
        numbers = [int(tile.values[0, 0, 0, 0]) for tile in sample.tiles]
        assert dict(zip(numbers, sample.weights, strict=True))[11] == 1
        assert sum(sample.weights) == 16
        assert sample.counted == 16_000
        assert sample.run(ROW_SETTINGS, Coding()).count == 16_000


@pytest.mark.parametrize("max_tiles", [1, 3, 7, 40])
def test_strata_cover_all_tiles(max_tiles: int) -> None:
    costs = np.random.default_rng(max_tiles).gamma(0.3, 100.0, 40).tolist()
    chosen = strata(costs, max_tiles)
    assert len(chosen) <= max_tiles
    assert sum(weight for _, weight in chosen) == 40
    assert [tile for tile, _ in chosen] == sorted({tile for tile, _ in chosen})
    estimate = sum(costs[tile] * weight for tile, weight in chosen)
    assert max_tiles < 7 or abs(estimate / sum(costs) - 1) < 0.25
    assert [weight for _, weight in strata([0.0] * 40, 4)] == [10] * 4


@pytest.mark.parametrize("in_memory", [True, False])
def test_all_tiles_of_the_series_come_in_order(in_memory: bool) -> None:
    row = Row(40)
    row.in_memory = in_memory
    with ThreadPoolExecutor(3) as workers:
        sample = Sample(row, 4_000, workers)
        firsts = list(sample.map_all(lambda tile: int(tile.values.flat[0])))
    assert firsts == list(range(40))


def test_what_was_coded_before_is_not_coded_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Streams are taken as they are, and a head that joins is measured on them."""
    coded: list[TileSettings] = []
    original = sample_module.code

    def counted(tile: Tile, settings: TileSettings, coding: Coding) -> Any:
        coded.append(settings)
        return original(tile, settings, coding)

    monkeypatch.setattr(sample_module, "code", counted)
    settings = replace(ROW_SETTINGS, high=4.0)
    headed = replace(settings, head=some_head())
    with ThreadPoolExecutor(1) as workers:
        sample, fresh = (Sample(Row(4), 4_000, workers) for _ in range(2))
        first = sample.run(settings, Coding())
        assert len(coded) == 4
        assert sample.run(replace(settings), Coding()) == first
        values = sample.decoded(settings, Coding())
        with_head = sample.run(headed, Coding())
        assert len(coded) == 4
        assert set(sample.coded(settings, Coding())) == set(sample.indices)
        assert sample.coded(replace(settings, step=2.0), Coding()) == {}
        assert fresh.run(headed, Coding()) == with_head
        for known, new in zip(values, fresh.decoded(settings, Coding()), strict=True):
            np.testing.assert_array_equal(known, new)


Shape = tuple[int, int, int, int]
SHAPES = [(12, 25, 125, 125), (600, 12, 14, 16), (2, 128, 160, 160), (40, 3, 160, 200)]
LONG = [(64, 128, 256, 256), (1, 512, 512, 512), (500, 3, 100, 400)]


@pytest.mark.parametrize("shape", [*SHAPES, *LONG, (1, 1, 1, 1), (3, 5, 7, 1)])
def test_tiles_are_tried_from_the_fastest_region_to_the_whole(shape: Shape) -> None:
    tiles = tiles_to_try(shape, MAX_WHOLE_VERTICES)
    works = [region_vertices(shape, tile) for tile in tiles]
    assert works == sorted(works)
    assert len(set(tiles)) == len(tiles)
    assert sum(work <= FAST_ENOUGH for work in works) <= 1
    assert (shape in tiles) == (prod(shape) <= MAX_WHOLE_VERTICES)
    assert all(1 <= n <= length for tile in tiles for n, length in zip(tile, shape, strict=True))
    few = [tile for tile in tiles if prod(tile) > 1 << 14]
    for tile in few:  # and few of their vertices lie beyond the border
        covered = prod(-(-length // n) * n for n, length in zip(tile, shape, strict=True))
        assert covered <= 1.7 * prod(shape)


def test_every_wish_has_a_price() -> None:
    assert set(PRICES) == set(ACCESS.values())
    assert list(PRICES.values()) == sorted(PRICES.values(), reverse=True)


@pytest.mark.parametrize("shape", [(10, 64, 64, 64), (12, 25, 125, 125), (33, 64, 64, 64)])
def test_few_vertices_of_tiles_lie_beyond_the_border(shape: Shape) -> None:
    tile = even_tile(shape, 27, -(-shape[0] // 3))
    covered = np.prod([-(-n // length) * length for n, length in zip(shape, tile, strict=True)])
    assert covered <= 1.04 * np.prod(shape)


@pytest.mark.parametrize("text", ["whole", "200x1000x1000x1"])
def test_a_tile_that_no_reader_would_take_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"at most 134,217,728 are decoded together"):
        parse_tile(text, (200, 1000, 1000, 2))
    assert parse_tile("1x1000x1000x9", (200, 1000, 1000, 2)) == (1, 1000, 1000, 2)


Series = npt.NDArray[Any]
Field = Callable[..., Series]
Feature = tuple[Series, Path]
"""A series, and a container of it with vertices outside the coreset."""


def record_decoded_tiles(
    monkeypatch: pytest.MonkeyPatch, table: Any
) -> list[tuple[int, int, int, int]]:
    """Return a list that takes up the index of each tile of a table that is decoded."""
    decode, indices = type(table).decode_chunk, []

    def recorded(array: Any, index: Any, lod: int = 0) -> Any:
        if array.name == table.name:
            indices.append(index)
        return decode(array, index, lod)

    monkeypatch.setattr(type(table), "decode_chunk", recorded)
    return indices


def test_a_region_of_a_feature_reads_its_tiles_alone(feature: Feature) -> None:
    """Mask and values come from the same bytes: those of the tiles that the region touches."""
    with fhash_codec.open(feature[1]) as volume:
        table = volume.container.arrays["table_1"]
        before = volume.container.bytes_read
        (z, _), (y, _), (x, _) = volume.box
        region = ((z, z + 3), (y, y + 4), (x, x + 7))
        values = volume.read(2, region)
        read = volume.container.bytes_read - before
        assert read < table.nbytes_stored / 4
        np.testing.assert_array_equal(
            volume.occupancy(2)[tuple(slice(*span) for span in region)], np.isfinite(values)
        )


@pytest.mark.parametrize(
    "index",
    [np.s_[3], np.s_[1:4, 2:7, 3:11, 5:17], np.s_[:, 8, ::-2, 19], np.s_[4, 3:5, 4:6, 7:9]],
    ids=str,
)
def test_a_region_is_that_slice_of_the_series_bit_for_bit(feature: Feature, index: Any) -> None:
    with fhash_codec.open(feature[1]) as volume:
        series = volume[...]
    with fhash_codec.open(feature[1]) as volume:
        np.testing.assert_array_equal(volume[index], series[index])


def test_samples_at_vertices_are_what_is_read(feature: Feature) -> None:
    z, y, x = np.meshgrid(range(9), range(12), range(20), indexing="ij")
    with fhash_codec.open(feature[1]) as volume:
        for t in (0, 1, 4):
            np.testing.assert_array_equal(volume.sample(t=t, z=z, y=y, x=x), volume.read(t))
        np.testing.assert_allclose(
            volume.sample(t=2.25, z=z, y=y, x=x), volume.read(2.25), rtol=1e-6, atol=1e-5
        )
        rule, values = volume.info["model"]["between"]["rule"], volume[...].reshape(5, -1).T
        between = [value_between(alone, range(5), 2.25, rule) for alone in values.tolist()]
        np.testing.assert_allclose(volume.read(2.25).ravel(), between, rtol=1e-6, atol=1e-5)


def test_gradients_are_differences_of_the_vertices(feature: Feature) -> None:
    random = np.random.default_rng(0)
    with fhash_codec.open(feature[1]) as volume:
        cells = [random.integers(0, n - 1, 300) for n in volume.shape]
        for axis, name in enumerate("tzyx"):
            at = {other: cell + 0.0 for other, cell in zip("tzyx", cells, strict=True)}
            ends = [
                volume.sample(**{**at, name: cells[axis] + side}).astype(np.float64)
                for side in (0.0, 1.0)
            ]
            # Two places of Gauss: their mean is exact for the derivative of a cubic.
            gradient = np.mean(
                [
                    volume.sample(**{**at, name: cells[axis] + 0.5 + side}, gradient=True)[1]
                    for side in (-(3**0.5) / 6, 3**0.5 / 6)
                ],
                axis=0,
            )
            # Between steps a vertex counts that counts at either of them. What it decodes to at
            # the other step is open.
            finite = np.isfinite(gradient[:, axis]) & np.isfinite(ends[0]) & np.isfinite(ends[1])
            assert finite.sum() > 30
            np.testing.assert_allclose(
                gradient[finite, axis], (ends[1] - ends[0])[finite], rtol=1e-5, atol=1e-4
            )


def test_levels_of_detail_are_subsampled_and_near(
    tmp_path: Path, field: Field, feature: Feature
) -> None:
    source = field((3, 16, 24, 32))
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=2, tile="3x8x8x16"))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        np.testing.assert_array_equal(volume.read_lod(1, 0), volume.read(1))
        for lod in (1, 2):
            coarse = volume.read_lod(1, lod)
            every = source[1, :: 1 << lod, :: 1 << lod, :: 1 << lod]
            assert coarse.shape == every.shape
            assert np.sqrt(((coarse - every) ** 2).mean()) < 0.1 * np.ptp(source)
        assert volume.read_lod(0, 10).shape == (1, 1, 1)
        for lod in (-1, 11, 1.5):
            with pytest.raises(InputError, match="allowed: 0 to 10"):
                volume.read_lod(0, lod)
        with pytest.raises(InputError, match="between two"):
            volume.read_lod(0.5, 1)
        with pytest.raises(RegionError):
            volume.read_lod(3, 1)
    with fhash_codec.open(feature[1]) as volume:
        every = tuple(slice(low, high, 2) for low, high in volume.box)
        np.testing.assert_array_equal(
            np.isfinite(volume.read_lod(2, 1)), volume.occupancy(2)[every]
        )


@pytest.mark.parametrize("lod", [0, 1, 2, 3])
@pytest.mark.parametrize(
    "region",
    [
        ((0, 9), (0, 12), (0, 20)),
        ((2, 9), (3, 9), (7, 19)),
        ((8, 9), (8, 10), (15, 17)),
        ((0, 1), (0, 1), (0, 1)),
    ],
)
def test_a_region_of_a_level_of_detail_is_that_part_of_the_level(
    feature: Feature, lod: int, region: tuple[tuple[int, int], ...]
) -> None:
    with fhash_codec.open(feature[1]) as volume:
        level = np.full(volume.shape[1:], -1.0, np.float32)
        level[tuple(slice(low, high, 1 << lod) for low, high in volume.box)] = volume.read_lod(
            3, lod
        )
        vertices = [
            [n for n in range(low, high) if first <= n < end and (n - first) % (1 << lod) == 0]
            for (low, high), (first, end) in zip(region, volume.box, strict=True)
        ]
        if not all(vertices):
            with pytest.raises(RegionError, match=f"holds no vertex of level of detail {lod}"):
                volume.read_lod(3, lod, region)
            return
        assert [list(axis) for axis in volume.lod_vertices(lod, region)] == vertices
        np.testing.assert_array_equal(volume.read_lod(3, lod, region), level[np.ix_(*vertices)])


def test_a_region_of_a_level_of_detail_decodes_the_tiles_that_it_touches(
    feature: Feature, monkeypatch: pytest.MonkeyPatch
) -> None:
    with fhash_codec.open(feature[1]) as volume:
        table = volume.container.arrays["table_1"]
        indices = record_decoded_tiles(monkeypatch, table)
        (z, _), (y, _), (x, _) = volume.box
        volume.read_lod(2, 1, ((z + 4, z + 7), (y, y + 5), (x + 8, x + 9)))
        assert set(indices) == {(1, 1, 0, 1)}
        with pytest.raises(RegionError, match="region 3:3 of axis y is empty"):
            volume.read_lod(2, 1, ((0, 1), (3, 3), (0, 1)))
        with pytest.raises(RegionError, match="outside 0:9"):
            volume.lod_vertices(1, ((0, 10), (0, 1), (0, 1)))


HEADER = {"required_features": ["transform"], "model": {"profile": "compact"}}
"""The part of a header, of a file that is not plain, that a model needs."""


class Table:
    """A stored array of two steps, one tile each, that holds an infinity and a NaN."""

    shape, chunk_shape = (2, 2, 3, 4), (1, 2, 3, 4)
    dtype = np.dtype(np.float32)
    masked = False

    def __init__(self) -> None:
        self.values = np.arange(48, dtype=np.float32).reshape(self.shape)
        self.values[1, 1, 2, 3], self.values[1, 0, 0, 0] = -np.inf, np.nan

    def read(self, region: tuple[slice, ...]) -> Series:
        return self.values[region].copy()

    def prefetch(self, spans: object) -> None:
        """All is here."""

    def decode_chunk(self, index: tuple[int, ...], lod: int) -> Series:
        every = slice(None, None, 1 << lod)
        return self.values[index[0] : index[0] + 1, every, every, every].copy()


WHOLE = Box.of([(0, 2), (0, 3), (0, 4)])


def model_of(arrays: dict[str, Table]) -> CompactModel:
    """Return the model of a container that holds these arrays alone."""
    return CompactModel(cast(Container, SimpleNamespace(arrays=arrays, header=HEADER)))


def reads(model: CompactModel) -> list[Callable[[], Any]]:
    """The ways to read the second step of a table, with its last vertex among those read."""
    end = [np.array([0.9]), np.array([1.9]), np.array([2.9])]
    return [
        lambda: model.read(1, WHOLE, np.ones((2, 3, 4), bool)),
        lambda: model.read(0.5, WHOLE, np.ones((2, 3, 4), bool)),
        lambda: model.read_lod(1, 0, WHOLE),
        lambda: model.sample(np.array([1.0]), end),
        lambda: model.sample_with_gradient(np.array([1.0]), end)[1],
    ]


@pytest.mark.parametrize("way", range(5))
def test_infinities_in_a_table_are_damage(way: int) -> None:
    model = model_of({"table_1": Table()})
    with pytest.raises(DamagedFileError, match="the table holds infinities"):
        reads(model)[way]()
    assert np.isnan(model.read(1, Box.of_shape((1, 3, 4)), np.ones((1, 3, 4), bool))).sum() == 1


def test_coarse_levels_of_labels_have_every_vertex_of_the_coreset(tmp_path: Path) -> None:
    """Tiles of odd lengths begin between the coarse vertices; their labels lie beside these."""
    t, z, y, x = np.indices((4, 9, 10, 11))
    values = np.rint(5 * np.sin(x / 2 + t) * np.cos(y / 2) + z / 3).astype(np.float32)
    config = EncodeConfig(effort=1, tile="2x3x4x5", features=("isosurface:2.5",), dilation=0)
    fhash_codec.encode(values, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.container.arrays["table_1"].settings.labels
        box = volume.box.slices()
        for step, lod in product(range(4), (1, 2)):
            coarse = volume.read_lod(step, lod)
            every = (slice(None, None, 1 << lod),) * 3
            occupied = volume.occupancy(step)[box][every]
            assert 0 < occupied.sum() < occupied.size
            np.testing.assert_array_equal(np.isfinite(coarse), occupied)


def test_parts_of_tables_are_parts_of_the_whole_and_integers_are_not_rounded(
    tmp_path: Path,
) -> None:
    t, _, y, x = np.meshgrid(*(np.arange(n) for n in (3, 5, 13, 17)), indexing="ij")
    values = (40 + 30 * np.sin(x / 3 + t) * np.cos(y / 4)).astype(np.int16)
    fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(effort=2, tile="2x5x6x8", psnr=45))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.dtype == np.int16
        for table in volume.tables:
            whole = np.asarray(table)
            assert whole.dtype == np.float32
            part = (slice(1, 3), slice(0, 1), slice(1, None), slice(0, 2))
            np.testing.assert_array_equal(table[part], whole[part])
        lattice = volume.tables[0][..., 0]
        assert not np.array_equal(lattice, np.rint(lattice))
        np.testing.assert_array_equal(np.rint(lattice), volume[...])


def plain_array(corrections: object, dtype: str, *, tile: int = 2) -> PlainArray:
    """A plain array of the values 0 to 3 along x, without a head."""
    table = np.arange(4, dtype=np.float32).reshape(1, 1, 1, 4, 1)
    added = np.asarray(corrections, np.float64).reshape(1, 1, 1, 4)
    arrays = {
        "table_1": SimpleNamespace(shape=table.shape, read=lambda region: table[region]),
        "corrections": SimpleNamespace(read=lambda region: added[region]),
    }
    model = {"tile": [1, 1, 1, tile], "values": dtype, "levels": [[1, 1, 1, 4]]}
    return PlainArray(model, None, arrays)  # type: ignore[arg-type]


ALL = (*[slice(0, 1)] * 3, slice(0, 4))


@pytest.mark.parametrize("dtype", ["int16", "float64"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_corrections_that_are_not_finite_are_damage(dtype: str, wrong: float) -> None:
    with pytest.raises(DamagedFileError, match="corrections has numbers beyond"):
        plain_array([0, wrong, 0, 0], dtype).read(ALL)


@pytest.mark.parametrize("share", [0.95, 1.0, 1.05])
def test_a_tile_errs_as_is_aimed_at(share: float) -> None:
    """The weight of a bit on the trellis changes a little for it, and no setting does."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (4, 16, 24, 32)), indexing="ij")
    noise = np.random.default_rng(3).normal(size=t.shape)
    values = (np.sin(9 * x + 4 * t) * np.cos(7 * y * z) + 0.05 * noise).astype(np.float32)
    settings = TileSettings(
        transform=usual_transform((4, 16, 24, 32)),
        step=0.1,
        center=0.0,
        low=float(values.min()),
        high=float(values.max()),
        offsets=OFFSETS,
        double=False,
    )
    settings, coding = on_trellis(settings, coding_of(5))
    tile = Tile(values, None)
    _, usual = code(tile, settings, coding)
    foretold = magnitudes_of(values, settings).error(settings.step * scale_of(settings))
    foretold /= scale_of(settings) ** 2
    aim = share * usual.squares / foretold
    coded, outcome = code(tile, settings, replace(coding, aim=aim))
    assert outcome.squares == pytest.approx(share * usual.squares, rel=5e-3)
    decoded = decode_tile(coded.data, (4, 16, 24, 32), np.float32, settings)
    assert np.array_equal(decoded, coded.decoded)
    assert outcome.squares == pytest.approx(
        float(((decoded.astype(float) - values) ** 2).sum()), rel=1e-6
    )
