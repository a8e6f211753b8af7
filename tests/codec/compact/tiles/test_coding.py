"""Size and error of coded tiles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.compact.tiles.coding import MIN_STEP_SHARE, Coding, Outcome, code, total
from fhash_formats.transform.tile.integers import OFFSETS
from fhash_formats.transform.tile.settings import TileSettings

SHAPE = (2, 8, 12, 16)
VALUES = np.random.default_rng(0).normal(size=SHAPE).cumsum(axis=3).astype(np.float32)
SETTINGS = TileSettings(
    transform=usual_transform(SHAPE),
    step=0.5,
    center=0.0,
    low=float(VALUES.min()),
    high=float(VALUES.max()),
    offsets=OFFSETS,
)


def test_the_outcome_is_that_of_the_decoded_values() -> None:
    counted = np.random.default_rng(1).random(SHAPE) < 0.7
    coded, outcome = code(Tile(VALUES, counted), SETTINGS, Coding())
    errors = (coded.decoded.astype(np.float64) - VALUES)[counted]
    assert outcome.size == len(coded.data)
    assert outcome.count == errors.size
    assert outcome.squares == pytest.approx((errors**2).sum())
    assert outcome.max_error == pytest.approx(np.abs(errors).max())
    expected = 10 * math.log10(9.0 / (errors**2).mean())
    assert outcome.psnr(3.0) == pytest.approx(expected)


@pytest.mark.parametrize("high", [1e-200, 1e-310])
def test_a_range_whose_scale_has_no_square_is_measured(high: float) -> None:
    """Settings of a file that grows may be of any range."""
    settings = replace(SETTINGS, low=0.0, high=high)
    coded, outcome = code(Tile(VALUES, None), settings, Coding())
    assert coded.decoded.max() == pytest.approx(high, abs=1e-38)
    assert outcome.max_error == pytest.approx(np.abs(VALUES).max())
    assert outcome.squares > 1


def test_an_exact_tile_has_no_error() -> None:
    coded, outcome = code(Tile(VALUES, None), replace(SETTINGS, double=True), Coding(exact=True))
    np.testing.assert_array_equal(coded.decoded, VALUES)
    assert (outcome.squares, outcome.max_error, outcome.count) == (0.0, 0.0, VALUES.size)
    assert outcome.psnr(1.0) == math.inf


def test_outcomes_add_up_by_their_weights() -> None:
    first = Outcome(size=3, squares=1.0, count=10, max_error=0.5, nonzero=2)
    second = Outcome(size=5, squares=2.0, count=20, max_error=0.1, nonzero=1)
    assert total([first, second], [2, 3]) == Outcome(
        size=21, squares=8.0, count=80, max_error=0.5, nonzero=7
    )
    assert total([first]) == first
    assert total([]).size == 0


def lattice_values(kind: str) -> np.ndarray:
    """Values of one kind, float64 (3, 12, 12, 12)."""
    rng = np.random.default_rng(0)
    t, z, y, x = np.mgrid[0:3, 0:12, 0:12, 0:12].astype(np.float64)
    smooth = np.sin(t / 4 + z / 5) * np.cos(y / 6) + x / 20
    return {
        "smooth": smooth,
        "far from zero": smooth + 300,
        "noise": rng.random(x.shape),
        "spikes": np.where(rng.random(x.shape) < 0.001, 1e3, smooth),
        "jump": (x > 7) + 0.01 * smooth,
        "plateau": np.where(t + z + y + x == 0, 0, 1) + 1e-3 * rng.random(x.shape),
    }[kind]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", ["smooth", "far from zero", "noise", "spikes", "jump", "plateau"])
def test_finer_steps_give_a_higher_psnr_to_the_finest(kind: str, dtype: type[np.floating]) -> None:
    """The error is that of a uniform quantiser or less, within 1 dB, down to MIN_STEP_SHARE.

    Beyond it coefficients do not fit the coder's integers, and tiles are exact.
    """
    values = lattice_values(kind).astype(dtype)
    low, high = float(values.min()), float(values.max())
    settings = replace(
        SETTINGS,
        transform=usual_transform(values.shape),
        center=float(np.float32((low + high) / 2)),
        low=low,
        high=high,
        double=True,
    )
    finest = -round(math.log2(MIN_STEP_SHARE))
    before = 0.0
    for exponent in [16, finest - 2, finest - 1, finest, finest + 6]:
        step = (high - low) * 2.0**-exponent
        stepped = replace(settings, step=step)
        psnr = code(Tile(values, None), stepped, Coding())[1].psnr(high - low)
        assert psnr >= 20 * math.log10(2.0**exponent * math.sqrt(12)) - 1
        assert psnr > before or math.isinf(psnr)
        before = psnr
    assert math.isinf(before)
