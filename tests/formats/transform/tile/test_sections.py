"""The sections of a stream: their lengths, the flags, the digests, and damage to them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tiles import SETTINGS, SHAPE, same, streams, wave

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.tile import decoding
from fhash_formats.transform.tile.decoding import decode_tile
from fhash_formats.transform.tile.encoding import Coding, encode_tile
from fhash_formats.transform.tile.sections import (
    pack_mask,
    pack_missing,
    parse_stream,
    restore_missing,
    section,
    unpack_mask,
    zero_levels,
)
from fhash_formats.transform.tile.settings import TileSettings


@pytest.mark.parametrize("name", list(streams()))
def test_sections_that_the_flags_do_not_name_are_damage_before_anything_is_decoded(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    values, data = streams()[name]
    stream = parse_stream(data)
    start = data[:5] if stream.coded else data[:1]
    assert start + b"".join(map(section, stream.sections())) == data

    def decoded(*_: object) -> None:
        pytest.fail("decoded")

    for function in ("decode_integers", "decode_predicted", "unpack_exact"):
        monkeypatch.setattr(decoding, function, decoded)
    for sections in ([*stream.sections(), b""], stream.sections()[:-1]):
        with pytest.raises(DamagedFileError, match="sections; its flags say"):
            decode_tile(start + b"".join(map(section, sections)), values.shape, values.dtype)


@pytest.mark.parametrize(
    ("size", "length"),
    [(0, b"\0"), (127, b"\x7f"), (128, b"\x80\x01"), (20000, b"\xa0\x9c\x01")],
)
def test_a_length_takes_seven_bits_a_byte(size: int, length: bytes) -> None:
    assert section(bytes(size)) == length + bytes(size)


@pytest.mark.parametrize(
    "change",
    [
        {"step": 10**400},
        {"step": 1e300},
        {"step": "1"},
        {"range": 3},
        {"transform": []},
        {"center": None},
    ],
)
def test_hostile_settings_are_damage(
    change: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {**SETTINGS.to_dict(), **change}
    monkeypatch.setattr(TileSettings, "to_dict", lambda self: values)
    data = encode_tile(wave(), SETTINGS, Coding(own_settings=True)).data
    with pytest.raises(DamagedFileError, match="settings"):
        decode_tile(data, SHAPE, np.float32)


def test_missing_values_come_back_into_floating_values_only() -> None:
    values = wave()
    values[0, 1, 2, 3:6] = [np.nan, np.inf, -np.inf]
    missing = pack_missing(values, np.isfinite(values))
    finite = np.where(np.isfinite(values), values, np.float32(0))
    assert same(restore_missing(finite, missing), values)
    with pytest.raises(DamagedFileError, match="integers has missing values"):
        restore_missing(np.zeros(SHAPE, np.int16), missing)


def test_a_mask_comes_back_and_damage_to_it_is_found() -> None:
    mask, levels = wave() > 0, zero_levels(SHAPE)
    packed = pack_mask(mask, levels)
    assert np.array_equal(unpack_mask(packed, levels), mask)
    assert pack_mask(np.ones(SHAPE, bool), levels) == b""
    with pytest.raises(DamagedFileError, match="mask"):
        unpack_mask(bytes([packed[0] ^ 1]) + packed[1:], levels)
