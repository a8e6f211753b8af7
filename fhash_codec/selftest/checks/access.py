"""Properties of reading: regions, key times, times between key times, points, levels of detail."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.selftest.case import Finding, Run

__all__ = ["ACCESS_CHECKS", "rounding"]

Values = npt.NDArray[Any]

N_REGIONS = 6
"""Random regions of each run."""
N_POINTS = 32
"""Random vertices of each run that are sampled."""
ROUNDING = 1e-5
"""Allowed difference between a point and the same vertex in profile paper, as a share of the range:
float32 sums in another order."""
WEIGHTS = (0.25, 0.5, 0.875)
"""Positions between two steps, as shares of the distance between them."""


def regions(run: Run) -> Iterator[Finding]:
    """A region at any step has the same bits as that slice of all decoded values."""
    generator = _generator(run)
    wrong = 0
    for _ in range(N_REGIONS):
        step = int(generator.integers(run.values.shape[0]))
        region = _region(generator, run.volume.shape[1:])
        wrong += _count_unequal(run.volume.read(step, region), run.decoded[step][region.slices()])
    t, z, y, x = (
        slice(*sorted(generator.integers(0, n + 1, 2).tolist())) for n in run.volume.shape
    )
    part, decoded = run.volume[t, z, y, x], run.decoded[t, z, y, x]
    if part.dtype.kind != "f":
        wrong += _count_unequal(part, run.volume[...][t, z, y, x])
        # Floats have not every integer of 64 bits: the exact ones are rounded, never the others.
        decoded = np.where(np.isnan(decoded), run.volume.fill or 0, decoded)
        part = part.astype(decoded.dtype)
    wrong += _count_unequal(part, decoded)
    yield Finding(name="region = slice", worst=float(wrong), limit=0.0, unit="values")


def key_times(run: Run) -> Iterator[Finding]:
    """Times of the series lead back to their steps, and a step given as a float reads the same
    bits."""
    steps = range(run.volume.shape[0])
    wrong = sum(_count_unequal(run.volume.read(float(step)), run.decoded[step]) for step in steps)
    times = run.volume.coords["t"].values
    if np.array_equal(run.volume.key_times.times, times):
        wrong += sum(run.volume.step_of_time(float(times[step])) != step for step in steps)
    keys = run.volume.key_times.key_frames
    wrong += sum(run.volume.key_times.key_index(step) != number for number, step in enumerate(keys))
    yield Finding(name="exact at key times", worst=float(wrong), limit=0.0, unit="values")


def between(run: Run) -> Iterator[Finding]:
    """Values between two steps are finite in the coreset; in profile compact they are interpolated
    linearly."""
    last = run.volume.shape[0] - 1
    if last == 0:
        return
    lost, worst = 0, 0.0
    largest = float(np.nanmax(np.abs(run.decoded)))
    scale = largest if largest > 0 else 1.0
    for before, after in list(pairwise(range(last + 1)))[:: max(1, last // 4)]:
        for weight in WEIGHTS:
            read = run.volume.read(before + weight)
            lost += int(np.count_nonzero(np.isnan(read) == run.volume.occupancy(before + weight)))
            if run.volume.profile == "compact":
                before_frame, after_frame, read = (
                    frame.astype(np.float64) / scale
                    for frame in (run.decoded[before], run.decoded[after], read)
                )
                off = np.abs(read - (before_frame * (1 - weight) + after_frame * weight))
                worst = max(worst, float(np.nanmax(off, initial=0.0)))
    yield Finding(name="finite between steps", worst=float(lost), limit=0.0, unit="values")
    if run.volume.profile == "compact":
        kind = np.finfo(run.decoded.dtype)
        limit = 4 * float(kind.eps) + float(kind.smallest_subnormal) / scale
        yield Finding(
            name="even between steps", worst=worst, limit=limit, unit="of the largest value"
        )


def points(run: Run) -> Iterator[Finding]:
    """Samples at vertices equal the values that `read` returns."""
    generator = _generator(run)
    t, z, y, x = (generator.integers(0, n, N_POINTS) for n in run.volume.shape)
    sampled = np.asarray(run.volume.sample(t=t, z=z, y=y, x=x))
    expected = run.decoded[t, z, y, x]
    yield Finding(
        name="points: finite as read",
        worst=float(np.count_nonzero(np.isnan(sampled) != np.isnan(expected))),
        limit=0.0,
        unit="values",
    )
    if run.volume.profile == "compact":
        wrong = np.count_nonzero((sampled != expected) & ~np.isnan(expected))
        yield Finding(name="points = read", worst=float(wrong), limit=0.0, unit="values")
        return
    yield Finding(
        name="points = read",
        worst=rounding(run, sampled, expected),
        limit=1.0,
        unit="of 1e-5 of the range",
    )


def levels_of_detail(run: Run) -> Iterator[Finding]:
    """Level 0 equals what `read` returns; coarser levels are finite at the vertices of the
    coreset."""
    if run.volume.profile != "compact":
        return
    box = run.volume.box.slices()
    wrong, lost = 0, 0
    for step in {0, run.volume.shape[0] - 1}:
        wrong += _count_unequal(run.volume.read_lod(step, 0), run.decoded[step][box])
        for lod in (1, 2):
            coarse = run.volume.read_lod(step, lod)
            in_coreset = np.isfinite(run.decoded[step][box][(slice(None, None, 1 << lod),) * 3])
            lost += int(np.count_nonzero(np.isfinite(coarse) != in_coreset))
    yield Finding(name="level 0 = read", worst=float(wrong), limit=0.0, unit="values")
    yield Finding(name="coarse levels finite", worst=float(lost), limit=0.0, unit="values")


ACCESS_CHECKS = (regions, key_times, between, points, levels_of_detail)


def rounding(run: Run, one: Values, other: Values) -> float:
    """The largest difference of two arrays, as a multiple of what profile paper may round.

    It may round 1e-5 of the range, plus the epsilon of the dtype times the largest value.
    """
    kind = np.finfo(run.decoded.dtype)
    low, high = (end / 2 for end in (run.volume.value_range.low, run.volume.value_range.high))
    allowed = (
        ROUNDING * (high - low)
        + float(kind.eps) * max(abs(low), abs(high))
        + float(kind.smallest_subnormal)
    )
    # Halves of the values, so that the difference does not overflow.
    off = np.abs(one.astype(np.float64) / 2 - other.astype(np.float64) / 2)
    return float(np.nanmax(off, initial=0.0)) / allowed


def _count_unequal(one: Values, other: Values) -> int:
    """The number of values whose bits differ; all of them if the shapes or dtypes differ."""
    if one.shape != other.shape or one.dtype != other.dtype:
        return max(one.size, other.size, 1)
    kind = f"u{one.dtype.itemsize}"
    return int(
        np.count_nonzero(
            np.ascontiguousarray(one).view(kind) != np.ascontiguousarray(other).view(kind)
        )
    )


def _generator(run: Run) -> np.random.Generator:
    """A generator that gives the same numbers for a case and its settings on every run and
    machine."""
    return np.random.default_rng(zlib.crc32(f"{run.case.name} {run.under}".encode()))


def _region(generator: np.random.Generator, shape: tuple[int, ...]) -> Box:
    spans = []
    for length in shape:
        low, high = sorted(generator.choice(length + 1, 2, replace=False).tolist())
        spans.append((int(low), int(high)))
    return Box.of(spans)
