"""Checks hold for an easy case, and see values, bytes and pictures that are spoiled."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest import checks, ray_cases, value_cases
from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.field_cases import TIME_CASES

Broken = Callable[[Run, Check], set[str]]
Spoiled = Callable[..., Run]
COMMON = [*checks.ACCESS_CHECKS, *checks.ACCURACY_CHECKS, *checks.REPEATING_CHECKS, checks.picture]
PART = (slice(1, None), slice(2, 7), slice(3, 8), slice(4, 9))


@pytest.mark.parametrize("check", COMMON)
def test_the_easy_case_keeps_every_property(run: Run, broken: Broken, check: Check) -> None:
    assert broken(run, check) == set()


@pytest.mark.parametrize(
    ("check", "properties"),
    [
        (checks.regions, {"region = slice"}),
        (checks.key_times, {"exact at key times"}),
        (checks.points, {"points = read"}),
    ],
)
def test_a_read_of_other_values_is_seen(
    run: Run, broken: Broken, spoiled: Spoiled, check: Check, properties: set[str]
) -> None:
    assert broken(spoiled(run, run.decoded + np.float32(1e-3)), check) == properties


def holed(values: np.ndarray) -> np.ndarray:
    """Other values, some of them missing."""
    values[:2] += np.float32(1e-3)
    values[2:, ::2] = np.nan
    return values


def part(change: Callable[[np.ndarray], object]) -> Callable[[np.ndarray], np.ndarray]:
    """A change of a part of the values."""

    def changed(values: np.ndarray) -> np.ndarray:
        values[PART] = change(values[PART])
        return values

    return changed


@pytest.mark.parametrize(
    ("check", "change", "properties"),
    [
        (checks.between, holed, {"even between steps"}),
        (checks.levels_of_detail, holed, {"level 0 = read", "coarse levels finite"}),
        (checks.points, holed, {"points: finite as read"}),
        (checks.presence, part(lambda values: np.nan), {"finite in the coreset"}),
        (checks.bound, part(lambda values: values + 0.02), {"strict bound"}),
        (
            checks.quality,
            part(lambda values: values + 0.02),
            {"beyond the stated error", "below the stated PSNR"},
        ),
        (checks.within_range, part(lambda values: 1.02), {"beyond the range"}),
    ],
)
def test_values_that_decode_wrongly_are_seen(
    compact_run: Run,
    broken: Broken,
    spoiled: Spoiled,
    check: Check,
    change: Callable[[np.ndarray], np.ndarray],
    properties: set[str],
) -> None:
    seen = broken(spoiled(compact_run, change(compact_run.decoded.copy())), check)
    assert seen >= properties
    assert seen == properties or change is holed


def test_holes_promises_constants_and_bounds_of_0_are_checked(
    compact_run: Run, broken: Broken, spoiled: Spoiled
) -> None:
    values = compact_run.values.copy()
    values[1, 2, 3, 4] = np.inf
    filled = spoiled(replace(compact_run, values=values), compact_run.decoded)
    assert broken(filled, checks.presence) == {"NaN outside of it"}

    config = replace(compact_run.config, max_error_rel=None, psnr=120.0)
    assert broken(replace(compact_run, config=config), checks.quality) == {"promised PSNR"}

    ones = np.ones_like(compact_run.values)
    decoded = ones.copy()
    constant = replace(compact_run, values=ones)
    assert broken(spoiled(constant, decoded), checks.constants) == set()
    decoded[0, 0, 0, 0] = np.nextafter(np.float32(1), np.float32(2))
    assert broken(spoiled(constant, decoded), checks.constants) == {"exact constant"}

    lossless = replace(compact_run.config, max_error_rel=None, max_error=0.0)
    (finding,) = checks.bound(replace(compact_run, config=lossless))
    assert finding.name == "lossless"
    assert finding.worst == np.count_nonzero(compact_run.values != compact_run.decoded) > 0


def test_bits_rounding_and_differences_are_counted_exactly(run: Run) -> None:
    zeros = np.zeros(3, np.float32)
    assert checks._count_unequal(zeros, zeros) == 0
    assert checks._count_unequal(zeros, -zeros) == 3
    assert checks._count_unequal(np.full(2, np.nan), np.full(2, np.nan)) == 0
    assert checks._count_unequal(zeros, zeros[:2]) == 3
    assert checks._count_unequal(zeros, zeros.astype(np.float64)) == 3

    off = np.float32(1e-5 * run.data_range)
    assert checks.rounding(run, run.decoded, run.decoded) == 0
    assert 0.5 < checks.rounding(run, run.decoded + off, run.decoded) < 1.1
    assert checks.rounding(run, run.decoded + 10 * off, run.decoded) > 1

    everywhere = np.ones(2, dtype=bool)
    large = np.array([2**63 - 1, 5], dtype=np.int64)
    huge, tiny = np.array([1.7e308, 0.0]), np.array([5e-324, 0.0])
    assert checks.largest_difference(large, np.array([2.0**63, 5.0]), everywhere) == 1
    assert checks.largest_difference(huge, -huge, everywhere) == 2 * Fraction(1.7e308)
    assert checks.largest_difference(tiny, np.zeros(2), everywhere) == Fraction(5e-324)
    assert checks.largest_difference(huge, -huge, ~everywhere) == 0


def test_the_coreset_of_an_interval_is_grown_and_spans_key_frames(compact_run: Run) -> None:
    values = np.zeros_like(compact_run.values)
    values[1, 4, 5, 6] = 10.0
    config = replace(compact_run.config, features=("interval:9:11",), dilation=1)
    mask = checks.expected_coreset(replace(compact_run, values=values, config=config))
    assert mask.sum(axis=(1, 2, 3)).tolist() == [0, 27, 0, 0]
    assert mask[1, 3:6, 4:7, 5:8].all()


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
    broken: Broken,
    monkeypatch: pytest.MonkeyPatch,
    cached: float,
    others: float,
    properties: set[str],
) -> None:
    def drawn(run: Run, mode: str) -> np.ndarray:
        return np.full((4, 4, 4), cached if mode == "cache" else others, np.float32)

    monkeypatch.setattr(checks, "_rendered", drawn)
    assert broken(paper_run, checks.picture) == properties


def test_a_picture_that_differs_from_that_of_float64_is_seen(
    compact_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = ray_cases.reference_picture
    monkeypatch.setattr(ray_cases, "reference_picture", lambda *given: reference(*given) + 2e-3)
    assert broken(compact_run, checks.picture) == {"float64 picture"}


@pytest.mark.parametrize("thorough", [False, True])
def test_bytes_that_depend_on_the_threads_are_seen(
    compact_run: Run,
    broken: Broken,
    monkeypatch: pytest.MonkeyPatch,
    thorough: bool,
    tmp_path: Path,
) -> None:
    encode = checks.encode
    counts = []

    def other(source: object, path: object, config: EncodeConfig, **rest: object) -> object:
        counts.append(int(os.environ["FHASH_THREADS"]))
        return encode(source, path, replace(config, seed=counts[-1]), **rest)

    monkeypatch.setattr(checks, "encode", other)
    run = replace(compact_run, thorough=thorough)
    assert broken(run, checks.same_bytes) == {"same bytes by other threads"}
    assert counts == [1, 2] if thorough else len(counts) == 1

    (tmp_path / "a").write_bytes(b"abcd")
    for data, count in ((b"abcd", 0), (b"abxd", 1), (b"axc", 2)):
        assert checks._count_unequal_bytes(data, tmp_path / "a") == count


def test_answers_outside_the_series_are_counted(compact_run: Run, broken: Broken) -> None:
    (outside,) = next(case for case in TIME_CASES if case.name == "tiny").checks
    assert broken(compact_run, outside) == set()
    volume = compact_run.volume
    clamped = SimpleNamespace(
        shape=volume.shape,
        key_times=volume.key_times,
        read=lambda step: volume.read(0),
        step_of_time=volume.step_of_time,
        sample=volume.sample,
    )
    assert broken(replace(compact_run, volume=clamped), outside) == {"outside is refused"}


@pytest.mark.parametrize(
    ("check", "error", "growth", "properties"),
    [
        (value_cases.powers_of_two, 0.0, 1.0, set()),
        (value_cases.powers_of_two, 1e-6, 1.0, {"times a power of two"}),
        (value_cases.powers_of_two, 0.0, 1.01, {"times a power of two, size"}),
        (value_cases.affine, 0.0, 1.0, set()),
        (value_cases.affine, 1e-3, 1.0, {"scaled and shifted, errors"}),
        (value_cases.affine, 0.0, 1.1, {"same size in any guise"}),
        (value_cases.affine, 1.0, 1.0, {"scaled and shifted, errors", "same PSNR in any guise"}),
        (value_cases.guises, 0.0, 1.0, set()),
        (value_cases.guises, 0.0, 0.9, {"same size in any guise"}),
        (value_cases.guises, 0.02, 1.0, {"same PSNR in any guise", "bound in any guise"}),
    ],
)
def test_a_guise_with_other_errors_or_another_size_is_seen(
    compact_run: Run,
    broken: Broken,
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
        return exact + same * factor + extra, value_cases._size(run) * growth

    monkeypatch.setattr(value_cases, "_encoded", encoded)
    seen = broken(compact_run, check)
    assert properties <= seen
    assert properties or not seen
