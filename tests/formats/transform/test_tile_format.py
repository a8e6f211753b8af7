"""Tiles of labels: lossless in every type, with a mask, and no damage goes unnoticed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from specs import spec_of
from tiles import (
    SETTINGS,
    SHAPE,
    damaged_copies,
    predictor_of,
    random_head,
    resealed,
    same,
    streams,
    wave,
)

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.native import crc32c
from fhash_formats.transform import decoding
from fhash_formats.transform.coder import MaskLevels
from fhash_formats.transform.decoding import decode_tile, decode_tile_mask
from fhash_formats.transform.encoding import Coding, encode_tile
from fhash_formats.transform.tile_format import (
    EMPTY,
    KIND,
    LABELS,
    MASKED,
    MISSING,
    OWN,
    RESIDUAL,
    TRANSFORMED,
    TileSettings,
    has_regions,
    labelled_stream,
    pack_mask,
    pack_missing,
    pack_planes,
    parse_stream,
    read_varint,
    restore_missing,
    seal,
    unpack_labelled,
    unpack_mask,
    unpack_planes,
    varint,
    zero_levels,
)

REGIONS_SHAPE = (2, 4, 9, 20)
LABELLED = replace(SETTINGS, labels=True, quantum=0.0)


def regions(dtype: str) -> np.ndarray:
    """Five values in blocks; floats have both zeros and NaN among them."""
    kind = np.dtype(dtype)
    values = [3, 100, 7, 0, 50] if kind.kind != "f" else [np.nan, -0.0, 0.0, 1.5, -7.0]
    number = (
        np.arange(20) // 5 + np.arange(9)[:, None] // 3 + np.arange(2)[:, None, None, None]
    ) % 5
    return np.broadcast_to(np.array(values, kind)[number], REGIONS_SHAPE).copy()


@pytest.mark.parametrize("dtype", ["i1", "u2", "i4", "u8", "f2", "f4", "f8"])
@pytest.mark.parametrize("own", [False, True])
def test_every_type_comes_back_bit_by_bit(dtype: str, own: bool) -> None:
    values = regions(dtype)
    coding = Coding(error=0.0, own_settings=own, keep_missing=False)
    coded = encode_tile(values, LABELLED, coding)
    assert coded.data[4] & KIND == LABELS
    assert coded.decoded.tobytes() == values.tobytes()
    decoded = decode_tile(coded.data, REGIONS_SHAPE, values.dtype, None if own else LABELLED)
    assert decoded.tobytes() == values.tobytes()
    coarse = decode_tile(coded.data, REGIONS_SHAPE, values.dtype, LABELLED, lod=1)
    assert same(coarse, values[:, ::2, ::2, ::2])


@pytest.mark.parametrize("dtype", ["i1", "f4"])
def test_a_mask_is_one_more_label(dtype: str) -> None:
    values, occupied = regions(dtype), np.ones(REGIONS_SHAPE, bool)
    occupied[:, 1, 2:6, 4:11] = False
    if dtype == "f4":
        values[np.isnan(values)] = 9.0
    settings = replace(LABELLED, mask=MaskLevels())
    coded = encode_tile(values, settings, Coding(error=0.0), in_coreset=occupied)
    assert coded.data[4] == LABELS | MASKED
    decoded, mask = decode_tile_mask(coded.data, REGIONS_SHAPE, values.dtype, settings)
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


@pytest.mark.parametrize("name", list(streams()))
def test_flags_that_say_something_else_are_damage_before_anything_is_decoded(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checksum is right, as whoever changes a file on purpose makes it."""
    values, data = streams()[name]
    flags, stream = data[4], parse_stream(data)
    sections = (stream.settings, stream.missing, stream.body, stream.residual, stream.mask)
    assert seal(flags, [bytes(one) for one in sections if one is not None]) == data
    assert data[:4] == crc32c(data[4:]).to_bytes(4, "little")

    def decoded(*_: object) -> None:
        pytest.fail("decoded")

    for function in ("decode_integers", "decode_predicted", "unpack_planes"):
        monkeypatch.setattr(decoding, function, decoded)
    for change in (5, 6, 7, 128):
        other = bytes([flags & ~KIND | change if change < 8 else flags | change])
        with pytest.raises(DamagedFileError, match="flags"):
            decode_tile(resealed(data[:4] + other + data[5:]), values.shape, values.dtype)
    cut = resealed(data[:5] + b"\xff" + data[6:])
    if flags & OWN:
        with pytest.raises(DamagedFileError, match=r"cut short|settings"):
            decode_tile(cut, values.shape, values.dtype)


@pytest.mark.parametrize("flags", [EMPTY | RESIDUAL, 2 | MISSING, 3 | RESIDUAL, 1 | RESIDUAL])
def test_flags_that_contradict_each_other_are_damage(flags: int) -> None:
    with pytest.raises(DamagedFileError, match="which no encoder writes"):
        parse_stream(seal(flags, [b"a", b"b"]))


def test_an_empty_stream_ends_after_its_flags() -> None:
    assert len(seal(EMPTY, [])) == 5
    with pytest.raises(DamagedFileError, match="bytes after its end"):
        parse_stream(resealed(seal(EMPTY, []) + b"a"))


@pytest.mark.parametrize(
    ("size", "length"),
    [(0, b"\0"), (127, b"\x7f"), (128, b"\x80\x01"), (20000, b"\xa0\x9c\x01")],
)
def test_a_length_takes_seven_bits_a_byte(size: int, length: bytes) -> None:
    data = seal(RESIDUAL, [bytes(size), b"end"])
    assert data[5:] == length + bytes(size) + b"end"
    stream = parse_stream(data)
    assert (stream.body, stream.residual) == (bytes(size), b"end")


def test_planes_have_the_lowest_bytes_first_and_exactly_their_number() -> None:
    values = np.array([1, 0x0203, 0xFFFF], np.uint16)
    packed = pack_planes(values)
    assert same(unpack_planes(packed, 3, values.dtype), values)
    for damaged in (packed[:-1], packed + b"a", pack_planes(values[:2]), b"", b"abc"):
        with pytest.raises(DamagedFileError):
            unpack_planes(damaged, 3, values.dtype)
    with pytest.raises(DamagedFileError, match="another number"):
        unpack_planes(pack_planes(np.zeros(1 << 20, np.uint16)), 0, values.dtype)


def test_missing_values_come_back_into_floating_values_only() -> None:
    values = wave()
    values[0, 1, 2, 3:6] = [np.nan, np.inf, -np.inf]
    missing = pack_missing(values, np.isfinite(values))
    finite = np.where(np.isfinite(values), values, np.float32(0))
    assert same(restore_missing(finite, missing), values)
    with pytest.raises(DamagedFileError, match="integers has missing values"):
        restore_missing(np.zeros(SHAPE, np.int16), missing)


def test_a_mask_comes_back() -> None:
    mask, levels = wave() > 0, zero_levels(SHAPE)
    assert np.array_equal(unpack_mask(pack_mask(mask, levels), levels), mask)
    assert pack_mask(np.ones(SHAPE, bool), levels) == b""


CHANGES: list[dict[str, Any]] = [
    {},
    {"double": True, "offsets": (-5, -1, 0, 0, 0, 0)},
    {"mask": MaskLevels(), "quantum": 0.0},
    {"mask": MaskLevels(edges=(-1.5, 3.0), scores=(1, 0, 4095), others=(7, 8, 9), reach=64)},
    {"clip": True, "labels": True},
    {"trellis": True, "offsets": (-5, -1, 0, 0, 1, -127)},
    {"head": random_head((3, 4), cross=True)},
    {"predictor": predictor_of((1, 2, 2, 2), (0, 3, 1, 2), 1, step=0.25)},
    {"transform": spec_of(("klt", "none", "5/3", "klt"), (0, 0, 3, 0), SHAPE, 0.1)},
    {"origin": -(1 << 63), "low": -(1 << 62), "high": (1 << 62) + 1},
    {"origin": (1 << 64) - 1, "low": 0.0, "high": 5.0},
    {"low": -(1 << 63), "high": (1 << 63) - 1},
]


@pytest.mark.parametrize("changes", CHANGES)
def test_settings_come_back_from_bytes_and_text(changes: dict[str, Any]) -> None:
    settings = replace(SETTINGS, **changes)
    data = settings.to_bytes()
    again = TileSettings.from_bytes(data)
    assert again.to_bytes() == data
    assert TileSettings.from_text(settings.to_text()) is again
    if "head" not in changes:
        assert again == settings
    assert type(again.low) is (int if settings.origin or abs(settings.low) > 1 << 53 else float)


@pytest.mark.parametrize("changes", CHANGES)
def test_cut_and_longer_bytes_are_damage(changes: dict[str, Any]) -> None:
    data = replace(SETTINGS, **changes).to_bytes()
    for other in [*(data[:n] for n in range(0, len(data), 1 + len(data) // 97)), data + b"\0"]:
        with pytest.raises(DamagedFileError):
            TileSettings.from_bytes(other)


@pytest.mark.parametrize("changes", CHANGES)
def test_changed_bytes_are_damage_or_other_settings(changes: dict[str, Any]) -> None:
    data = replace(SETTINGS, **changes).to_bytes()
    random = np.random.default_rng(0)
    for at in [*range(60), *random.integers(0, len(data), 100).tolist()]:
        other = bytearray(data)
        other[at % len(data)] = int(random.integers(256))
        try:
            TileSettings.from_bytes(bytes(other))
        except DamagedFileError:
            continue


def test_ends_about_an_origin_are_whole() -> None:
    for ends in ({"low": 0.5, "high": 2.0}, {"low": 0, "high": 1 << 63}):
        with pytest.raises(InputError, match="about an origin"):
            replace(SETTINGS, origin=7, **ends).to_bytes()


@pytest.mark.parametrize("text", [None, 3, "%", "QUJD", "\u00e9"])
def test_text_that_holds_no_settings_is_damage(text: Any) -> None:
    with pytest.raises(DamagedFileError, match="settings"):
        TileSettings.from_text(text)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"step": 0.0}, "do not fit together"),
        ({"step": 1e-300}, "not for float32"),
        ({"low": 4.0}, "do not fit together"),
        ({"quantum": -1.0}, "do not fit together"),
        ({"center": float("nan")}, "center is nan"),
        ({"step": True}, "step is True"),
        ({"offsets": (0, 0, 0)}, "six whole numbers"),
        ({"offsets": (0, 0, 0, 0, 0, 128)}, "six whole numbers"),
        ({"origin": 1.0}, "origin is 1.0; a 64-bit integer"),
        ({"origin": 1 << 64}, "a 64-bit integer is needed"),
        ({"high": 10**400}, "high is 1000"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(SETTINGS, **changes)
