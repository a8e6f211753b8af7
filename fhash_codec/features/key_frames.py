"""Key frames: choice of the steps that are kept, and the map from steps to them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.value_range import power_of_two
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import Series
from fhash_formats.support.values import Longs, integer_origin, is_wide_integer
from fhash_formats.transform.values import about_origin

if TYPE_CHECKING:
    from fhash_formats.container import Container

FORMS = "all, every:K, auto:N or a list such as 0,4,9"
"""Forms of the setting `key_frames`, for error messages."""

MAX_VERTICES = 2**16
"""Vertices of a frame that `auto:N` looks at, at most."""

MAX_SAMPLES = 2**26
"""Values over all frames that `auto:N` holds in memory, at most."""


def strictly_monotonic(times: npt.NDArray[np.float64]) -> bool:
    """Whether all times (T,) are finite, and strictly ascend or strictly descend.

    A single finite time does.
    """
    before, after = times[:-1], times[1:]
    return bool(np.isfinite(times).all() and ((after > before).all() or (after < before).all()))


def time_axis(times: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The model's time axis (T,): the times if they are strictly monotonic, else step numbers."""
    return times if strictly_monotonic(times) else np.arange(times.size, dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class KeyTimes:
    """The map between steps, physical times and key indices of a series.

    Attributes:
        times: physical times of all steps, float64 (T,), strictly monotonic.
        key_frames: the steps that are key frames, ascending.

    Raises InputError for times that are not strictly monotonic; step numbers can replace them.
    """

    times: npt.NDArray[np.float64]
    key_frames: tuple[int, ...]

    def __post_init__(self) -> None:
        if not strictly_monotonic(self.times):
            raise InputError(
                "times are not finite and strictly ascending or descending; "
                "use step numbers in their place"
            )

    @classmethod
    def of(cls, container: Container) -> KeyTimes:
        """The map of a file."""
        stored = container.arrays.get("key_frames")
        steps = range(container.header["domain"]["shape"][0])
        times = time_axis(container.coordinate("time").values)
        return cls(
            times=times, key_frames=tuple(map(int, steps if stored is None else stored.read()))
        )

    def key_index(self, step: float) -> float:
        """The fractional key index of a fractional step, in [0, key frames - 1].

        It is a whole number exactly at each key frame. The map goes from the step to its physical
        time (piecewise linear between steps), and from the time to the key index (piecewise linear
        between key times). Key frames are steps, so both together are linear from one step to the
        next. The key index is computed in this way, because float64 may not tell apart the times
        between two steps. Steps before the first key frame or after the last one take its index; a
        single key frame gives 0. Raises RegionError for a step outside the series.
        """
        return float(self.key_indices(step))

    def key_indices(self, steps: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """`key_index` of an array of steps of any shape."""
        steps = np.asarray(steps, dtype=np.float64)
        last = self.times.size - 1
        outside = ~((steps >= 0) & (steps <= last))
        if outside.any():
            raise RegionError(f"step {steps[outside].flat[0]:g} is outside 0..{last}")
        # Linear between neighbours, found by their number: a search through all steps for each
        # of them would make reading a long series quadratic.
        before = np.floor(steps).astype(np.int64)
        indices = self._key_indices_of_steps
        low, high = indices[before], indices[np.minimum(before + 1, last)]
        between = low + (high - low) * (steps - before)
        return np.asarray(np.clip(between, 0, len(self.key_frames) - 1))

    def keys_per_step(self, steps: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The derivative of the key index by the step, at steps of any shape.

        Between two steps the key index runs evenly; at a step, the derivative is that behind it.
        """
        last = self.times.size - 1
        before = np.minimum(np.floor(steps), max(last - 1, 0))
        after = np.minimum(before + 1, last)
        return self.key_indices(after) - self.key_indices(before)

    def distances(self, key: int) -> tuple[float, float]:
        """Distances in time from the key frame before `key` to it, and behind the one that follows.

        They are counted in the distance of these two, and 0 where there is no such key frame.
        """
        with np.errstate(divide="ignore", invalid="ignore"):  # scaling may make two times equal
            gaps = np.diff(self._scaled_keys[max(key - 1, 0) : key + 3])
            shares = gaps / gaps[min(key, 1)]
        before = float(shares[0]) if key else 0.0
        return before, float(shares[-1]) if key + 2 < len(self.key_frames) else 0.0

    @cached_property
    def _scaled_keys(self) -> npt.NDArray[np.float64]:
        """The times of the key frames, ascending and near 1."""
        return (self._ascending() * self._scale)[list(self.key_frames)]

    @cached_property
    def _key_indices_of_steps(self) -> npt.NDArray[np.float64]:
        """The key index of every step (T,)."""
        keys = self._scaled_keys
        indices = np.interp(self._ascending() * self._scale, keys, np.arange(keys.size))
        # Scaling may make two times equal; their steps still differ.
        indices[list(self.key_frames)] = np.arange(keys.size)
        return np.asarray(indices)

    def step_of_time(self, time: float) -> float:
        """The fractional step at a physical time, piecewise linear between steps.

        Raises RegionError for a time outside the series.
        """
        return float(self.steps_of_times(time))

    def steps_of_times(self, times: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """`step_of_time` of an array of times of any shape."""
        times = np.asarray(times, dtype=np.float64)
        ascending, targets = self._ascending(), self._sign() * times
        outside = ~((targets >= ascending[0]) & (targets <= ascending[-1]))
        if outside.any():
            raise RegionError(
                f"time {times[outside].flat[0]:g} is outside "
                f"{self.times.min():g}..{self.times.max():g}"
            )
        steps = np.asarray(
            np.interp(targets * self._scale, ascending * self._scale, np.arange(ascending.size))
        )
        # A time of the series gives its own step, even if scaling made it equal to another time.
        at = np.searchsorted(ascending, targets)
        return np.where(ascending[at] == targets, at, steps)

    @property
    def _scale(self) -> float:
        """A power of two that brings the times near 1.

        Without it, differences of the largest times and slopes between the smallest would overflow.
        The multiplication is exact.
        """
        return power_of_two(float(np.abs(self.times).max()))

    def _sign(self) -> float:
        return -1.0 if self.times[-1] < self.times[0] else 1.0

    def _ascending(self) -> npt.NDArray[np.float64]:
        """The times in ascending order for np.interp: negated, which is exact, if they descend."""
        return self._sign() * self.times


def select_key_frames(
    spec: str,
    series: Series,
    times: npt.NDArray[np.float64],
    progress: Progress,
    vertices: Longs | None = None,
) -> tuple[int, ...]:
    """The steps that the setting `key_frames` names, ascending.

    spec: all | every:K (the last step is always included) | auto:N | a list such as 0,4,9.
    times: the model's time axis (T,); for auto:N it must be strictly monotonic.
    vertices: those of a frame that auto:N looks at, ascending; None for all.

    auto:N reads every frame once (progress stage "key frames"). Raises InputError for a spec that
    is malformed or does not fit the series.
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
                f"key-frames is '{spec}' for {steps} steps; allowed: auto:N with N at least 2, "
                "since both ends are kept"
            )
        return (
            tuple(range(steps))
            if count >= steps
            else _auto(series, times, count, progress, vertices)
        )
    return _listed(spec, steps)


def _count(spec: str, value: str, form: str) -> int:
    """The number in a spec; raises InputError, with the form that is allowed, if it has none."""
    if not (value.isascii() and value.isdigit()) or int(value) < 1:
        raise InputError(f"key-frames is '{spec}'; write {form}")
    return int(value)


def _listed(spec: str, steps: int) -> tuple[int, ...]:
    """The steps of a list such as 0,4,9."""
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
    series: Series,
    times: npt.NDArray[np.float64],
    count: int,
    progress: Progress,
    vertices: Longs | None,
) -> tuple[int, ...]:
    """The `count` steps from which the other frames interpolate best, on a sample of vertices."""
    if not strictly_monotonic(times):
        raise InputError(
            "key-frames auto:N needs times that strictly ascend or descend; "
            "use step numbers in their place"
        )
    steps = series.shape[0]
    most = max(1, min(MAX_VERTICES, MAX_SAMPLES // steps))
    stride = vertex_stride(series.shape[1:], most)
    if vertices is not None:
        stride = -(-len(vertices) // most)
        vertices = vertices[::stride]
    samples: list[npt.NDArray[Any]] = []
    for step, frame in enumerate(series.frames()):
        if vertices is None:
            samples.append(frame[::stride, ::stride, ::stride].flatten())
        else:
            samples.append(frame.reshape(-1)[vertices])
        progress("key frames", step + 1, steps, f"every {stride}. vertex")
    return optimal_steps(segment_costs(gram_matrix(samples), times), count)


def vertex_stride(shape: Sequence[int], limit: int) -> int:
    """The smallest stride at which a frame (z, y, x) keeps at most `limit` vertices.

    The stride is the same on every axis; 1 if all vertices fit.
    """
    stride = 1
    while np.prod([-(-size // stride) for size in shape]) > limit:
        stride += 1
    return stride


def gram_matrix(samples: Sequence[npt.NDArray[Any]]) -> npt.NDArray[np.float64]:
    """Inner products (T, T) of frames, given as T arrays (vertices,).

    Values are scaled to order 1, and each vertex is shifted by its mean over time. The shift does
    not change an interpolation error, since the weights of an interpolation add up to one, but it
    avoids cancellation. NaN and infinite values are set to the mean of all finite values.
    """
    if is_wide_integer(samples[0].dtype):
        low = min(int(frame.min()) for frame in samples)
        high = max(int(frame.max()) for frame in samples)
        origin = integer_origin(low, high, samples[0].dtype)
        samples = [about_origin(frame, origin) if origin else frame for frame in samples]
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
    """Blocks (T, some vertices) of the samples in float64, at most 32 MiB each."""
    width = max(1, 2**22 // len(samples))
    for start in range(0, samples[0].size, width):
        yield np.stack([frame[start : start + width].astype(np.float64) for frame in samples])


def segment_costs(
    gram: npt.NDArray[np.float64], times: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Interpolation errors (T, T): entry [a, b] is the summed squared error between a and b.

    Frames strictly between steps a and b are interpolated in time from the frames of a and b. With
    y_k = x_k - x_a and s_k = t_k - t_a, the error of frame k is |y_k - s_k / s_b y_b|^2; its sum
    over k needs only the inner products. Infinite if b <= a.
    """
    steps = times.size
    scaled = times * power_of_two(float(np.abs(times).max()))
    costs = np.full((steps, steps), np.inf)
    upper = np.triu(gram, 1)
    for a in range(steps - 1):
        later = slice(a + 1, steps)
        s = np.abs(scaled[later] - scaled[a])
        s = s / s[-1]
        to_a, square_a = gram[later, a], gram[a, a]
        squares = np.diagonal(gram)[later] - 2 * to_a + square_a  # |y_k|^2
        # Sums over a < k < b, for every b at once.
        before_squares, before_s2, before_s = (np.cumsum(v) - v for v in (squares, s * s, s))
        before_to_a = np.cumsum(s * to_a) - s * to_a
        # Sum of s_k (y_k . y_b).
        mixed = upper[later, later].T @ s - before_to_a - (to_a - square_a) * before_s
        costs[a, later] = before_squares - 2 * mixed / s + squares * before_s2 / (s * s)
    np.maximum(costs, 0.0, out=costs)  # Rounding may leave a tiny negative sum.
    return costs


def optimal_steps(costs: npt.NDArray[np.float64], count: int) -> tuple[int, ...]:
    """The `count` steps, ends included, with the least total cost of the segments between them.

    costs: of the segments (T, T), from `segment_costs`. count: at least 2. Exact, by dynamic
    programming.
    """
    steps = costs.shape[0]
    best, predecessors = costs[0], []
    for _ in range(count - 2):
        total = best[:, None] + costs
        predecessor = total.argmin(axis=0)
        best = total[predecessor, np.arange(steps)]
        predecessors.append(predecessor)
    path = [steps - 1]
    for predecessor in reversed(predecessors):
        path.append(int(predecessor[path[-1]]))
    return (0, *reversed(path))
