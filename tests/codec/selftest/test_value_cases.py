"""Guises keep what they must keep, and differences between them are seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fhash_codec.selftest import value_cases as invariance
from fhash_codec.selftest import value_cases as values
from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.field_cases import waves


def test_powers_of_two_change_no_digit() -> None:
    values = waves(invariance.SHAPE).astype(np.float32)
    for factor in invariance.POWERS:
        np.testing.assert_array_equal(values * np.float32(factor) / np.float32(factor), values)


def test_guises_hold_the_same_values_in_another_order() -> None:
    values = waves(invariance.SHAPE)
    guises = dict(invariance._guises(values))
    assert len(guises) == 8
    np.testing.assert_array_equal(guises.pop("negated"), -values)
    for name, guise in guises.items():
        np.testing.assert_array_equal(np.sort(guise, axis=None), np.sort(values, axis=None))
        assert guise.shape != values.shape or not np.array_equal(guise, values), name


PLANTED = [
    (invariance.powers_of_two, 0.0, 1.0, set()),
    (invariance.powers_of_two, 1e-6, 1.0, {"times a power of two"}),
    (invariance.powers_of_two, 0.0, 1.01, {"times a power of two, size"}),
    (invariance.affine, 0.0, 1.0, set()),
    (invariance.affine, 1e-3, 1.0, {"scaled and shifted, errors"}),
    (invariance.affine, 0.0, 1.1, {"same size in any guise"}),
    (invariance.affine, 1.0, 1.0, {"scaled and shifted, errors", "same PSNR in any guise"}),
    (invariance.guises, 0.0, 1.0, set()),
    (invariance.guises, 0.0, 0.9, {"same size in any guise"}),
    (invariance.guises, 0.02, 1.0, {"same PSNR in any guise", "bound in any guise"}),
]


@pytest.mark.parametrize(("check", "error", "growth", "properties"), PLANTED)
def test_a_guise_with_other_errors_or_another_size_is_seen(
    compact_run: Run,
    broken: Callable[[Run, Check], set[str]],
    monkeypatch: pytest.MonkeyPatch,
    check: Check,
    error: float,
    growth: float,
    properties: set[str],
) -> None:
    """Gives every guise the errors of the run, and a share of the range more."""
    own = compact_run.decoded - compact_run.values.astype(np.float64)

    def encoded(run: Run, values: np.ndarray, factor: float, **_: object) -> tuple:
        exact = values.astype(np.float64)
        extra = error * (exact.max() - exact.min())
        same = own if values.shape == own.shape else np.resize(own, values.shape)
        return exact + same * factor + extra, invariance._size(run) * growth

    monkeypatch.setattr(invariance, "_encoded", encoded)
    assert properties <= broken(compact_run, check)
    if not properties:
        assert broken(compact_run, check) == set()


CASES = {case.name: case for case in values.CASES}


def values_of(name: str) -> np.ndarray:
    return np.stack(list(CASES[name].make().frames()))


@pytest.mark.parametrize("dtype", values.INTEGERS)
def test_integers_reach_both_ends_of_their_type(dtype: str) -> None:
    series = CASES[f"all-of-{dtype}"].make()
    given = np.stack([series.read(step) for step in range(series.shape[0])])
    assert given.dtype == dtype
    assert (given.min(), given.max()) == (np.iinfo(dtype).min, np.iinfo(dtype).max)


def test_constants_have_one_value() -> None:
    constant = [name for name in CASES if name.startswith("constant-")]
    assert len(constant) == 7
    for name in constant:
        assert np.unique(values_of(name)).size == 1, name


@pytest.mark.parametrize(
    ("name", "holds"),
    [
        ("nearly-constant-float32", lambda given: np.unique(given).size == 2),
        (
            "range-float32",
            lambda given: np.abs(given).min() < 2e-38 and np.abs(given).max() > 9e37,
        ),
        ("range-overflows", lambda given: np.isinf(given.max() - given.min())),
        (
            "denormals-float32",
            lambda given: 0 < given.max() < np.finfo("float32").smallest_normal,
        ),
        (
            "denormals-float64",
            lambda given: 0 < given.max() < np.finfo("float64").smallest_normal,
        ),
        ("signed-zero", lambda given: np.signbit(given[given == 0]).any()),
        ("isolated-missing", lambda given: np.count_nonzero(~np.isfinite(given)) == 6),
        ("missing-frames", lambda given: np.isfinite(given).any(axis=(1, 2, 3)).tolist()[1:3]),
        ("missing-checkerboard", lambda given: np.isinf(given).mean() == 0.5),
        ("one-finite-value", lambda given: np.isfinite(given).sum() == 1),
        ("nothing-finite", lambda given: not np.isfinite(given).any()),
        ("beyond-float64", lambda given: np.unique(given).size > np.unique(given * 1.0).size),
    ],
)
def test_values_are_as_their_name_says(name: str, holds: Callable[[np.ndarray], bool]) -> None:
    with np.errstate(over="ignore"):
        assert holds(values_of(name))


def test_a_declared_fill_value_is_missing_and_a_declared_range_is_not() -> None:
    given = values_of("declared-range")
    assert np.isnan(given[0, :, 0, 0]).all()
    assert np.nanmin(given) < 0.25
    assert np.nanmax(given) > 0.5
