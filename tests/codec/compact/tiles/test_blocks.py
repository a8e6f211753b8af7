"""Tiles of a series: together they are the box, whether it is in memory or read by layers."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.compact.tiles.blocks import Blocks, Tile
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries, StepsSeries

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
        monkeypatch.setattr("fhash_codec.compact.tiles.blocks.MAX_BYTES_IN_MEMORY", 1)
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


def test_vertices_outside_the_coreset_do_not_count() -> None:
    blocks = blocks_of(SHAPE, ("interval:0:10",))
    tile = blocks.read((0, 0, 0, 0))
    assert not blocks.complete
    np.testing.assert_array_equal(tile.counted, tile.values >= 0)
    other = blocks.retile((1, 6, 7, 8))
    np.testing.assert_array_equal(other.read((3, 0, 0, 0)).counted, tile.counted[3:4])


def test_a_tile_is_empty_where_no_vertex_counts() -> None:
    assert Tile(VALUES, np.zeros(SHAPE, bool)).is_empty
    assert not Tile(VALUES, None).is_empty


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("features", [("all",), ("interval:0:10",)])
def test_boxes_are_parts_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch, in_memory: bool, features: tuple[str, ...]
) -> None:
    if not in_memory:
        monkeypatch.setattr("fhash_codec.compact.tiles.blocks.MAX_BYTES_IN_MEMORY", 1)
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
        monkeypatch.setattr("fhash_codec.compact.tiles.blocks.MAX_BYTES_IN_MEMORY", 1)
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


def test_by_layers_only_the_layer_that_is_asked_for_is_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    blocks = blocks_of((2, 4, 7, 5))
    read: list[int] = []
    usual = StepsSeries.read
    monkeypatch.setattr(
        StepsSeries, "read", lambda self, step: read.append(step) or usual(self, step)
    )
    layers = blocks.by_layers()
    assert not layers.in_memory
    for index in [(1, 0, 0, 0), (1, 1, 0, 1)]:
        tile = layers.read(index)
        assert read == [2, 3]
        assert blocks.in_memory
        first = VALUES[2:4, 4 * index[1], 0, 5 * index[3]]
        np.testing.assert_array_equal(tile.values[:, 0, 0, 0], first)


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
