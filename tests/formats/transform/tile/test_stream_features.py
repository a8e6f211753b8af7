"""Features that a stream needs, whose settings are its own or those of all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tiles import SETTINGS, wave

from fhash_formats.transform.chunk import encode_chunk
from fhash_formats.transform.tile.encoding import Coding, encode_tile, labelled_tile
from fhash_formats.transform.tile.stream_features import stream_features


def test_shared_settings_count_where_a_stream_has_none() -> None:
    clipping = replace(SETTINGS, clip=True)
    stream = encode_tile(wave(), clipping).data
    assert stream_features(stream, clipping) == {"clip"}
    assert stream_features(stream, SETTINGS) == frozenset()


def test_own_settings_count_in_place_of_shared_ones() -> None:
    stream = encode_tile(wave(), SETTINGS, Coding(own_settings=True)).data
    assert stream_features(stream, replace(SETTINGS, clip=True)) == frozenset()
    assert stream_features(encode_chunk(wave(), max_error=0.01), None) == {"clip"}


def test_labels_are_told_from_the_stream_itself() -> None:
    few = np.random.default_rng(0).integers(0, 4, (4, 16, 16)).astype(np.float32)
    many = np.random.default_rng(0).permutation(600).reshape(1, 1, 20, 30).repeat(2, 2).repeat(2, 3)
    assert stream_features(encode_chunk(few, max_error=0), None) == {"labels"}
    labelled = labelled_tile(many, many=True)
    assert labelled is not None
    assert stream_features(labelled.data, None) == {"labels", "many-labels"}
