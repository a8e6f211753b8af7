"""Packed occupancy against its definition, one bit at a time."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.features.occupancy import (
    morton_index,
    pack,
    packed_bytes,
    unpack,
)

SHAPES = [
    (1, 1, 1), (1, 1, 2), (2, 1, 1), (1, 2, 1), (1, 1, 3), (1, 1, 9), (9, 1, 1), (1, 9, 1),
    (2, 2, 2), (1, 2, 5), (3, 1, 2), (2, 3, 5), (7, 11, 13), (1, 17, 4), (17, 1, 3), (5, 64, 2),
    (8, 8, 16), (1, 1, 100), (31, 2, 1), (4, 33, 16),
]  # fmt: skip


def brute_force_index(z, y, x, shape):
    """Take bits from x, y, z in turn while the axis has any."""
    axes = [
        [x, (shape[2] - 1).bit_length()],
        [y, (shape[1] - 1).bit_length()],
        [z, (shape[0] - 1).bit_length()],
    ]
    index = place = 0
    while any(left for _, left in axes):
        for axis in axes:
            if axis[1]:
                index |= (axis[0] & 1) << place
                axis[0] >>= 1
                axis[1] -= 1
                place += 1
    return index


def random_mask(shape, seed=0):
    return np.random.default_rng(seed).random(shape) < 0.4


@pytest.mark.parametrize("shape", SHAPES)
def test_bits_lie_where_the_definition_says(shape) -> None:
    mask, vertices = random_mask(shape), np.indices(shape)
    index = morton_index(*vertices, shape)
    assert index.ravel().tolist() == [
        brute_force_index(*(int(v) for v in vertex), shape) for vertex in vertices.reshape(3, -1).T
    ]
    expected = np.zeros(8 * packed_bytes(shape), dtype=bool)
    expected[index] = mask
    np.testing.assert_array_equal(pack(mask), np.packbits(expected))


@pytest.mark.parametrize("shape", [*SHAPES, (25, 125, 125)])
def test_unpack_inverts_pack_and_the_index_is_injective(shape) -> None:
    mask = random_mask(shape, 1)
    bits = pack(mask)
    assert (bits.dtype, bits.shape) == (np.uint8, (packed_bytes(shape),))
    np.testing.assert_array_equal(unpack(bits, shape), mask)
    assert np.unique(morton_index(*np.indices(shape), shape)).size == mask.size
    assert np.unpackbits(bits).sum() == mask.sum()
