"""Ranges, ranks and likeness of values."""

from __future__ import annotations

import math
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage import metrics

from fhash_codec.measure.ssim import ssim, ssim_steps
from fhash_codec.measure.value_range import Mean, Ranks, RanksSpan, ValueRange, power_of_two
from fhash_formats.errors import InputError

RNG = np.random.default_rng(0)
KINDS = {
    "normal": RNG.normal(size=40_000),
    "ascending": np.arange(40_000.0),
    "descending": -np.arange(40_000.0),
    "waves": np.tile(np.arange(100.0), 400),
    "few values": RNG.integers(0, 5, 40_000),
    "outliers": np.where(RNG.random(40_000) < 0.001, 1e30, RNG.normal(size=40_000) + 300),
    "float32": RNG.normal(size=40_000).astype(np.float32),
    "int16": RNG.integers(-30_000, 30_000, 40_000).astype(np.int16),
}


def ranks_of(values: np.ndarray, size: int, parts: int) -> Ranks:
    ranks = Ranks(size)
    for part in np.array_split(values, parts):
        ranks.add(part)
    return ranks


@pytest.mark.parametrize("parts", [1, 13])
@pytest.mark.parametrize("size", [64, 1000])
@pytest.mark.parametrize("beyond", [400, 3000])
@pytest.mark.parametrize("kind", KINDS)
def test_ends_lie_outside_by_the_error_at_most(
    kind: str, beyond: int, size: int, parts: int
) -> None:
    values = KINDS[kind]
    ranks = ranks_of(values, size, parts)
    levels = math.ceil(math.log2(values.size / size))
    assert 0 < ranks.error <= values.size * levels / (2 * size)
    low, high = ranks.middle(beyond)
    assert np.count_nonzero(values < low) <= beyond
    assert np.count_nonzero(values > high) <= beyond
    slack = beyond - 2 * ranks.error - 2**levels
    assert np.count_nonzero(values <= low) >= slack
    assert np.count_nonzero(values >= high) >= slack
    if slack <= 0:
        return
    assert math.isfinite(low)
    assert math.isfinite(high)


def test_an_end_that_is_not_known_is_infinite() -> None:
    ranks = ranks_of(np.arange(1000.0), 10, 1)
    assert ranks.middle(0) == (-math.inf, math.inf)


@pytest.mark.parametrize("dtype", ["f4", "i2", "f8"])
@pytest.mark.parametrize("seed", range(20))
def test_spans_make_the_sketch_of_one_pass(dtype, seed) -> None:
    generator, size = np.random.default_rng(seed), 8
    values = (100 * generator.standard_normal(generator.integers(1, 2000))).astype(dtype)
    whole, parts = Ranks(size), Ranks(size)
    whole.add(values)
    cuts = np.sort(generator.integers(0, values.size + 1, generator.integers(0, 9)))
    for first, end in pairwise([0, *cuts.tolist(), values.size]):
        span = RanksSpan(first, size)
        middle = (first + end) // 2
        span.add(values[first:middle])
        span.add(values[middle:end].reshape(1, -1))
        assert len(span.blocks) <= 2 * max(1, values.size // size).bit_length()
        parts.extend(span)
    assert (parts.count, parts.error) == (whole.count, whole.error)
    for beyond in {0, values.size // 100, (values.size - 1) // 2}:
        assert parts.middle(beyond) == whole.middle(beyond)
    more = values[:500]
    whole.add(more)
    parts.add(more)
    assert (parts.error, parts.middle(2)) == (whole.error, whole.middle(2))


def test_a_span_of_another_place_is_refused() -> None:
    span = RanksSpan(3, 8)
    with pytest.raises(ValueError, match="values from 3 on do not follow 0"):
        Ranks(8).extend(span)


RANGES = [
    (0.0, 1.0),
    (-5.0, 3.0),
    (1e8, 1e8 + 1e-3),
    (-1e8 - 1e-3, -1e8),
    (1e-38, 1e38),
    (-1.7e308, 1.7e308),
    (5e-324, 2e-322),
    (-5e-324, 5e-324),
    (1e-310, 1.0),
    (2.0**53, 2.0**53 + 2),
]
finite = st.floats(allow_nan=False, allow_infinity=False)


def check_round_trip(values, low, high) -> None:
    value_range = ValueRange(low, high)
    unit = value_range.to_unit(values)
    back = value_range.from_unit(unit)
    assert unit.dtype == np.float32
    assert back.dtype == np.float64
    assert ((unit >= 0) & (unit <= 1)).all()
    assert ((back >= low) & (back <= high)).all()
    # Halves, since the full span of +-1.7e308 is not a float64.
    error, span = np.abs(back / 2 - values / 2), high / 2 - low / 2
    assert (error <= 2.0**-25 * span + math.ulp(max(abs(low), abs(high)))).all()


@pytest.mark.parametrize(("low", "high"), RANGES)
def test_error_law_and_exact_ends(low, high) -> None:
    fractions = np.linspace(0, 1, 1001)
    values = np.clip(low * (1 - fractions) + high * fractions, low, high)
    check_round_trip(values, low, high)
    value_range = ValueRange(low, high)
    np.testing.assert_array_equal(value_range.to_unit([low, high]), [0, 1])
    assert value_range.from_unit(0.0) == low
    assert (np.diff(value_range.to_unit(np.sort(values))) >= 0).all()


@given(st.lists(finite, min_size=1, max_size=20))
def test_error_law_for_any_values(numbers) -> None:
    check_round_trip(np.array(numbers), min(numbers), max(numbers))


@pytest.mark.parametrize(("low", "high"), [(1.0, 0.0), (np.nan, 1.0), (0.0, np.inf)])
def test_a_pair_that_is_no_range_is_refused(low, high) -> None:
    with pytest.raises(InputError, match="lower first"):
        ValueRange(low, high)


@given(st.floats(min_value=0, allow_infinity=False, allow_nan=False))
def test_power_of_two_is_exact_and_its_reciprocal_is_too(peak) -> None:
    scale = power_of_two(peak)
    assert scale * (1 / scale) == 1
    assert peak * scale / scale == peak
    assert peak * scale <= 2.0**25


@pytest.mark.parametrize(
    ("parts", "mean"),
    [
        ([[1.7e308, 1.7e308], [-1.7e308], [1.7e308]], 0.85e308),
        ([[5e-324, 5e-324], [5e-324]], 5e-324),
        ([[1e8, 1e8 + 1e-3], [1e8 + 2e-3]], 1e8 + 1e-3),
        ([[], [3]], 3.0),
    ],
)
def test_mean_neither_overflows_nor_drifts(parts, mean) -> None:
    total = Mean()
    for part in parts:
        total.add(np.array(part))
    assert total.count == sum(map(len, parts))
    assert math.isclose(total.value(), mean, rel_tol=1e-15)


def test_means_of_parts_make_that_of_the_whole() -> None:
    values = np.random.default_rng(2).normal(1e6, 3, 1000)
    whole, parts = Mean(), Mean()
    for part in np.split(values, [10, 10, 700]):
        whole.add(part)
        one = Mean()
        one.add(part)
        parts.join(one)
    assert (parts.count, parts.value()) == (whole.count, whole.value())


SHAPES = [
    (11, 11, 11),
    (12, 64, 70),
    (25, 40, 33),
    (1, 60, 70),
    (1, 1, 90),
    (5, 30, 2),
    (3, 4, 5),
    (1, 1, 1),
]


def pair(shape, seed=0):
    rng = np.random.default_rng(seed)
    original = rng.random(shape)
    return original, original + 0.1 * rng.standard_normal(shape)


def blurred(field):
    """The Gaussian mean around each vertex, mirrored at the borders, tap by tap."""
    weights = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights /= weights.sum()
    for axis in range(3):
        size = field.shape[axis]
        padded = np.pad(
            field, [(5, 5) if a == axis else (0, 0) for a in range(3)], mode="symmetric"
        )
        field = sum(w * padded.take(range(i, i + size), axis) for i, w in enumerate(weights))
    return field


def similarity(a, b, data_range):
    mean_a, mean_b = blurred(a), blurred(b)
    variance_a, variance_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    above = (2 * mean_a * mean_b + c1) * (2 * (blurred(a * b) - mean_a * mean_b) + c2)
    return above / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))


@pytest.mark.parametrize("shape", [(11, 11, 11), (12, 64, 70), (25, 40, 33), (1, 60, 70)], ids=str)
@pytest.mark.parametrize("offset", [0.0, 300.0])
def test_agrees_with_scikit_image(shape, offset) -> None:
    original, decoded = (field + offset for field in pair(shape))
    expected = metrics.structural_similarity(
        original.squeeze(),
        decoded.squeeze(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.2,
    )
    total, count = ssim(original, decoded, 1.2)
    assert total / count == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_a_mask_counts_its_vertices_and_hides_the_rest(shape) -> None:
    original, decoded = pair(shape)
    mask = np.random.default_rng(4).random(shape) < 0.4
    mask.flat[0] = False
    expected = similarity(original, np.where(mask, decoded, original), 1.0)[mask]
    decoded[~mask] = np.nan
    total, count = ssim(original, decoded, 1.0, mask)
    assert count == mask.sum()
    assert total == pytest.approx(expected.sum(), rel=1e-9, abs=1e-12)


def test_a_mask_of_everything_is_no_mask() -> None:
    original, decoded = pair((12, 20, 13))
    assert ssim(original, decoded, 1.0, np.ones(original.shape, bool)) == ssim(
        original, decoded, 1.0
    )


@pytest.mark.parametrize("masked", [False, True])
def test_vertices_that_are_not_finite_do_not_count(masked) -> None:
    original, decoded = pair((6, 7, 40))
    bad = np.random.default_rng(5).random(original.shape) < 0.1
    mask = (
        np.random.default_rng(6).random(original.shape) < 0.5
        if masked
        else np.ones(original.shape, bool)
    )
    mean = original[~bad].mean()
    one, other = (
        np.where(bad, mean, original),
        np.where(bad, mean, np.where(mask, decoded, original)),
    )
    counts = mask & ~bad
    if not masked:
        counts[..., :5] = counts[..., -5:] = False
    original[bad], decoded[bad] = np.inf, np.nan
    total, count = ssim(original, decoded, 1.0, mask if masked else None)
    assert count == counts.sum()
    assert total == pytest.approx(similarity(one, other, 1.0)[counts].sum(), rel=1e-9)


def test_wrong_frames_are_refused() -> None:
    original, decoded = pair((5, 6, 7))
    with pytest.raises(InputError, match="one shape"):
        ssim(original, decoded[1:], 1.0)
    with pytest.raises(InputError, match="one shape"):
        ssim(original[0], decoded[0], 1.0)
    decoded[2, 2, 2] = np.nan
    with pytest.raises(InputError, match="not finite"):
        ssim(original, decoded, 1.0)


@pytest.mark.parametrize("steps", [1, 2, 3, 7, 48, 1000])
@pytest.mark.parametrize("vertices", [1, 1000, 2**20])
@pytest.mark.parametrize("budget", [1, 2**21, 2**25])
def test_measured_steps_are_even_within_budget_and_include_the_ends(
    steps, vertices, budget
) -> None:
    chosen = ssim_steps(steps, vertices, budget)
    assert len(chosen) == max(1, min(steps, budget // vertices))
    assert len(chosen) == 1 or (chosen[0], chosen[-1]) == (0, steps - 1)
    gaps = np.diff(chosen)
    assert all(0 <= step < steps for step in chosen)
    assert not len(gaps) or (gaps.min() >= 1 and gaps.max() - gaps.min() <= 1)


MEMORY = """
import resource
import numpy as np
from fhash_codec.measure.ssim import _Frames
frame = np.zeros((16, 1200, 1200), np.float32)
frame[3] = 1
frames = _Frames(frame, frame, 1.0, None)
with open("/proc/self/status") as status:
    used = next(int(line.split()[1]) for line in status if line.startswith("VmData")) << 10
resource.setrlimit(resource.RLIMIT_DATA, (used + (64 << 20), used + (64 << 20)))
try:
    frames.similarity(((0, 16), (0, 1200), (0, 1200)))
except MemoryError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's limits on memory")
def test_no_memory_for_a_tile_is_said_and_ends_no_process() -> None:
    done = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "no memory to compare" in done.stdout
