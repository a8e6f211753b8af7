"""Tiles of a series: together they are the box, whether it is in memory or read by layers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from untrained_heads import some_head

from fhash_codec.compact import tiles as module
from fhash_codec.compact.tiles import (
    MIN_STEP_SHARE,
    Blocks,
    Coding,
    Known,
    Outcome,
    Run,
    Tile,
    TileRun,
    code,
)
from fhash_codec.compact.transform import usual_transform
from fhash_codec.config import EncodeConfig
from fhash_codec.features.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries, StepsSeries
from fhash_formats.transform.encoding import OFFSETS
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


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("features", [("all",), ("interval:0:10",)])
def test_a_window_is_the_part_where_values_vary_most(
    monkeypatch: pytest.MonkeyPatch, in_memory: bool, features: tuple[str, ...]
) -> None:
    if not in_memory:
        monkeypatch.setattr("fhash_codec.compact.tiles.MAX_BYTES_IN_MEMORY", 1)
    monkeypatch.setattr(f"{__name__}.VALUES", VALUES.copy())
    VALUES[:, :, :, :4] *= 0.01
    blocks = blocks_of((5, 3, 7, 4), features)
    window = blocks.window((3, 6, 7, 4))
    assert window.shape == window.tile == (3, 6, 7, 4)
    assert window.in_memory
    part = window.read((0, 0, 0, 0))
    np.testing.assert_array_equal(part.values, VALUES[1:4, :, :, 4:])
    whole = blocks.retile(SHAPE).read((0, 0, 0, 0)).counted
    assert (part.counted is None) == (whole is None) == window.complete
    if part.counted is not None and whole is not None:
        np.testing.assert_array_equal(part.counted, whole[1:4, :, :, 4:])
    half = window.retile((3, 6, 7, 2))
    np.testing.assert_array_equal(half.read((0, 0, 0, 1)).values, VALUES[1:4, :, :, 6:])


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


SHAPE_CODING = (2, 8, 12, 16)
VALUES_CODING = np.random.default_rng(0).normal(size=SHAPE_CODING).cumsum(axis=3).astype(np.float32)
SETTINGS = TileSettings(
    transform=usual_transform(SHAPE_CODING),
    step=0.5,
    center=0.0,
    low=float(VALUES_CODING.min()),
    high=float(VALUES_CODING.max()),
    offsets=OFFSETS,
)


def test_the_outcome_is_that_of_the_decoded_values() -> None:
    counted = np.random.default_rng(1).random(SHAPE_CODING) < 0.7
    coded, outcome = code(Tile(VALUES_CODING, counted), SETTINGS, Coding())
    errors = (coded.decoded.astype(np.float64) - VALUES_CODING)[counted]
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


SETTINGS_KNOWN = TileSettings(
    transform=usual_transform((2, 4, 8, 8)), step=1.0, center=0.0, low=0.0, high=16.0
)
OUTCOME = Outcome(size=3, squares=1.0, count=10, max_error=0.5)


def run(settings: TileSettings, coding: Coding, stream: bytes = b"abc") -> Run:
    return Run(settings, coding, [TileRun(stream, OUTCOME)])


def test_a_head_changes_no_stream_but_under_a_bound() -> None:
    headed = replace(SETTINGS_KNOWN, head=some_head())
    for coding, same in ((Coding(), True), (Coding(error=0.5), False)):
        runs = Known()
        first = run(SETTINGS_KNOWN, coding)
        runs.keep(first)
        assert runs.run(headed, coding) is None
        assert (runs.same_streams(headed, coding) is first) == same
        assert runs.same_streams(SETTINGS_KNOWN, coding) is first


def test_the_oldest_runs_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_BYTES", 10)
    runs, steps = Known(), (1.0, 2.0, 3.0, 4.0)
    for step in steps:
        runs.keep(run(replace(SETTINGS_KNOWN, step=step), Coding(), b"abcd"))
    found = [runs.run(replace(SETTINGS_KNOWN, step=step), Coding()) is not None for step in steps]
    assert found == [False, False, True, True]
