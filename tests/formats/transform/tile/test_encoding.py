"""The encoder of tiles: bounds, missing values, values outside the coreset, lossless tiles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from specs import spec_of
from tiles import SETTINGS, SHAPE, same, wave

from fhash_formats.transform.tile.decoding import decode_tile
from fhash_formats.transform.tile.encoding import Coding, encode_tile, exact_tile
from fhash_formats.transform.tile.integers import MAX_CHOSEN
from fhash_formats.transform.values.quantise import LARGEST


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize(
    "coding",
    [
        Coding(),
        Coding(weight=0.09),
        Coding(error=0.04),
        Coding(weight=0.09, error=0.04, passes=2, rounds=1),
    ],
    ids=["plain", "weight", "error", "all"],
)
@pytest.mark.parametrize("own_settings", [False, True])
def test_the_encoder_knows_what_is_decoded(dtype: Any, coding: Coding, own_settings: bool) -> None:
    values = wave(dtype=dtype)
    coded = encode_tile(values, SETTINGS, replace(coding, own_settings=own_settings))
    settings = None if own_settings else SETTINGS
    assert same(decode_tile(coded.data, SHAPE, dtype, settings), coded.decoded)
    difference = np.abs(coded.decoded.astype(float) - values.astype(float)).max()
    assert difference <= (0.4 if coding.error is None else coding.error)


def test_values_that_are_not_finite_come_back_as_they_were() -> None:
    values = wave()
    values[0, 1, 2, 3:6] = [np.nan, np.inf, -np.inf]
    values[1, 0] = np.nan
    data = encode_tile(values, SETTINGS, Coding(error=0.04)).data
    decoded = decode_tile(data, SHAPE, np.float32, SETTINGS)
    finite = np.isfinite(values)
    assert same(decoded[~finite], values[~finite])
    assert np.abs(decoded[finite] - values[finite]).max() <= 0.04


def test_values_outside_the_coreset_cost_little_and_leave_the_bound() -> None:
    values, in_coreset = wave((1, 4, 16, 16)), np.zeros((1, 4, 16, 16), bool)
    in_coreset[:, :, :, :8] = True
    noise = np.random.default_rng(0).normal(0, 50, values.shape).astype(np.float32)
    noisy = np.where(in_coreset, values, noise)
    coded = encode_tile(noisy, SETTINGS, Coding(error=0.04), in_coreset=in_coreset)
    assert np.abs(coded.decoded - noisy)[in_coreset].max() <= 0.04
    assert 2 * len(coded.data) < len(encode_tile(noisy, SETTINGS, Coding(error=0.04)).data)


def test_a_tile_of_missing_values_only() -> None:
    values = np.full(SHAPE, np.nan, np.float32)
    values[0, 0, 0, 0] = -np.inf
    data = encode_tile(values, SETTINGS).data
    assert same(decode_tile(data, SHAPE, np.float32, SETTINGS), values)
    dropped = encode_tile(values, SETTINGS, Coding(keep_missing=False))
    assert len(dropped.data) == 5
    assert (decode_tile(dropped.data, SHAPE, np.float32, SETTINGS) == np.float32(0.5)).all()


def test_rounds_make_the_ends_of_the_range_cheaper() -> None:
    """A value at an end of the range may decode to any value beyond it: the decoder clips."""
    values = np.clip(3 * wave((2, 4, 16, 16)), -1.0, 1.5)
    settings = replace(SETTINGS, low=-1.0, high=1.5)
    plain, projected = (
        encode_tile(values, settings, Coding(weight=0.09, rounds=rounds)) for rounds in (0, 3)
    )
    assert len(projected.data) < len(plain.data)
    assert np.abs(projected.decoded - values).max() <= 0.4


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i1", "u2", "i4", "u8"])
def test_an_exact_tile_is_exact_and_writeable(dtype: str) -> None:
    values = (wave() * 40 + 100).astype(dtype)
    values.flat[0] = 0
    decoded = decode_tile(exact_tile(values).data, SHAPE, dtype)
    assert same(decoded, values)
    decoded[:] = 0


def test_a_bound_too_fine_for_the_quantum_is_kept_by_an_exact_tile() -> None:
    values = wave(dtype=np.float64)
    coded = encode_tile(values, replace(SETTINGS, quantum=1e-12), Coding(error=1e-17))
    assert same(coded.decoded, values)


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i2", "u1"])
def test_neither_residual_nor_rounding_leaves_the_range(dtype: str) -> None:
    values = np.maximum(wave(dtype="f8"), 0.1)
    values = (values * (1 if dtype[0] == "f" else 20)).astype(dtype)
    low, high = float(values.min()), float(values.max())
    error = (high - low) * 0.2
    quantum = 1.99 * (error - (0 if dtype[0] == "f" else 0.5))
    beyond = replace(SETTINGS, low=low, high=high, step=5 * error, quantum=quantum)
    settings = replace(beyond, clip=True)
    coding = Coding(weight=0.09, error=error)
    free, kept = encode_tile(values, beyond, coding), encode_tile(values, settings, coding)
    assert free.data == kept.data
    assert free.decoded.min() < low or free.decoded.max() > high
    assert low <= kept.decoded.min() <= kept.decoded.max() <= high
    errors = [np.abs(coded.decoded.astype(float) - values) for coded in (free, kept)]
    assert (errors[1] <= errors[0]).all()
    for wanted, coded in ((beyond, free), (settings, kept)):
        assert same(decode_tile(coded.data, SHAPE, dtype, wanted), coded.decoded)
    coarse = decode_tile(kept.data, SHAPE, dtype, settings, lod=1)
    assert low <= coarse.min() <= coarse.max() <= high


def test_ends_that_float32_rounds_outwards_are_kept_in_float64() -> None:
    values = np.where(wave(dtype="f8") > 0.3, 0.7, 0.1)
    assert float(np.float32(0.7)) < 0.7
    assert float(np.float32(0.1)) > 0.1
    values = -values
    settings = replace(SETTINGS, low=-0.7, high=-0.1, quantum=0.0, clip=True)
    decoded = encode_tile(values, settings, Coding()).decoded
    assert decoded.dtype == np.float64
    assert -0.7 <= decoded.min() <= decoded.max() <= -0.1


PLAIN = replace(
    SETTINGS,
    transform=spec_of(("none",) * 4, (0,) * 4, SHAPE),
    step=2.0**-4,
    center=0.0,
    double=True,
    quantum=0.0,
)


def edge(shape: tuple[int, ...], peak: float) -> np.ndarray:
    """Values whose one coefficient, in a transform that does nothing, is `peak` steps of PLAIN."""
    values = np.zeros(shape)
    values[0, 1, 2, 3] = peak * PLAIN.step
    return values


@pytest.mark.parametrize(("peak", "exact"), [(LARGEST - 1, False), (LARGEST, True)])
def test_a_tile_is_exact_where_an_integer_does_not_fit(peak: float, exact: bool) -> None:
    values = edge(SHAPE, peak)
    values[0, 0, 0, 0] += PLAIN.step / 3  # which is lost unless the tile is exact
    settings = replace(PLAIN, low=float(values.min()), high=float(values.max()))
    coded = encode_tile(values, settings, Coding())
    assert np.array_equal(coded.decoded, values) == exact
    assert np.abs(coded.decoded - values).max() <= settings.step
    assert same(decode_tile(coded.data, SHAPE, np.float64, settings), coded.decoded)


@pytest.mark.parametrize("peak", [MAX_CHOSEN - 0.7, MAX_CHOSEN + 0.3, MAX_CHOSEN * 16 + 0.7])
@pytest.mark.parametrize("weight", [0.0, 0.09])
def test_large_integers_are_the_nearest_ones(peak: float, weight: float) -> None:
    values = edge(SHAPE, peak)
    settings = replace(PLAIN, low=float(values.min()), high=float(values.max()))
    coded = encode_tile(values, settings, Coding(weight=weight))
    error = abs(coded.decoded[0, 1, 2, 3] - values[0, 1, 2, 3]) / settings.step
    assert error <= (0.5 if weight else 0.7) + 1e-6
    assert same(decode_tile(coded.data, SHAPE, np.float64, settings), coded.decoded)
