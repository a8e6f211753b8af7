"""Tiles of labels: lossless in every type, with a mask, and no damage goes unnoticed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiles import SETTINGS, damaged_copies, same

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.tile.decoding import decode_tile, decode_tile_mask
from fhash_formats.transform.tile.encoding import Coding, encode_tile
from fhash_formats.transform.tile.labelled import build_labelled_stream, has_regions
from fhash_formats.transform.tile.sections import MANY

SHAPE = (2, 4, 9, 20)
LABELLED = replace(SETTINGS, labels=True, quantum=0.0)


def regions(dtype: str) -> np.ndarray:
    """Five values in blocks; floats have both zeros and NaN among them."""
    kind = np.dtype(dtype)
    values = [3, 100, 7, 0, 50] if kind.kind != "f" else [np.nan, -0.0, 0.0, 1.5, -7.0]
    number = (
        np.arange(20) // 5 + np.arange(9)[:, None] // 3 + np.arange(2)[:, None, None, None]
    ) % 5
    return np.broadcast_to(np.array(values, kind)[number], SHAPE).copy()


@pytest.mark.parametrize("dtype", ["i1", "u2", "i4", "u8", "f2", "f4", "f8"])
@pytest.mark.parametrize("own", [False, True])
def test_every_type_comes_back_bit_by_bit(dtype: str, own: bool) -> None:
    values = regions(dtype)
    coding = Coding(error=0.0, own_settings=own, keep_missing=False)
    coded = encode_tile(values, LABELLED, coding)
    assert coded.data[0] >> 5 == 5
    assert coded.decoded.tobytes() == values.tobytes()
    decoded = decode_tile(coded.data, SHAPE, values.dtype, None if own else LABELLED)
    assert decoded.tobytes() == values.tobytes()
    coarse = decode_tile(coded.data, SHAPE, values.dtype, LABELLED, lod=1)
    assert same(coarse, values[:, ::2, ::2, ::2])


@pytest.mark.parametrize("dtype", ["i1", "f4"])
def test_a_mask_is_one_more_label(dtype: str) -> None:
    values, occupied = regions(dtype), np.ones(SHAPE, bool)
    occupied[:, 1, 2:6, 4:11] = False
    if dtype == "f4":
        values[np.isnan(values)] = 9.0
    settings = replace(LABELLED, mask=MaskLevels())
    coded = encode_tile(values, settings, Coding(error=0.0), in_coreset=occupied)
    assert coded.data[0] >> 5 == 6
    decoded, mask = decode_tile_mask(coded.data, SHAPE, values.dtype, settings)
    np.testing.assert_array_equal(mask, occupied)
    assert same(decoded, coded.decoded)
    np.testing.assert_array_equal(decoded[occupied], values[occupied])


@pytest.mark.parametrize(("count", "there"), [(256, True), (257, False)])
def test_at_most_256_values(count: int, there: bool) -> None:
    values = (np.arange(600).reshape(1, 1, 20, 30) % count).astype("i4")
    data = build_labelled_stream(values, None, None)
    assert (data is not None) is there
    if data is not None:
        assert same(decode_tile(data, values.shape, "i4"), values)
    masked = build_labelled_stream(values, None, np.ones(values.shape, bool))
    assert masked is None


def test_smooth_values_are_not_coded_as_labels() -> None:
    x = np.arange(200.0)
    values = np.rint(100 + 90 * np.sin(x / 30) * np.cos(x[:40, None] / 25)).astype("i2")[None, None]
    settings = replace(LABELLED, low=10.0, high=190.0, center=100.0, quantum=0.99, step=1.0)
    coded = encode_tile(values, settings, Coding(error=0.5))
    assert coded.data[0] >> 5 == 1
    np.testing.assert_array_equal(coded.decoded, values)


def test_damage_is_an_error_or_changes_nothing() -> None:
    values = np.ascontiguousarray(regions("i2")[:1, :2])
    data = build_labelled_stream(values, None, None)
    assert data is not None
    for damaged in damaged_copies(data):
        try:
            decoded = decode_tile(damaged, values.shape, "i2", SETTINGS)
        except DamagedFileError:
            continue
        assert same(decoded, values)


@pytest.mark.parametrize("dtype", ["u2", "i4", "u8", "f4", "f8"])
def test_many_labels_come_back_bit_by_bit(dtype: str) -> None:
    numbers = np.random.default_rng(0).permutation(3000)[:300].reshape(1, 1, 15, 20)
    values = numbers.repeat(4, 2).repeat(5, 3).astype(dtype)
    if dtype[0] == "f":
        values[0, 0, 0, :4] = [np.nan, -0.0, np.inf, -np.inf]
    settings = replace(LABELLED, many_labels=True)
    coded = encode_tile(values, settings, Coding(error=0.0, keep_missing=False))
    assert coded.data[0] == 5 << 5 | MANY
    assert decode_tile(coded.data, values.shape, dtype, settings).tobytes() == values.tobytes()


@pytest.mark.parametrize("count", [256, 257])
def test_many_labels_are_those_above_256(count: int) -> None:
    values = (np.arange(600).reshape(1, 1, 20, 30) % count).astype("i4")
    data = build_labelled_stream(values, None, None, many=True)
    assert data is not None
    assert bool(data[0] & MANY) is (count > 256)
    # The label of unoccupied vertices counts.
    occupied = np.ones(values.shape, bool)
    occupied[0, 0, 19] = False
    masked = build_labelled_stream(values, None, occupied, many=True)
    assert masked is not None
    assert masked[0] & MANY
    settings = replace(LABELLED, mask=MaskLevels(), many_labels=True)
    decoded, mask = decode_tile_mask(masked, values.shape, "i4", settings)
    np.testing.assert_array_equal(mask, occupied)
    np.testing.assert_array_equal(decoded[mask], values[mask])


@pytest.mark.parametrize(("count", "there"), [(65536, True), (65537, False)])
def test_at_most_65536_many_labels(count: int, there: bool) -> None:
    values = (np.arange(65600).reshape(1, 1, 200, 328) % count * 3).astype("i4")
    assert (build_labelled_stream(values, None, None, many=True) is not None) is there


def test_a_palette_of_consecutive_values_takes_few_bytes() -> None:
    values = np.arange(40, 440, dtype="i4").reshape(1, 1, 20, 20).repeat(4, 2).repeat(4, 3)
    data = build_labelled_stream(values, None, None, many=True)
    assert data is not None
    assert int.from_bytes(data[7:11], "little") < 40


def test_damage_of_many_labels_is_an_error_or_changes_nothing() -> None:
    values = (np.arange(280).reshape(1, 1, 14, 20) * 5).astype("i2")
    data = build_labelled_stream(values, None, None, many=True)
    assert data is not None
    few = bytes([data[0] & ~MANY]) + data[1:]
    for damaged in [few, *list(damaged_copies(data))[::7]]:
        try:
            decoded = decode_tile(damaged, values.shape, "i2", SETTINGS)
        except DamagedFileError:
            continue
        assert same(decoded, values)


@pytest.mark.parametrize(("equal", "regions"), [(49, False), (50, True)])
def test_regions_are_half_of_the_vertices_with_an_equal_neighbour(equal, regions) -> None:
    row = np.arange(100)
    row[1 : 2 * equal : 2] = row[: 2 * equal : 2]
    assert has_regions(row.reshape(1, 1, 1, 100)) is regions
