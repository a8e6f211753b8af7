"""Errors of frames against plain numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fhash_codec.measure.errors import Errors, psnr
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.errors import InputError


def frames(count=3, shape=(6, 7, 8), *, seed=0, dtype=np.float64):
    rng = np.random.default_rng(seed)
    original = rng.random((count, *shape)).astype(dtype)
    return original, (original + 0.01 * rng.standard_normal(original.shape)).astype(dtype)


def added(errors, original, decoded, mask=None):
    for step in range(len(original)):
        errors.add(step, original[step], decoded[step], None if mask is None else mask[step])
    return errors


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int16, np.uint64])
@pytest.mark.parametrize("masked", [False, True])
def test_errors_are_those_of_plain_numpy(dtype, masked) -> None:
    rng = np.random.default_rng(1)
    original = (rng.random((3, 4, 5, 6)) * 1000).astype(dtype)
    decoded = original.astype(np.float64) + rng.standard_normal(original.shape)
    mask = rng.random(original.shape) < 0.3 if masked else np.ones(original.shape, bool)
    errors = added(Errors(1000.0), original, decoded, mask if masked else None)
    difference = (decoded - original.astype(np.float64))[mask]
    assert errors.count == mask.sum()
    assert errors.rmse == pytest.approx(math.sqrt(np.mean(difference**2)), rel=1e-12)
    assert errors.max_abs_error == pytest.approx(np.abs(difference).max(), rel=1e-12)
    assert errors.psnr == pytest.approx(20 * math.log10(1000 / errors.rmse), rel=1e-12)
    for step, figures in enumerate(errors.steps):
        errors_of_step = (decoded - original.astype(np.float64))[step][mask[step]]
        assert figures.step == step
        assert figures.rmse == pytest.approx(math.sqrt(np.mean(errors_of_step**2)), rel=1e-12)
        assert figures.max_abs_error == pytest.approx(np.abs(errors_of_step).max(), rel=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_bulk_has_both_of_its_ends(dtype) -> None:
    original = np.array([[[1, 2, 3, 4, 5]]], dtype)
    decoded = original + np.array([0.5, 0.25, 0.125, 0.75, 0.5], dtype)
    errors = Errors(4.0, ValueRange(2, 4))
    errors.add(0, original, decoded)
    mean = (0.25**2 + 0.125**2 + 0.75**2) / 3
    assert errors.bulk_quality().rmse == pytest.approx(math.sqrt(mean), rel=1e-12)


def test_values_that_are_not_finite_do_not_count() -> None:
    original, decoded = frames()
    original[0, 0, 0, :3] = np.nan, np.inf, -np.inf
    decoded[0, 0, 0, 0] = np.nan
    errors = added(Errors(1.0), original, decoded)
    finite = np.isfinite(original)
    assert errors.count == finite.sum() == original.size - 3
    assert errors.rmse == pytest.approx(
        math.sqrt(np.mean((original - decoded)[finite] ** 2)), rel=1e-12
    )


@pytest.mark.parametrize("factor", [2.0**-1040, 2.0**-900, 2.0**900, 2.0**1023])
def test_figures_scale_with_the_data_however_huge_or_tiny(factor) -> None:
    original, decoded = frames()
    plain = added(Errors(1.0), original, decoded)
    scaled = added(Errors(factor), original * factor, decoded * factor)
    # The tiniest factor leaves 34 bits of precision: denormal numbers.
    assert scaled.psnr == pytest.approx(plain.psnr, rel=1e-6)
    assert scaled.rmse == pytest.approx(plain.rmse * factor, rel=1e-6, abs=0)
    assert scaled.max_abs_error == pytest.approx(plain.max_abs_error * factor, rel=1e-6, abs=0)


def test_the_psnr_of_denormals_does_not_come_from_their_rounding() -> None:
    original = 5e-324 * np.arange(1000.0).reshape(1, 10, 100)
    decoded = original.copy()
    decoded[0, 0, :7] += 5e-324
    errors = Errors(float(original.max()))
    errors.add(0, original, decoded)
    # The root mean square is less than the smallest number.
    assert errors.psnr == pytest.approx(20 * math.log10(999 / math.sqrt(7 / 1000)))
    assert errors.steps[0].psnr == errors.psnr


def test_a_range_that_overflows_leaves_only_psnr_unknown() -> None:
    original = np.array([-1.7e308, 1.7e308, 0.0]).reshape(1, 1, 3)
    errors = Errors(math.inf)
    errors.add(0, original, original + np.array([1e300, 0, -1e300]))
    assert errors.psnr is None
    assert errors.rmse == pytest.approx(1e300 * math.sqrt(2 / 3), rel=1e-6)
    assert errors.max_abs_error == pytest.approx(1e300, rel=1e-6)


@pytest.mark.parametrize(
    ("data_range", "rmse"), [(0.0, 1.0), (1.0, 0.0), (1.0, None), (math.inf, 1.0)]
)
def test_psnr_is_none_where_it_has_no_finite_value(data_range, rmse) -> None:
    assert psnr(data_range, rmse) is None


def test_psnr_of_extreme_ratios() -> None:
    assert psnr(1e308, 1e-308) == pytest.approx(20 * 616)
    assert psnr(10.0, 1.0) == pytest.approx(20.0)


def test_a_frame_of_which_nothing_counts_has_no_figures() -> None:
    original, decoded = frames(1)
    errors = Errors(1.0)
    figures = errors.add(4, original[0], decoded[0], np.zeros(original[0].shape, bool))
    assert (figures.step, figures.psnr, figures.rmse, figures.max_abs_error) == (
        4,
        None,
        None,
        None,
    )
    assert (errors.count, errors.psnr, errors.rmse, errors.max_abs_error) == (0, None, None, None)


def test_wrong_frames_are_refused() -> None:
    original, decoded = frames(1)
    with pytest.raises(InputError, match="one shape"):
        Errors(1.0).add(0, original[0], decoded[0, 1:])
    with pytest.raises(InputError, match="one shape"):
        Errors(1.0).add(0, original[0], decoded[0], np.ones((1, 1, 1), bool))
    with pytest.raises(InputError, match="data range"):
        Errors(math.nan)
    decoded[0, 1, 1, 1] = np.nan
    with pytest.raises(InputError, match="step 7: decoded values are not finite"):
        Errors(1.0).add(7, original[0], decoded[0])
