"""Checks that every run has to pass, whatever the case: reading, values, pictures, repetition."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.compact.goal import promise
from fhash_codec.compact.model import CompactModel
from fhash_codec.encoding import encode
from fhash_codec.selftest.case import Check, Finding, Run, environment
from fhash_formats.errors import InputError
from fhash_formats.support.values import Mask, Values, is_wide_integer

N_REGIONS = 6
"""Random regions of each run."""
N_POINTS = 32
"""Random vertices of each run that are sampled."""
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
    yield Finding("region = slice", wrong, 0.0, "values")


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
    yield Finding("exact at key times", wrong, 0.0, "values")


def between(run: Run) -> Iterator[Finding]:
    """Values between two steps are finite in the coreset; without the published network they are
    interpolated by the rule of the file."""
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
                near = slice(max(before - 1, 0), after + 2)
                frames = run.decoded[near].astype(np.float64) / scale
                off = np.abs(
                    read.astype(np.float64) / scale - _between(run, frames, before, weight)
                )
                worst = max(worst, float(np.nanmax(off, initial=0.0)))
    yield Finding("finite between steps", lost, 0.0, "values")
    if run.volume.profile == "compact":
        kind = np.finfo(run.decoded.dtype)
        limit = 4 * float(kind.eps) + float(kind.smallest_subnormal) / scale
        yield Finding("even between steps", worst, limit, "of the largest value")


def _between(run: Run, frames: Values, before: int, weight: float) -> Values:
    """Values at a share of the way from a step to the next, by frames of these and those beside.

    See FORMAT.md, Between steps.
    """
    first, second = frames[min(before, 1) :][:2]
    even: Values = first * (1 - weight) + second * weight
    if run.volume.info["model"]["between"]["rule"] == "linear":
        return even
    rise, bends = second - first, []
    distances = run.volume.key_times.distances(before)
    beside = (first - frames[0], distances[0]), (frames[-1] - second, distances[1])
    for other, distance in beside:
        if distance == 0:
            bends.append(np.zeros_like(rise))
            continue
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            mean = (3 + 3 * distance) / (
                (2 + distance) / (other / distance) + (1 + 2 * distance) / rise
            )
        slope = np.where(np.sign(other) * np.sign(rise) > 0, mean, 0.0)
        bends.append(np.where(np.isnan(other), 0.0, slope - rise))
    bend = bends[0] * (1 - weight) - bends[1] * weight
    return np.asarray(even + weight * (1 - weight) * bend)


def points(run: Run) -> Iterator[Finding]:
    """Samples at vertices equal the values that `read` returns."""
    generator = _generator(run)
    t, z, y, x = (generator.integers(0, n, N_POINTS) for n in run.volume.shape)
    sampled = np.asarray(run.volume.sample(t=t, z=z, y=y, x=x))
    expected = run.decoded[t, z, y, x]
    lost = _count(np.isnan(sampled) != np.isnan(expected))
    yield Finding("points: finite as read", lost, 0.0, "values")
    if run.volume.profile == "compact":
        wrong = _count((sampled != expected) & ~np.isnan(expected))
        yield Finding("points = read", wrong, 0.0, "values")
        return
    yield Finding("points = read", rounding(run, sampled, expected), 1.0, "of the rounding")


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
    yield Finding("level 0 = read", wrong, 0.0, "values")
    yield Finding("coarse levels finite", lost, 0.0, "values")


ACCESS_CHECKS = (regions, key_times, between, points, levels_of_detail)


def rounding(run: Run, one: Values, other: Values) -> float:
    """The largest difference of two arrays, as a multiple of what may be rounded.

    That is what a network's outputs may differ by, plus the epsilon of the dtype times the largest
    value.
    """
    model = run.volume._model
    share = 0.0 if isinstance(model, CompactModel) else model.network.rounding()
    kind = np.finfo(run.decoded.dtype)
    low, high = (end / 2 for end in (run.volume.value_range.low, run.volume.value_range.high))
    allowed = (
        share * (high - low)
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


def presence(run: Run) -> Iterator[Finding]:
    """Every vertex of the coreset is finite, every other one is NaN. Infinite values of the source
    are missing, just as NaN."""
    in_coreset = expected_coreset(run)
    yield Finding(
        "finite in the coreset", _count(in_coreset & ~np.isfinite(run.decoded)), 0.0, "values"
    )
    yield Finding("NaN outside of it", _count(~in_coreset & ~np.isnan(run.decoded)), 0.0, "values")


def bound(run: Run) -> Iterator[Finding]:
    """The strict bound holds in exact arithmetic. For a bound of 0, the number of differing values
    is counted."""
    error = _error_bound(run)
    if error is None:
        return
    worst = largest_difference(run.values, run.decoded, np.isfinite(run.decoded))
    if error == 0:
        yield Finding("lossless", _differing(run), 0.0, "values")
    else:
        yield Finding("strict bound", float(worst / error), 1.0, "of the bound")


def quality(run: Run) -> Iterator[Finding]:
    """The promised PSNR is reached, and the figures in the file are no better than the measured
    ones."""
    where = np.isfinite(run.decoded)
    reached = _psnr(run, where)
    promised = run.config.psnr if run.config.published else promise(run.config).get("psnr")
    if promised is not None and reached > 0:
        yield Finding("promised PSNR", promised / reached, 1.0, "of the dB reached")
    stated = run.volume.container.header["quality"]
    worst = largest_difference(run.values, _in_source_type(run), where)
    if stated["max_abs_error"]:
        # The stated error is a difference of two float64, which is rounded.
        beyond = max(float(worst / Fraction(stated["max_abs_error"]) - 1), 0.0)
        yield Finding("beyond the stated error", beyond, 1e-12, "of the stated error")
    else:
        beyond = float(worst) if stated["max_abs_error"] == 0 else 0.0
        yield Finding("beyond the stated error", beyond, 0.0, "in data units")
    if stated["psnr"] is not None and reached > 0:
        yield Finding("below the stated PSNR", max(stated["psnr"] - reached, 0.0), 1e-6, "dB")


def constants(run: Run) -> Iterator[Finding]:
    """A constant series comes back exactly, rounded to the dtype of the volume."""
    finite = run.values[np.isfinite(run.values)]
    if finite.min() == finite.max():
        yield Finding("exact constant", _differing(run), 0.0, "values")


def within_range(run: Run) -> Iterator[Finding]:
    """Decoded values exceed the range of the series by no more than the bound."""
    finite = run.values[np.isfinite(run.values)]
    low, high = Fraction(finite.min().item()), Fraction(finite.max().item())
    decoded = run.decoded[np.isfinite(run.decoded)]
    if is_wide_integer(run.values.dtype):
        low, high = Fraction(float(low)), Fraction(float(high))
    excess = max(
        low - Fraction(decoded.min().item()), Fraction(decoded.max().item()) - high, Fraction(0)
    )
    allowed = _error_bound(run) or Fraction(0)
    span = high - low if high > low else Fraction(1)
    yield Finding("beyond the range", float(excess / span), float(allowed / span), "of the range")


ACCURACY_CHECKS = (presence, bound, quality, constants, within_range)


def expected_coreset(run: Run) -> Mask:
    """The coreset as a mask (t, z, y, x).

    It is computed here anew for features of intervals. Other features depend on the encoder's
    choices, so the file's own occupancy is used for them.
    """
    finite: Mask = np.isfinite(run.values)
    if "all" in run.config.features:
        return finite
    if not all(feature.startswith("interval:") for feature in run.config.features):
        return np.asarray([run.volume.occupancy(step) for step in range(run.values.shape[0])])
    selected = np.zeros(run.values.shape, dtype=bool)
    for feature in run.config.features:
        low, high = (np.float64(end) for end in feature.split(":")[1:])
        if run.values.dtype.kind == "f":
            low, high = low.astype(run.values.dtype), high.astype(run.values.dtype)
        selected |= finite & (run.values >= low) & (run.values <= high)
    keys = run.volume.key_times.key_frames
    grown = [_grown(selected[step], run.config.dilation) & finite[step] for step in keys]
    mask = np.zeros(run.values.shape, dtype=bool)
    for step in range(len(mask)):
        # The coreset of a step between two key frames is the union of theirs.
        after = int(np.clip(np.searchsorted(keys, step), 0, len(keys) - 1))
        before = after if keys[after] == step or after == 0 or step > keys[-1] else after - 1
        mask[step] = grown[before] | grown[after]
    return np.asarray(mask & finite)


def _grown(mask: Mask, reach: int) -> Mask:
    """A mask (z, y, x) grown by `reach` vertices in the 26-neighbourhood, by sums over windows."""
    for axis, length in enumerate(mask.shape):
        sums = np.insert(np.cumsum(mask, axis=axis, dtype=np.int64), 0, 0, axis=axis)
        at = np.arange(length)
        high, low = np.minimum(at + reach + 1, length), np.maximum(at - reach, 0)
        mask = np.asarray(np.take(sums, high, axis=axis) > np.take(sums, low, axis=axis))
    return mask


def largest_difference(values: Values, decoded: Values, where: Mask) -> Fraction:
    """max |value - decoded| over the mask `where`, exactly."""
    given_values, decoded_values = values[where], decoded[where]
    if not given_values.size:
        return Fraction(0)
    if is_wide_integer(given_values.dtype):
        return max(
            abs(Fraction(a) - Fraction(b))
            for a, b in zip(given_values.tolist(), decoded_values.tolist(), strict=True)
        )
    # Halves do not overflow. The values that seem to differ most are compared exactly.
    rough = np.abs(given_values.astype(np.float64) / 2 - decoded_values.astype(np.float64) / 2)
    near = np.flatnonzero(rough >= rough.max() * (1 - 1e-12))[:8]
    return max(
        abs(Fraction(given_values[n].item()) - Fraction(decoded_values[n].item())) for n in near
    )


def _psnr(run: Run, where: Mask) -> float:
    """PSNR in dB over the mask `where`; infinite without an error, 0 for a constant series."""
    finite = run.values[np.isfinite(run.values)]
    span = Fraction(finite.max().item()) - Fraction(finite.min().item())
    if span == 0:
        return 0.0
    given_values, decoded_values = run.values[where], _in_source_type(run)[where]
    if is_wide_integer(given_values.dtype):
        shares = np.array(
            [
                float((a - Fraction(b)) / span)
                for a, b in zip(given_values.tolist(), decoded_values.tolist(), strict=True)
            ]
        )
    else:
        # Scaling by a power of two is exact and keeps differences from overflowing or vanishing.
        exponent = math.frexp(
            float(max(abs(Fraction(finite.max().item())), abs(Fraction(finite.min().item()))))
        )[1]
        scaled = np.ldexp(given_values.astype(np.float64), -exponent) - np.ldexp(
            decoded_values.astype(np.float64), -exponent
        )
        shares = scaled / float(span / Fraction(2) ** exponent)
    mean = float(np.mean(np.square(shares))) if shares.size else 0.0
    return -10 * math.log10(mean) if mean > 0 else math.inf


def _error_bound(run: Run) -> Fraction | None:
    """The strict bound in data units, None without one; finite even if the range overflows
    float64."""
    config = run.config
    if config.max_error is not None:
        return Fraction(config.max_error)
    if config.max_error_rel is None:
        return None
    if math.isfinite(run.data_range):
        return Fraction(config.max_error_rel * run.data_range)
    low, high = run.volume.value_range.low, run.volume.value_range.high
    return Fraction(config.max_error_rel) * (Fraction(high) - Fraction(low))


def _differing(run: Run) -> float:
    """The number of coreset values that differ from the original, rounded to the decoded dtype."""
    decoded = _in_source_type(run)
    same = run.values.astype(decoded.dtype) == decoded
    return _count(~same & np.isfinite(run.decoded))


def _in_source_type(run: Run) -> Values:
    """The decoded values in the source's type: floats cannot tell all integers of 64 bits apart."""
    volume = run.volume
    if volume.dtype.kind == "f" or volume.value_type.has_gaps:
        return run.decoded
    return np.stack([volume.values(step) for step in range(volume.shape[0])])


def _count(mask: Mask) -> float:
    return float(np.count_nonzero(mask))


SIZE = (48, 48)
"""Width and height of the picture in pixels."""
MODES = ("stream", "arm")
"""Modes of marching through a network; their pictures differ from those of the mode `cache`."""


def picture(run: Run) -> Iterator[Finding]:
    """A picture halfway between the first two steps, where values missing in either of them must
    not be drawn. 64-bit integers that are one number as float64 have none, and are refused."""
    try:
        cached = _rendered(run, "cache")
    except InputError:
        ends = {float(end) for end in run.volume.value_range.ends}
        yield Finding("refused pictures", len(ends) - 1, 0.0, "of series")
        return
    yield _finite("finite pixels", cached)
    beyond = max(-float(np.nanmin(cached)), float(np.nanmax(cached)) - 1.0, 0.0)
    yield Finding("pixels in 0..1", beyond, 0.0, "of a channel")
    # Imported late: decoding does not need the renderer.
    from fhash_codec.selftest.ray_cases import float64_picture, scene

    yield float64_picture(run, scene(size=[12, 12], step=_step(run)))
    if run.volume.profile == "paper":
        for mode in MODES:
            yield _finite(f"finite pixels, {mode}", _rendered(run, mode))


PICTURES_CHECKS = (picture,)


def _finite(name: str, picture: npt.NDArray[np.float32]) -> Finding:
    bad = float(np.count_nonzero(~np.isfinite(picture)))
    return Finding(name, bad, 0.0, "channels")


def _step(run: Run) -> float:
    return 0.5 if run.volume.shape[0] > 1 else 0.0


def _rendered(run: Run, mode: str) -> npt.NDArray[np.float32]:
    from fhash_codec.rendering import render
    from fhash_codec.rendering.scenes import Marching, Scene

    return render(run.volume, Scene(size=SIZE, step=_step(run), march=Marching(mode=mode))).rgba


THREADS = (1, 2)
"""Numbers of threads to compare with `case.RUN_THREADS`, with which the file of a run was made."""


def same_bytes(run: Run) -> Iterator[Finding]:
    """The same input gives the same bytes; with any number of threads but of the network.

    The long set compares all of `THREADS`, the quick set one of them in turn.
    """
    written = run.path.read_bytes()
    again = run.folder / "again.fhz"
    if run.config.published:
        encode(run.series, again, run.config, force=True)
        yield Finding("same bytes again", _count_unequal_bytes(written, again), 0.0, "bytes")
        return
    wrong = 0.0
    turn = zlib.crc32(f"{run.case.name} {run.under}".encode()) % len(THREADS)
    for count in THREADS if run.thorough else THREADS[turn : turn + 1]:
        with environment(FHASH_THREADS=str(count)):
            encode(run.series, again, run.config, force=True)
        wrong = max(wrong, _count_unequal_bytes(written, again))
    yield Finding("same bytes by other threads", wrong, 0.0, "bytes")


def sound(run: Run) -> Iterator[Finding]:
    """The file passes `verify`, which raises for a damaged file."""
    yield Finding("verify", 0.0 if run.volume.verify() > 0 else 1.0, 0.0, "damaged parts")


REPEATING_CHECKS = (same_bytes, sound)


def _count_unequal_bytes(written: bytes, path: Path) -> float:
    """The number of bytes that differ."""
    other = path.read_bytes()
    first, second = (
        np.frombuffer(data[: min(len(written), len(other))], dtype=np.uint8)
        for data in (written, other)
    )
    return float(np.count_nonzero(first != second) + abs(len(written) - len(other)))


COMMON_CHECKS: tuple[Check, ...] = (
    *ACCURACY_CHECKS,
    *ACCESS_CHECKS,
    *REPEATING_CHECKS,
    *PICTURES_CHECKS,
)
