"""Structural similarity, against scikit-image and against a direct evaluation."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from skimage import metrics

from fhash_codec.measure.ssim import ssim, ssim_steps
from fhash_formats.errors import InputError

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
