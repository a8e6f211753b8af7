"""Passes over values, also over difficult ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_formats.transform import values as elementwise
from fhash_formats.transform.values import (
    all_finite,
    cast,
    clip_shifted,
    clipped,
    corrected,
    dequantise,
    free_values,
    quantise,
    residual_of,
    within,
)

Values = npt.NDArray[Any]
SHAPE = (2, 5, 7, 311)  # more than a native piece, and not a multiple of anything
LARGEST = 2**30 - 1
TYPES = ["f2", "f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]


def values(dtype: npt.DTypeLike, seed: int = 0, special: bool = True) -> Values:
    rng, kind = np.random.default_rng(seed), np.dtype(dtype)
    if kind.kind != "f":
        limits = np.iinfo(kind)
        integers = rng.integers(limits.min, limits.max, SHAPE, dtype=kind, endpoint=True)
        integers.flat[:3] = limits.min, limits.max, 0
        return integers
    result = rng.normal(0, 2, SHAPE).astype(kind)
    if special:
        limits_of = np.finfo(kind)
        hard = [
            np.nan,
            np.inf,
            -np.inf,
            0.0,
            -0.0,
            limits_of.max,
            limits_of.min,
            limits_of.tiny,
            0.5,
            1.5,
            2.5,
            -0.5,
        ]
        result.reshape(-1)[100 : 100 + 144] = np.repeat(np.array(hard, kind), 12)
        result.reshape(-1)[300:312] = np.array(hard, kind)
    return result


def mask(seed: int = 3) -> npt.NDArray[np.bool_]:
    return np.random.default_rng(seed).random(SHAPE) < 0.7


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("counted", [None, mask()])
def test_bounds(dtype: str, counted: Any) -> None:
    given = values(dtype, special=False)
    step = np.dtype(dtype).type(0.25)
    other = given + step
    error = float(np.abs(given.astype("f8") - other.astype("f8")).max())
    assert within(given, other, np.nextafter(error, 1), counted)
    assert not within(given, other, 0.24, counted)
    at = (1, 4, 6, 310)
    for bad in (np.nan, np.inf):
        other = given.copy()
        other[at] = bad
        expected = counted is not None and not counted[at]
        assert within(given, other, 1.0, counted) == expected
    special = values(dtype)
    assert not within(special, special, 0.0)  # NaN is near nothing
    plain = np.where(np.isnan(special), 0, special).astype(dtype)
    assert within(plain, plain, 0.0)
    assert within(plain, plain[::-1].copy(), float("inf"))


def test_within_is_strict_to_the_last_bit() -> None:
    values = np.array([2**63 - 1, 0, -(2**63)])
    assert within(values, np.array([-(2**63), 0, -(2**63)]), float(2**64))
    assert not within(values, np.array([-(2**63), 0, -(2**63)]), float(2**63))
    assert within(np.array([5]), np.array([8]), 3.0)
    assert not within(np.array([5]), np.array([8]), 2.999)
    assert not within(np.array([1.0]), np.array([np.nan]), 1e300)
    assert not within(np.array([0.1]), np.array([0.4]), 0.3)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("base", ["f4", "f8"])
@pytest.mark.parametrize("quantum", [0.5, 0.1, 3.0, 1e-3])
@pytest.mark.parametrize("counted", [None, mask()])
def test_residuals(dtype: str, base: str, quantum: float, counted: Any) -> None:
    given, other = values(dtype, 1, special=False), values(base, 2, special=False)
    # Halves are rounded to even, and an error of half a quantum is none.
    given[0, 0, 0, :40] = np.arange(40) * np.dtype(dtype).type(quantum / 2)
    other[0, 0, 0, :40] = 0
    result = residual_of(given, other, counted, quantum, LARGEST)
    assert result is not None
    error = given.astype("f8") - other.astype("f8")
    expected = np.where(np.abs(error) > quantum / 2, np.rint(error / quantum), 0)
    expected = expected if counted is None else np.where(counted, expected, 0)
    np.testing.assert_array_equal(result[0], expected)
    assert result[1] == np.count_nonzero(expected) > 0
    wide = other.astype("f8") + result[0] * quantum
    for out in ("f4", "f8", "f2", "i2"):
        found = corrected(other, result[0], quantum, np.dtype(out))
        assert found.tobytes() == cast(wide, np.dtype(out)).tobytes()
    rest = given.astype("f8") - corrected(other, result[0], quantum, np.dtype("f8"))
    assert np.abs(rest if counted is None else rest[counted]).max() <= quantum / 2 * (1 + 1e-9)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_residuals_beyond_the_largest_integer(dtype: str) -> None:
    given, zeros = values(dtype), np.zeros(SHAPE, dtype)
    assert residual_of(given, zeros, None, 0.5, LARGEST) is None
    counted = np.isfinite(given) & (np.abs(given) < 1e3)
    assert residual_of(given, zeros, counted, 0.5, LARGEST)[1] > 0
    assert residual_of(given, zeros, counted, 0.0, LARGEST) is None
    last = np.zeros(SHAPE, dtype)
    last[-1, -1, -1, -1] = 1000
    assert residual_of(last, zeros, None, 1.0, 999) is None
    assert residual_of(last, zeros, None, 1.0, 1000)[1] == 1


@pytest.mark.parametrize("dtype", TYPES)
def test_every_type_has_residuals_and_bounds(dtype: str) -> None:
    given = values(dtype, special=False)
    base = given.astype("f8") * (1 - 1e-3) + 0.3
    result = residual_of(given, base, None, 2.0 ** (np.dtype(dtype).itemsize * 4), LARGEST)
    assert result is not None
    decoded = corrected(base, result[0], 2.0 ** (np.dtype(dtype).itemsize * 4), np.dtype(dtype))
    assert decoded.dtype == dtype
    assert within(given, decoded, 2.0**64)
    assert within(given, given, 0.0)
    assert not within(given, given[::-1].copy(), 0.0)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize(
    ("low", "high"),
    [(-1.0, 1.0), (0.0, 2.0), (-0.0, 2.0), (-2.0, -0.0), (-0.0, 0.0), (-1e300, 1e300)],
)
@pytest.mark.parametrize("center", [0.0, -0.0, 0.75])
def test_clipping(dtype: str, low: float, high: float, center: float) -> None:
    with np.errstate(over="ignore"):
        clipped = clip_shifted(values(dtype), center, low, high)
        kind = np.dtype(dtype).type
        moved = values(dtype) + kind(center)
        expected = np.where(moved < kind(low), kind(low), moved)
        expected = np.where(expected > kind(high), kind(high), expected)
        assert clipped.tobytes() == expected.astype(dtype).tobytes()
        numbers = clipped[~np.isnan(clipped)]
        assert numbers.min() >= np.dtype(dtype).type(low)
        assert numbers.max() <= np.dtype(dtype).type(high)
    assert np.isnan(clipped).sum() == np.isnan(values(dtype)).sum()


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("counted", [None, mask()])
def test_free_values_are_replaced_and_counted(dtype: str, counted: Any) -> None:
    rebuilt = values(dtype, 5)
    target = values(dtype, 4)
    total = free_values(target, rebuilt, counted, -1.0, 1.5)
    before = values(dtype, 4)
    free = ((before <= -1) & (rebuilt < before)) | ((before >= 1.5) & (rebuilt > before))
    free = free if counted is None else free | ~counted
    assert total == free.sum() > 0
    assert np.array_equal(target, np.where(free, rebuilt, before), equal_nan=True)


def test_empty_arrays() -> None:
    none = np.zeros((0, 1, 2, 3), np.float32)
    assert within(none, none, 0.0)
    assert residual_of(none, none, None, 1.0, LARGEST)[1] == 0
    assert corrected(none, np.zeros(none.shape, np.int32), 1.0, np.dtype("f8")).size == 0
    assert free_values(none.copy(), none, None, 0.0, 1.0) == 0
    assert all_finite(none)


def test_finite() -> None:
    assert all_finite(np.arange(5))
    for bad in (np.nan, np.inf, -np.inf):
        given = np.zeros(3 * elementwise.PIECE + 5, np.float32)
        assert all_finite(given)
        given[-1] = bad
        assert not all_finite(given)


def test_casts_stay_in_the_type() -> None:
    wide = np.array([np.nan, np.inf, -np.inf, 1e30, -1e30, 2.5, 3.5, -0.5])
    assert cast(wide, np.dtype("i2")).tolist() == [0, 32767, -32768, 32767, -32768, 2, 4, 0]
    assert cast(wide, np.dtype("u8")).tolist()[1] == 2**64 - 2048
    assert cast(wide, np.dtype("f4"))[3] == np.float32(1e30)


def test_arrays_that_are_not_in_order() -> None:
    given = values("f4", special=False)
    turned = np.asfortranarray(given)
    assert within(turned, given, 0.0)
    result = residual_of(turned, given + np.float32(1), None, 0.5, LARGEST)
    assert result is not None
    assert (result[0] == -2).all()


@pytest.mark.parametrize("dtype", TYPES)
def test_values_are_clipped_in_their_own_type(dtype: str) -> None:
    original = values(dtype)
    low, high = (-0.3, 1.1) if original.dtype.kind == "f" else (3.0, 90.0)
    ends = np.array([low, high]).astype(dtype)
    result = clipped(original.copy(), low, high)
    below, above = original < ends[0], original > ends[1]
    assert np.array_equal(result[below], np.full(below.sum(), ends[0]))
    assert np.array_equal(result[above], np.full(above.sum(), ends[1]))
    kept = ~(below | above)
    assert result[kept].tobytes() == original[kept].tobytes()


def test_clipping_keeps_the_signs_of_zeros_and_reaches_every_view() -> None:
    zeros = clipped(np.array([-0.0, 0.0, np.nan, -1.0], "f4"), 0.0, 1.0)
    assert np.signbit(zeros).tolist() == [True, False, False, False]
    assert np.isnan(zeros[2])
    turned = np.arange(-6.0, 6.0).reshape(3, 4).T
    assert clipped(turned, -1.0, 2.0) is turned
    assert (turned.min(), turned.max()) == (-1.0, 2.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_magnitudes_are_rounded_down_after_the_rounding_is_added(dtype: Any) -> None:
    coefficients = np.array([0.0, 0.25, -0.375, 0.5, -1.0, 3e12], dtype)
    integers, scaled = quantise(coefficients, 0.5, rounding=0.375)
    assert integers.tolist() == [0, 0, -1, 1, -2, 10**9]
    assert scaled.tolist() == [0.0, 0.5, -0.75, 1.0, -2.0, float(np.float32(6e12))]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_six_offsets_tell_odd_from_even(dtype: Any) -> None:
    integers = np.array([0, 1, -2, 3, -4, 5, 6, -7, 1000], np.int32)
    values = dequantise(integers, 1.0, (64, 32, 16, 8, -64, -32), dtype)
    assert values.tolist() == [0.0, 1.5, -2.25, 3.125, -4.0625, 4.5, 5.75, -6.5, 999.75]
