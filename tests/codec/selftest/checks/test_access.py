"""Reads that disagree with the decoded values are seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.checks import access

Broken = Callable[[Run, Check], set[str]]


@pytest.mark.parametrize("check", access.CHECKS)
def test_the_easy_case_keeps_every_property(run: Run, broken: Broken, check: Check) -> None:
    assert broken(run, check) == set()


@pytest.mark.parametrize(
    ("check", "properties"),
    [
        (access.regions, {"region = slice"}),
        (access.key_times, {"exact at key times"}),
        (access.points, {"points = read"}),
    ],
)
def test_a_read_of_other_values_is_seen(
    run: Run,
    broken: Broken,
    spoiled: Callable[..., Run],
    check: Check,
    properties: set[str],
) -> None:
    assert broken(spoiled(run, run.decoded + np.float32(1e-3)), check) == properties


@pytest.mark.parametrize(
    ("check", "properties"),
    [
        (access.between, {"even between steps"}),
        (access.levels_of_detail, {"level 0 = read", "coarse levels finite"}),
        (access.points, {"points: finite as read"}),
    ],
)
def test_missing_or_other_values_between_reads_are_seen(
    compact_run: Run,
    broken: Broken,
    spoiled: Callable[..., Run],
    check: Check,
    properties: set[str],
) -> None:
    values = compact_run.decoded.copy()
    values[:2] += np.float32(1e-3)
    values[2:, ::2] = np.nan
    assert broken(spoiled(compact_run, values), check) >= properties


def test_bits_are_compared_not_values() -> None:
    zeros = np.zeros(3, np.float32)
    assert access._count_unequal(zeros, zeros) == 0
    assert access._count_unequal(zeros, -zeros) == 3
    assert access._count_unequal(np.full(2, np.nan), np.full(2, np.nan)) == 0
    assert access._count_unequal(zeros, zeros[:2]) == 3
    assert access._count_unequal(zeros, zeros.astype(np.float64)) == 3


def test_rounding_is_a_multiple_of_what_is_allowed(run: Run) -> None:
    off = np.float32(1e-5 * run.data_range)
    assert access.rounding(run, run.decoded, run.decoded) == 0
    assert 0.5 < access.rounding(run, run.decoded + off, run.decoded) < 1.1
    assert access.rounding(run, run.decoded + 10 * off, run.decoded) > 1
