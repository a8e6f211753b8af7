"""Reads that disagree with the decoded values are seen."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest import (
    checks as access,
)
from fhash_codec.selftest import (
    checks as accuracy,
)
from fhash_codec.selftest import (
    checks as pictures,
)
from fhash_codec.selftest import (
    checks as repeating,
)
from fhash_codec.selftest import (
    ray_cases as ray_checks,
)
from fhash_codec.selftest.case import Check, Run

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


@pytest.mark.parametrize("check", accuracy.CHECKS)
def test_the_easy_case_keeps_every_property_accuracy(
    run: Run, broken: Broken, check: Check
) -> None:
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


def drawn(cached: float, others: float) -> Callable[[Run, str], np.ndarray]:
    """Pictures of one value for the cache, and of another one for all other marches."""
    return lambda run, mode: np.full((4, 4, 4), cached if mode == "cache" else others, np.float32)


@pytest.mark.parametrize(
    ("cached", "others", "properties"),
    [
        (0.5, 0.5, set()),
        (1.001, 0.5, {"pixels in 0..1"}),
        (-0.001, 0.5, {"pixels in 0..1"}),
        (0.5, np.nan, {"finite pixels, stream", "finite pixels, arm"}),
    ],
)
def test_wrong_pixels_are_seen(
    paper_run: Run,
    broken: Callable[[Run, Check], set[str]],
    monkeypatch: pytest.MonkeyPatch,
    cached: float,
    others: float,
    properties: set[str],
) -> None:
    monkeypatch.setattr(pictures, "_rendered", drawn(cached, others))
    assert broken(paper_run, pictures.picture) == properties


def test_a_picture_that_differs_from_that_of_float64_is_seen(
    compact_run: Run,
    broken: Callable[[Run, Check], set[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reference = ray_checks.reference_picture
    monkeypatch.setattr(ray_checks, "reference_picture", lambda *given: reference(*given) + 2e-3)
    assert broken(compact_run, pictures.picture) == {"float64 picture"}


def test_the_easy_case_keeps_every_property_pictures(
    run: Run, broken: Callable[[Run, Check], set[str]]
) -> None:
    assert broken(run, pictures.picture) == set()


@pytest.mark.parametrize("check", repeating.CHECKS)
def test_the_easy_case_keeps_every_property_repeating(
    run: Run, broken: Broken, check: Check
) -> None:
    assert broken(run, check) == set()


@pytest.mark.parametrize("thorough", [False, True])
def test_bytes_that_depend_on_the_threads_are_seen(
    compact_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch, thorough: bool
) -> None:
    encode = repeating.encode
    counts = []

    def other(source: object, path: object, config: EncodeConfig, **rest: object) -> object:
        counts.append(int(os.environ["FHASH_THREADS"]))
        return encode(source, path, replace(config, seed=counts[-1]), **rest)

    monkeypatch.setattr(repeating, "encode", other)
    run = replace(compact_run, thorough=thorough)
    assert broken(run, repeating.same_bytes) == {"same bytes by other threads"}
    assert counts == [1, 2] if thorough else len(counts) == 1


def test_bytes_that_differ_are_counted(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abcd")
    assert repeating._count_unequal_bytes(b"abcd", tmp_path / "a") == 0
    assert repeating._count_unequal_bytes(b"abxd", tmp_path / "a") == 1
    assert repeating._count_unequal_bytes(b"axc", tmp_path / "a") == 2
