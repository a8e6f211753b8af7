"""The coder of labels: what was coded comes back."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_formats.transform.entropy.labels import (
    decode_labels,
    encode_labels,
)

SHAPES = [(1, 1, 1, 1), (2, 3, 4, 19), (1, 4, 1, 33), (3, 1, 5, 16)]


def labels(shape: tuple[int, ...], count: int, noise: float) -> np.ndarray:
    """Regions of equal labels, with a share of random ones."""
    chance = np.random.default_rng(count)
    regions = (np.indices(shape).sum(0) // 7) % count
    mixed = np.where(chance.random(shape) < noise, chance.integers(0, count, shape), regions)
    return mixed.astype(np.uint16)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("count", [1, 2, 3, 5, 256, 257, 65536])
@pytest.mark.parametrize("noise", [0.0, 0.05, 1.0])
def test_labels_come_back(shape, count, noise) -> None:
    source = labels(shape, count, noise)
    data = encode_labels(source, count)
    decoded = decode_labels(data, count, shape)
    assert decoded.dtype == source.dtype
    np.testing.assert_array_equal(decoded, source)


def test_regions_take_few_bytes_and_noise_hardly_more_than_its_entropy() -> None:
    shape = (4, 8, 24, 24)
    x = np.arange(24) + np.arange(4)[:, None, None, None]
    regions = np.broadcast_to(x // 6, shape).astype(np.uint8)
    assert len(encode_labels(regions, 5)) < 120
    noise = np.random.default_rng(0).integers(0, 8, shape).astype(np.uint8)
    assert len(encode_labels(noise, 8)) < noise.size * 3 / 8 * 1.08


def test_the_bytes_of_few_and_of_many_labels_are_part_of_the_format() -> None:
    """So their lengths and sums are written here."""
    shape = (3, 6, 12, 20)
    data = {count: encode_labels(labels(shape, count, 0.1), count) for count in (5, 256, 257, 3000)}
    assert {count: (len(code), sum(code) % 251) for count, code in data.items()} == PINNED


PINNED = {5: (441, 196), 256: (882, 48), 257: (747, 129), 3000: (1018, 131)}


def test_labels_that_are_numbered_in_their_order_of_appearance_cost_hardly_anything() -> None:
    blocks = np.arange(600).reshape(1, 1, 20, 30).repeat(4, 2).repeat(4, 3).astype(np.uint16)
    shuffled = np.random.default_rng(0).permutation(600).astype(np.uint16)[blocks]
    assert 3 * len(encode_labels(blocks, 600)) < len(encode_labels(shuffled, 600)) < 1000
