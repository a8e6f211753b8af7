"""Integers of coefficients: plain and on the trellis, of any size, and what a decoder gets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tiles import SETTINGS, SHAPE, same, wave

from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.tile.decoding import decode_tile
from fhash_formats.transform.tile.encoding import Coding, encode_tile
from fhash_formats.transform.tile.integers import choose_integers, code_coefficients
from fhash_formats.transform.tile.settings import TileSettings
from fhash_formats.transform.values.quantise import LARGEST

TRELLIS = replace(SETTINGS, trellis=True, offsets=(17, -10, -5, -3, -2, -1))
CODINGS = [
    Coding(),
    Coding(weight=0.27, passes=2),
    Coding(weight=0.27, error=0.04, rounds=2),
]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("coding", CODINGS, ids=["least error", "weight", "bound"])
@pytest.mark.parametrize("double", [False, True])
def test_the_encoder_knows_what_is_decoded_from_the_trellis(
    dtype: Any, coding: Coding, double: bool
) -> None:
    values, settings = wave(dtype=dtype), replace(TRELLIS, double=double)
    coded = encode_tile(values, settings, coding)
    assert same(decode_tile(coded.data, SHAPE, dtype, settings), coded.decoded)
    difference = np.abs(coded.decoded.astype(float) - values.astype(float)).max()
    assert difference <= (0.4 if coding.error is None else coding.error)


def test_a_mask_and_missing_values_go_with_the_trellis() -> None:
    values, settings = wave(), replace(TRELLIS, mask=MaskLevels(), quantum=0.0)
    in_coreset = values > 0.2
    coding = Coding(weight=0.27, rounds=2)
    coded = encode_tile(values, settings, coding, in_coreset=in_coreset)
    decoded = decode_tile(coded.data, SHAPE, np.float32, settings)
    assert np.array_equal(np.isfinite(decoded), in_coreset)
    values[0, 1, 2, 3:6] = [np.nan, np.inf, -np.inf]
    whole = decode_tile(encode_tile(values, TRELLIS, coding).data, SHAPE, np.float32, TRELLIS)
    assert same(whole[~np.isfinite(values)], values[~np.isfinite(values)])


def test_a_level_of_detail_is_the_same_function_of_the_integers() -> None:
    values = wave((2, 4, 16, 16))
    data = encode_tile(values, replace(TRELLIS, quantum=0.0), Coding(weight=0.27)).data
    half = decode_tile(data, values.shape, np.float32, replace(TRELLIS, quantum=0.0), lod=1)
    assert half.shape == (2, 2, 8, 8)
    assert np.abs(half - values[:, ::2, ::2, ::2]).max() < 1.0


@pytest.mark.parametrize("settings", [SETTINGS, TRELLIS], ids=["plain", "trellis"])
def test_integers_that_are_too_large_are_refused(settings: TileSettings) -> None:
    settings = replace(settings, double=True)
    coefficients = np.zeros(SHAPE)
    coefficients[0, 0, 0, 0] = settings.step * LARGEST * 1.1
    assert code_coefficients(coefficients, settings, 0.1, 1) is None


def test_large_integers_of_the_trellis_are_near() -> None:
    settings = replace(TRELLIS, double=True, step=1.0)
    coefficients = np.random.default_rng(3).uniform(-9e8, 9e8, SHAPE)
    integers = choose_integers(coefficients, settings, 0.27)
    assert integers is not None
    assert np.abs(integers - coefficients).max() <= 2
