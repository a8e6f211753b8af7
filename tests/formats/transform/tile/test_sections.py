"""The sections of a stream: their lengths, the flags, the checksum, and damage to them."""

from __future__ import annotations

import numpy as np
import pytest
from tiles import SHAPE, resealed, same, streams, wave

from fhash_formats.errors import DamagedFileError
from fhash_formats.native import crc32c
from fhash_formats.transform.tile import decoding
from fhash_formats.transform.tile.decoding import decode_tile
from fhash_formats.transform.tile.sections import (
    EMPTY,
    KIND,
    MISSING,
    OWN,
    RESIDUAL,
    pack_mask,
    pack_missing,
    pack_planes,
    parse_stream,
    restore_missing,
    seal,
    unpack_mask,
    unpack_planes,
    zero_levels,
)


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
