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
from fhash_formats.transform.tile.labelled import has_regions, labelled_stream, unpack_labelled
from fhash_formats.transform.tile.sections import (
    KIND,
    LABELS,
    MASKED,
    TRANSFORMED,
    pack_planes,
    parse_stream,
)
from fhash_formats.transform.tile.settings import read_varint, varint

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
    assert coded.data[4] & KIND == LABELS
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
    assert coded.data[4] == LABELS | MASKED
    decoded, mask = decode_tile_mask(coded.data, SHAPE, values.dtype, settings)
    np.testing.assert_array_equal(mask, occupied)
    assert same(decoded, coded.decoded)
    np.testing.assert_array_equal(decoded[occupied], values[occupied])


@pytest.mark.parametrize(("count", "there"), [(256, True), (257, False)])
def test_the_most_labels_are_kept_and_unoccupied_vertices_take_one(count: int, there: bool) -> None:
    values = (np.arange(600).reshape(1, 1, 20, 30) % count).astype("i4")
    data = labelled_stream(values, None, None, 256)
    assert (data is not None) is there
    if data is not None:
        assert same(decode_tile(data, values.shape, "i4"), values)
    assert labelled_stream(values, None, np.ones(values.shape, bool), 256) is None
    occupied = np.ones(values.shape, bool)
    occupied[0, 0, 19] = False
    masked = labelled_stream(values, None, occupied)
    assert masked is not None
    decoded, mask = decode_tile_mask(
        masked, values.shape, "i4", replace(LABELLED, mask=MaskLevels())
    )
    np.testing.assert_array_equal(mask, occupied)
    np.testing.assert_array_equal(decoded[mask], values[mask])


def test_smooth_values_are_not_coded_as_labels() -> None:
    x = np.arange(200.0)
    values = np.rint(100 + 90 * np.sin(x / 30) * np.cos(x[:40, None] / 25)).astype("i2")[None, None]
    settings = replace(LABELLED, low=10.0, high=190.0, center=100.0, quantum=0.99, step=1.0)
    coded = encode_tile(values, settings, Coding(error=0.5))
    assert coded.data[4] & KIND == TRANSFORMED
    np.testing.assert_array_equal(coded.decoded, values)


def test_damage_is_an_error() -> None:
    values = np.ascontiguousarray(regions("i2")[:1, :2])
    data = labelled_stream(values, None, None)
    assert data is not None
    for damaged in damaged_copies(data):
        with pytest.raises(DamagedFileError):
            decode_tile(damaged, values.shape, "i2", SETTINGS)


@pytest.mark.parametrize("dtype", ["u2", "i4", "u8", "f4", "f8"])
def test_many_labels_come_back_bit_by_bit(dtype: str) -> None:
    numbers = np.random.default_rng(0).permutation(3000)[:300].reshape(1, 1, 15, 20)
    values = numbers.repeat(4, 2).repeat(5, 3).astype(dtype)
    if dtype[0] == "f":
        values[0, 0, 0, :4] = [np.nan, -0.0, np.inf, -np.inf]
    coded = encode_tile(values, LABELLED, Coding(error=0.0, keep_missing=False))
    assert coded.data[4] == LABELS
    assert decode_tile(coded.data, values.shape, dtype, LABELLED).tobytes() == values.tobytes()


@pytest.mark.parametrize(("count", "there"), [(65536, True), (65537, False)])
def test_at_most_65536_many_labels(count: int, there: bool) -> None:
    values = (np.arange(65600).reshape(1, 1, 200, 328) % count * 3).astype("i4")
    assert (labelled_stream(values, None, None) is not None) is there


def test_a_palette_of_consecutive_values_takes_few_bytes() -> None:
    values = np.arange(40, 440, dtype="i4").reshape(1, 1, 20, 20).repeat(4, 2).repeat(4, 3)
    data = labelled_stream(values, None, None)
    assert data is not None
    size, rest = read_varint(parse_stream(data).body)
    assert size == 400
    assert read_varint(rest)[0] < 40


@pytest.mark.parametrize(
    ("size", "length", "steps"),
    [(65537, 1, [1]), (0, 1, []), (2, 1 << 30, [1, 1]), (2, None, [1, 0]), (2, None, [1, 65535])],
)
def test_hostile_palettes_are_damage(size: int, length: int | None, steps: list[int]) -> None:
    packed = pack_planes(np.array(steps, np.uint16))
    body = varint(size) + varint(len(packed) if length is None else length) + packed
    with pytest.raises(DamagedFileError):
        unpack_labelled(memoryview(body), (1, 1, 2, 3), np.dtype("u2"), masked=False)


@pytest.mark.parametrize(("equal", "regions"), [(49, False), (50, True)])
def test_regions_are_half_of_the_vertices_with_an_equal_neighbour(equal, regions) -> None:
    row = np.arange(100)
    row[1 : 2 * equal : 2] = row[: 2 * equal : 2]
    assert has_regions(row.reshape(1, 1, 1, 100)) is regions
