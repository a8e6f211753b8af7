"""Values are as the names of their cases say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fhash_codec.selftest.cases import values

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
