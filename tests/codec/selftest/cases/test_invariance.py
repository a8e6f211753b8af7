"""Guises keep what they must keep, and differences between them are seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.cases import invariance
from fhash_codec.selftest.cases.fields import waves


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
