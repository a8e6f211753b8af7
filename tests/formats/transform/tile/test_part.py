"""A part of a tile: the bits of the whole one, from a head over the part alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from heads import random_head
from specs import spec_of
from tiles import SETTINGS, wave

from fhash_formats.transform.tile.decoding import decode_tile
from fhash_formats.transform.tile.encoding import Coding, encode_tile
from fhash_formats.transform.tile.part import corrected_part, uncorrected

SHAPE = (4, 12, 13, 14)
PARTS = {
    "corner": ((0, 1), (0, 2), (0, 3), (0, 1)),
    "far corner": ((3, 4), (10, 12), (11, 13), (13, 14)),
    "inside": ((1, 3), (4, 6), (5, 7), (6, 7)),
    "edge": ((0, 4), (0, 1), (6, 7), (11, 14)),
}


def settings_of(cross: bool) -> object:
    hidden = (5, 4) if cross else (12, 8)
    spec = spec_of(("haar", "none", "9/7", "9/7"), (1, 0, 2, 2), SHAPE)
    head = random_head(hidden, cross=cross, spread=16.0)
    return replace(SETTINGS, transform=spec, quantum=0.0, head=head, clip=True)


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16"])
@pytest.mark.parametrize("cross", [False, True])
@pytest.mark.parametrize("name", list(PARTS))
def test_a_part_has_the_bits_of_the_whole(name: str, cross: bool, dtype: str) -> None:
    settings, values = settings_of(cross), wave(SHAPE, dtype)
    data = encode_tile(values, settings).data
    whole = decode_tile(data, SHAPE, dtype, settings)
    part = tuple(slice(*span) for span in PARTS[name])
    table = uncorrected(data, SHAPE, dtype, settings, part)
    assert table is not None
    before = table.copy()
    found = corrected_part(table, part, dtype, settings)
    assert found.dtype == whole.dtype
    assert found.tobytes() == whole[part].tobytes()
    everything = tuple(slice(0, n) for n in SHAPE)
    assert corrected_part(table, everything, dtype, settings).tobytes() == whole.tobytes()
    assert table.tobytes() == before.tobytes()
    assert (table[part] != whole[part]).any() or dtype == "int16"  # otherwise nothing is tested


def test_tiles_with_more_than_a_head_are_decoded_whole() -> None:
    settings, values = settings_of(cross=False), wave(SHAPE)
    part = tuple(slice(*span) for span in PARTS["corner"])
    holes = values.copy()
    holes[0, 1, 2, 3] = np.nan
    bounded = replace(settings, quantum=0.002)
    whole = {
        "no head": (
            replace(settings, head=None),
            encode_tile(values, replace(settings, head=None)),
        ),
        "own settings": (settings, encode_tile(values, settings, Coding(own_settings=True))),
        "missing": (settings, encode_tile(holes, settings)),
        "residual": (bounded, encode_tile(values, bounded, Coding(error=0.001))),
    }
    for name, (used, coded) in whole.items():
        assert uncorrected(coded.data, SHAPE, "float32", used, part) is None, name


def test_a_large_part_is_decoded_whole() -> None:
    settings = settings_of(cross=False)
    data = encode_tile(wave(SHAPE), settings).data
    frame = (slice(0, 1), *(slice(0, n) for n in SHAPE[1:]))
    assert uncorrected(data, SHAPE, "float32", settings, frame) is None
