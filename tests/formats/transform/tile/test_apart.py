"""Streams in two parts: joined again they are the same bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiles import SETTINGS, SHAPE, streams, wave

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.tile.apart import join_mask, split_mask
from fhash_formats.transform.tile.encoding import encode_tile
from fhash_formats.transform.tile.sections import parse_stream

MASKED = replace(SETTINGS, mask=MaskLevels(edges=(0.0,), scores=(0, 300)))


def masked_streams() -> dict[str, bytes]:
    values = wave()
    some, everywhere, nowhere = values > 0.5, np.ones(SHAPE, bool), np.zeros(SHAPE, bool)
    return {
        "some": encode_tile(values, MASKED, in_coreset=some).data,
        "everywhere": encode_tile(values, MASKED, in_coreset=everywhere).data,
        "nowhere": encode_tile(values, MASKED, in_coreset=nowhere).data,
    }


@pytest.mark.parametrize("kind", masked_streams())
def test_a_mask_comes_off_and_on_again(kind: str) -> None:
    stream = masked_streams()[kind]
    body, mask = split_mask(stream)
    assert join_mask(body, mask) == stream
    assert bool(mask) == (kind == "some")
    if kind == "some":
        assert parse_stream(stream).mask == mask
        with pytest.raises(DamagedFileError, match="sections"):
            parse_stream(body)


@pytest.mark.parametrize("kind", streams())
def test_streams_without_masks_stay_as_they_are(kind: str) -> None:
    stream = streams()[kind][1]
    assert split_mask(stream) == (stream, b"")
    assert join_mask(stream, b"") == stream
    with pytest.raises(DamagedFileError, match="a mask for a coded tile that has none"):
        join_mask(stream, b"abc")


def test_a_stream_of_no_bytes_stays_damaged() -> None:
    assert join_mask(b"", b"") == b""
    with pytest.raises(DamagedFileError, match="empty"):
        parse_stream(join_mask(b"", b""))
