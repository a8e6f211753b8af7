"""Values that decode wrongly are seen; differences are exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.checks import accuracy

Broken = Callable[[Run, Check], set[str]]


@pytest.mark.parametrize("check", accuracy.CHECKS)
def test_the_easy_case_keeps_every_property(run: Run, broken: Broken, check: Check) -> None:
    assert broken(run, check) == set()


REGION = (slice(1, None), slice(2, 7), slice(3, 8), slice(4, 9))


@pytest.mark.parametrize(
    ("check", "change", "properties"),
    [
        (accuracy.presence, lambda values: np.nan, {"finite in the coreset"}),
        (accuracy.bound, lambda values: values + 0.02, {"strict bound"}),
        (
            accuracy.quality,
            lambda values: values + 0.02,
            {"beyond the stated error", "below the stated PSNR"},
        ),
        (accuracy.within_range, lambda values: 1.02, {"beyond the range"}),
    ],
)
def test_a_value_that_decodes_wrongly_is_seen(
    compact_run: Run,
    broken: Broken,
    spoiled: Callable[..., Run],
    check: Check,
    change: Callable[[np.ndarray], object],
    properties: set[str],
) -> None:
    values = compact_run.decoded.copy()
    values[REGION] = change(values[REGION])
    assert broken(spoiled(compact_run, values), check) == properties


def test_a_filled_hole_is_seen(
    compact_run: Run, broken: Broken, spoiled: Callable[..., Run]
) -> None:
    values = compact_run.values.copy()
    values[1, 2, 3, 4] = np.inf
    run = spoiled(replace(compact_run, values=values), compact_run.decoded)
    assert broken(run, accuracy.presence) == {"NaN outside of it"}


def test_a_promise_that_was_missed_is_seen(compact_run: Run, broken: Broken) -> None:
    config = replace(compact_run.config, max_error_rel=None, psnr=120.0)
    assert broken(replace(compact_run, config=config), accuracy.quality) == {"promised PSNR"}


def test_a_constant_that_changed_is_seen(
    compact_run: Run, broken: Broken, spoiled: Callable[..., Run]
) -> None:
    ones = np.ones_like(compact_run.values)
    decoded = ones.copy()
    run = replace(compact_run, values=ones)
    assert broken(spoiled(run, decoded), accuracy.constants) == set()
    decoded[0, 0, 0, 0] = np.nextafter(np.float32(1), np.float32(2))
    assert broken(spoiled(run, decoded), accuracy.constants) == {"exact constant"}


def test_a_bound_of_0_counts_the_values_that_differ(compact_run: Run) -> None:
    lossless = replace(compact_run.config, max_error_rel=None, max_error=0.0)
    (finding,) = accuracy.bound(replace(compact_run, config=lossless))
    assert finding.name == "lossless"
    assert finding.worst == np.count_nonzero(compact_run.values != compact_run.decoded) > 0


def test_the_coreset_of_an_interval_is_grown_and_spans_key_frames(compact_run: Run) -> None:
    values = np.zeros_like(compact_run.values)
    values[1, 4, 5, 6] = 10.0
    config = replace(compact_run.config, features=("interval:9:11",), dilation=1)
    mask = accuracy.expected_coreset(replace(compact_run, values=values, config=config))
    assert mask.sum(axis=(1, 2, 3)).tolist() == [0, 27, 0, 0]
    assert mask[1, 3:6, 4:7, 5:8].all()


def test_differences_are_exact() -> None:
    everywhere = np.ones(2, dtype=bool)
    large = np.array([2**63 - 1, 5], dtype=np.int64)
    assert accuracy.largest_difference(large, np.array([2.0**63, 5.0]), everywhere) == 1
    huge = np.array([1.7e308, 0.0])
    assert accuracy.largest_difference(huge, -huge, everywhere) == 2 * Fraction(1.7e308)
    tiny = np.array([5e-324, 0.0])
    assert accuracy.largest_difference(tiny, np.zeros(2), everywhere) == Fraction(5e-324)
    assert accuracy.largest_difference(huge, -huge, ~everywhere) == 0
