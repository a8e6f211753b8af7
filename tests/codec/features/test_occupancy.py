"""Packed occupancy against its definition, one bit at a time."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.features.occupancy import (
    between,
    bit_order,
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


def test_pack_takes_views() -> None:
    mask = random_mask((6, 9, 12))
    view = mask[1:6, 2:9:2, ::-1]
    np.testing.assert_array_equal(pack(view), pack(np.ascontiguousarray(view)))


def test_thin_boxes_do_not_pay_for_the_thick_ones() -> None:
    assert packed_bytes((25, 125, 125)) == 65_536
    assert packed_bytes((1, 1, 1)) == 1
    assert packed_bytes((1, 1024, 1024)) == 131_072


def test_bit_order_goes_x_y_z_and_passes_over_an_axis_that_has_run_out() -> None:
    assert bit_order((2, 4, 16)) == [(2, 0), (1, 0), (0, 0), (2, 1), (1, 1), (2, 2), (2, 3)]


def test_between_key_frames_either_occupies() -> None:
    a, b = random_mask((5, 6, 7), 1), random_mask((5, 6, 7), 2)
    np.testing.assert_array_equal(unpack(between(pack(a), pack(b)), (5, 6, 7)), a | b)
    np.testing.assert_array_equal(between(pack(a), pack(a)), pack(a))
