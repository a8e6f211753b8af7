"""Which steps are trained on, and where a time between them lies (paper, Coreset Selection: key frames in chronological order)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.value_range import power_of_two
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import Series

FORMS = "all, every:K, auto:N or a list such as 0,4,9"
MAX_VOXELS = 2**16
MAX_SAMPLES = 2**26
"""Bounds of `auto:N`: voxels looked at in a frame, and values held over all frames."""


def strictly_monotonic(times: npt.NDArray[np.float64]) -> bool:
    """Whether times (T,) are finite and strictly ascending or strictly descending; a single finite time is."""
    before, after = times[:-1], times[1:]
    return bool(np.isfinite(times).all() and ((after > before).all() or (after < before).all()))


def time_axis(times: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """What the model's time runs along: the times (T,) where they are strictly monotonic, else the step numbers."""
    return times if strictly_monotonic(times) else np.arange(times.size, dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class KeyTimes:
    """Physical times of all steps, float64 (T,), strictly monotonic, and the ascending steps that are key frames.

    Raises InputError for times that are not strictly monotonic; step numbers will do in their place.
    """

    times: npt.NDArray[np.float64]
    key_frames: tuple[int, ...]

    def __post_init__(self) -> None:
        if not strictly_monotonic(self.times):
            raise InputError(
                "times are not finite and strictly ascending or descending; use step numbers in their place"
            )

    def key_index(self, step: float) -> float:
        """The fractional key index of a fractional step, in [0, key frames - 1]; a whole number exactly at each key frame.

        Step -> physical time (piecewise linear between steps) -> key index (piecewise linear between the key times). Both together are
        linear from one step to the next, since key frames are steps: so it is computed, because times between steps may be too close for
        float64 to tell apart. Steps before the first or after the last key frame clamp to it; a step outside the series raises
        RegionError; a single key frame gives 0.
        """
        return float(self.key_indices(step))

    def key_indices(self, steps: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """`key_index` of many steps at once, of any shape."""
        steps = np.asarray(steps, dtype=np.float64)
        last = self.times.size - 1
        outside = ~((steps >= 0) & (steps <= last))
        if outside.any():
            raise RegionError(f"step {steps[outside].flat[0]:g} is outside 0..{last}")
        return np.asarray(
            np.clip(
                np.interp(steps, np.arange(last + 1), self._key_indices_of_steps),
                0,
                len(self.key_frames) - 1,
            )
        )

    @cached_property
    def _key_indices_of_steps(self) -> npt.NDArray[np.float64]:
        """The key index of every step (T,)."""
        ascending = self._ascending() * self._scale
        keys = ascending[list(self.key_frames)]
        indices = np.interp(ascending, keys, np.arange(keys.size))
        # Times that scaling made equal are different steps all the same.
        indices[list(self.key_frames)] = np.arange(keys.size)
        return np.asarray(indices)

    def step_of_time(self, time: float) -> float:
        """The fractional step at a physical time, piecewise linear between steps; raises RegionError outside the times of the series."""
        return float(self.steps_of_times(time))

    def steps_of_times(self, times: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """`step_of_time` of many times at once, of any shape."""
        times = np.asarray(times, dtype=np.float64)
        ascending, turned = self._ascending(), self._sign() * times
        outside = ~((turned >= ascending[0]) & (turned <= ascending[-1]))
        if outside.any():
            raise RegionError(
                f"time {times[outside].flat[0]:g} is outside {self.times.min():g}..{self.times.max():g}"
            )
        found = np.asarray(
            np.interp(turned * self._scale, ascending * self._scale, np.arange(ascending.size))
        )
        # A time of the series is its step, also where scaling made it equal to another.
        at = np.searchsorted(ascending, turned)
        return np.where(ascending[at] == turned, at, found)

    @property
    def _scale(self) -> float:
        """A power of two, which is exact: differences of the largest times would overflow, slopes between the smallest as well."""
        return power_of_two(float(np.abs(self.times).max()))

    def _sign(self) -> float:
        return -1.0 if self.times[-1] < self.times[0] else 1.0

    def _ascending(self) -> npt.NDArray[np.float64]:
        """The times, negated where they descend: exact, and what np.interp needs."""
        return self._sign() * self.times


def select_key_frames(
    spec: str, series: Series, times: npt.NDArray[np.float64], progress: Progress
) -> tuple[int, ...]:
    """The ascending steps that `spec` names: all | every:K (the last step always included) | auto:N | a list such as 0,4,9.

    `auto:N` reads every frame once (progress stage "key frames") and needs strictly monotonic times (T,).
    Raises InputError for a spec that is malformed or does not fit the series.
    """
    steps = series.shape[0]
    kind, _, value = spec.partition(":")
    if spec == "all":
        return tuple(range(steps))
    if kind == "every":
        every = _count(spec, value, "every:K with K >= 1")
        return (*range(0, steps - 1, every), steps - 1)
    if kind == "auto":
        count = _count(spec, value, "auto:N with N >= 2")
        if count == 1 and steps > 1:
            raise InputError(
                f"key-frames is '{spec}' for {steps} steps; allowed: auto:N with N at least 2, since both ends are kept"
            )
        return tuple(range(steps)) if count >= steps else _auto(series, times, count, progress)
    return _listed(spec, steps)


def _count(spec: str, value: str, form: str) -> int:
    if not (value.isascii() and value.isdigit()) or int(value) < 1:
        raise InputError(f"key-frames is '{spec}'; write {form}")
    return int(value)


def _listed(spec: str, steps: int) -> tuple[int, ...]:
    parts = [part.strip() for part in spec.split(",")]
    if not all(part.isascii() and part.isdigit() for part in parts):
        raise InputError(f"key-frames is '{spec}'; allowed: {FORMS}")
    chosen = tuple(int(part) for part in parts)
    if chosen[-1] >= steps or any(second <= first for first, second in pairwise(chosen)):
        raise InputError(
            f"key-frames is '{spec}'; a list must ascend without repeats within 0..{steps - 1}"
        )
    return chosen


def _auto(
    series: Series, times: npt.NDArray[np.float64], count: int, progress: Progress
) -> tuple[int, ...]:
    if not strictly_monotonic(times):
        raise InputError(
            "key-frames auto:N needs times that strictly ascend or descend; use step numbers in their place"
        )
    steps = series.shape[0]
    stride = lattice_stride(series.shape[1:], max(1, min(MAX_VOXELS, MAX_SAMPLES // steps)))
    samples: list[npt.NDArray[Any]] = []
    for step, frame in enumerate(series.frames()):
        samples.append(frame[::stride, ::stride, ::stride].flatten())
        progress("key frames", step + 1, steps, f"every {stride}. vertex")
    return optimal_steps(segment_costs(gram_matrix(samples), times), count)


def lattice_stride(shape: Sequence[int], limit: int) -> int:
    """The smallest stride, the same on every axis, at which a frame (z, y, x) keeps at most `limit` vertices; 1 where it fits whole."""
    stride = 1
    while np.prod([-(-size // stride) for size in shape]) > limit:
        stride += 1
    return stride


def gram_matrix(samples: Sequence[npt.NDArray[Any]]) -> npt.NDArray[np.float64]:
    """Inner products (T, T) of frames, T arrays (voxels,), scaled to order 1 and shifted by the mean over time of each voxel.

    The shift changes no interpolation error, since the weights of an interpolation add up to one, and spares the digits of it.
    NaN and infinite values are set to the mean of all finite ones.
    """
    peak = max(
        float(np.abs(frame[np.isfinite(frame)].astype(np.float64)).max(initial=0.0))
        for frame in samples
    )
    scale = power_of_two(peak)
    total, count = 0.0, 0
    for block in _columns(samples):
        finite = np.isfinite(block)
        total, count = total + float((block * scale).sum(where=finite)), count + int(finite.sum())
    mean = total / max(count, 1)
    gram = np.zeros((len(samples), len(samples)))
    for block in _columns(samples):
        block = np.where(np.isfinite(block), block * scale, mean)
        block -= block.mean(axis=0)
        gram += block @ block.T
    return gram


def _columns(samples: Sequence[npt.NDArray[Any]]) -> Iterator[npt.NDArray[np.float64]]:
    """Blocks (T, some voxels) of the samples in float64, at most 32 MiB each."""
    width = max(1, 2**22 // len(samples))
    for start in range(0, samples[0].size, width):
        yield np.stack([frame[start : start + width].astype(np.float64) for frame in samples])


def segment_costs(
    gram: npt.NDArray[np.float64], times: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """cost[a, b], (T, T): summed squared error of the frames strictly between a and b if they are interpolated in time from a and b.

    With y_k = x_k - x_a and s_k = t_k - t_a, the error of frame k is |y_k - s_k / s_b y_b|^2, whose sum over k needs only the inner
    products. Infinite where b <= a.
    """
    steps = times.size
    scaled = times * power_of_two(float(np.abs(times).max()))
    costs = np.full((steps, steps), np.inf)
    upper = np.triu(gram, 1)
    for a in range(steps - 1):
        later = slice(a + 1, steps)
        s = np.abs(scaled[later] - scaled[a])
        s = s / s[-1]
        to_a, own = gram[later, a], gram[a, a]
        squares = np.diagonal(gram)[later] - 2 * to_a + own  # |y_k|^2
        # Sums over a < k < b, for every b at once.
        before_squares, before_s2, before_s = (np.cumsum(v) - v for v in (squares, s * s, s))
        before_to_a = np.cumsum(s * to_a) - s * to_a
        mixed = (
            upper[later, later].T @ s - before_to_a - (to_a - own) * before_s
        )  # sum of s_k (y_k . y_b)
        costs[a, later] = before_squares - 2 * mixed / s + squares * before_s2 / (s * s)
    np.maximum(costs, 0.0, out=costs)  # rounding may leave a tiny negative sum
    return costs


def optimal_steps(costs: npt.NDArray[np.float64], count: int) -> tuple[int, ...]:
    """The `count` >= 2 steps, both ends included, with the least total cost of the segments between them; exact dynamic programming."""
    steps = costs.shape[0]
    best, parents = costs[0], []
    for _ in range(count - 2):
        total = best[:, None] + costs
        parent = total.argmin(axis=0)
        best = total[parent, np.arange(steps)]
        parents.append(parent)
    path = [steps - 1]
    for parent in reversed(parents):
        path.append(int(parent[path[-1]]))
    return (0, *reversed(path))
