"""The search for the integers of the trellis: valid paths."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_formats.transform.axes.bands import band_table
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.entropy.coder import decode_integers, encode_integers
from fhash_formats.transform.entropy.table import Table, single_band
from fhash_formats.transform.entropy.trellis import BUCKETS, RATES, choose_levels, rates_of

SHAPES = [(1, 1, 1, 1), (3, 5, 7, 11), (4, 6, 17, 33), (1, 1, 30, 40), (9, 1, 1, 5), (1, 2, 3, 300)]


def table_of(shape: tuple[int, ...], depth: int) -> Table:
    def axis(length: int) -> AxisTransform:
        kept = min(depth, (length - 1).bit_length())
        return AxisTransform(kind="9/7", depth=kept) if kept else AxisTransform(kind="none")

    t, z, y, x = (axis(length) for length in shape)
    return band_table(TransformSpec(axes=(t, z, y, x)), shape)


def coefficients(shape: tuple[int, ...], spread: float, dtype: Any) -> Any:
    random = np.random.default_rng(7)
    values = random.laplace(size=shape) * spread * np.exp(random.normal(size=shape))
    values[:, :, : shape[2] // 2] *= 0.05  # rows of zeros
    return np.clip(values, -9e8, 9e8).astype(dtype)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("spread", [0.3, 4.0])
def test_the_coder_takes_every_path(shape: tuple[int, ...], spread: float) -> None:
    table = table_of(shape, 2)
    levels = choose_levels(coefficients(shape, spread, np.float32), table, 0.27)
    data = encode_integers(levels, table, trellis=True).data
    decoded = decode_integers(data, shape, table, trellis=True)
    assert decoded.tobytes() == levels.tobytes()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_coefficients_are_near_their_integers(dtype: Any) -> None:
    # A quantiser has every second integer, and the search takes one of the two around.
    scaled = np.array([3.2, -1e3, 0.1, 5e6 + 0.5, -9.9e8, 7.0], dtype).reshape(1, 1, 1, 6)
    levels = choose_levels(scaled, single_band(scaled.shape), 0.0)
    assert np.abs(levels - scaled.astype(np.float64)).max() <= 2


def test_bits_cost_large_integers() -> None:
    scaled = coefficients((4, 8, 16, 16), 2.0, np.float32)
    table = single_band(scaled.shape)
    dear, free = (choose_levels(scaled, table, weight) for weight in (0.5, 0.0))
    assert np.count_nonzero(dear) < np.count_nonzero(free)
    assert np.square(free - scaled).sum() < np.square(dear - scaled).sum()


def test_a_path_errs_less_than_any_of_the_two_quantisers() -> None:
    scaled = coefficients((4, 8, 16, 16), 50.0, np.float32)
    levels = choose_levels(scaled, single_band(scaled.shape), 0.0)
    plain = 2 * np.rint(scaled / 2)
    # A trellis of eight states gains 1.0 dB of granular error at most; 1.53 dB is the limit.
    assert np.square(levels - scaled).mean() < 0.85 * np.square(plain - scaled).mean()


def test_a_row_of_zeros_stays_zero() -> None:
    levels = choose_levels(np.zeros((1, 1, 1, 3000), np.float32), single_band((1, 1, 1, 3000)), 0.3)
    assert not levels.any()


def test_rates_fall_with_the_count() -> None:
    counts = np.zeros((2, BUCKETS, RATES), np.int64)
    counts[:, 3, 0], counts[:, 3, 1] = 900, 100
    rates = rates_of(counts, 0.25)
    assert rates.shape == counts.shape
    assert rates.dtype == np.int32
    assert rates[0, 3, 0] < rates[0, 3, 1] < rates[0, 3, 5]
    assert not rates_of(counts, 0.0).any()
