"""The coder of labels: what was coded comes back, and both engines write the same bytes."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_formats import native
from fhash_formats.transform.entropy import labels_portable
from fhash_formats.transform.entropy.labels import (
    blank_label_state,
    decode_labels,
    encode_labels,
)

SHAPES = [(1, 1, 1, 1), (2, 3, 4, 19), (1, 4, 1, 33), (3, 1, 5, 16)]


def labels(shape: tuple[int, ...], count: int, noise: float) -> np.ndarray:
    """Regions of equal labels, with a share of random ones."""
    chance = np.random.default_rng(count)
    regions = (np.indices(shape).sum(0) // 7) % count
    return np.where(chance.random(shape) < noise, chance.integers(0, count, shape), regions).astype(
        np.uint8
    )


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("count", [1, 2, 3, 5, 256])
@pytest.mark.parametrize("noise", [0.0, 0.05, 1.0])
def test_labels_come_back(shape, count, noise) -> None:
    source = labels(shape, count, noise)
    data = encode_labels(source, count)
    np.testing.assert_array_equal(decode_labels(data, count, shape), source)


@pytest.mark.skipif(native.library() is None, reason="the native library was not built here")
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("count", [2, 5, 256])
def test_both_engines_write_the_same_bytes(shape, count, monkeypatch) -> None:
    sources = [labels(shape, count, noise) for noise in (0.05, 1.0)]
    data = [encode_labels(source, count) for source in sources]
    garbage = np.random.default_rng(0).bytes(40)
    of_garbage = decode_labels(garbage, count, shape)
    assert of_garbage.max() < count
    monkeypatch.setenv("FHASH_NATIVE", "0")
    for source, stream in zip(sources, data, strict=True):
        assert encode_labels(source, count) == stream
        np.testing.assert_array_equal(decode_labels(stream, count, shape), source)
    np.testing.assert_array_equal(decode_labels(garbage, count, shape), of_garbage)


def test_the_engines_agree_on_their_sizes() -> None:
    state = blank_label_state()
    assert len(state.slots) == sum(labels_portable.SIZES)
    assert len(state.weights) % labels_portable.LANES == 0


def test_regions_take_few_bytes_and_noise_hardly_more_than_its_entropy() -> None:
    shape = (4, 8, 24, 24)
    x = np.arange(24) + np.arange(4)[:, None, None, None]
    regions = np.broadcast_to(x // 6, shape).astype(np.uint8)
    assert len(encode_labels(regions, 5)) < 120
    noise = np.random.default_rng(0).integers(0, 8, shape).astype(np.uint8)
    assert len(encode_labels(noise, 8)) < noise.size * 3 / 8 * 1.08
