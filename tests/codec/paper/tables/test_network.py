"""Bitmaps with ranks against a running sum, and sparse frames against dense ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.paper import network as ranked
from fhash_codec.paper.network import RankedBits, SparseFrame, between
from fhash_formats.errors import InputError

SHAPE = (5, 7, 13)


def mask_of(share: float, shape: tuple[int, ...] = SHAPE, seed: int = 0) -> npt.NDArray[np.bool_]:
    return np.random.default_rng(seed).random(shape) < share


def frame_of(
    share: float, dtype: str = "float32", seed: int = 0
) -> tuple[SparseFrame, npt.NDArray[np.floating[Any]]]:
    """A sparse frame and the same embeddings with 0 at the vertices that it does not hold."""
    mask = mask_of(share, seed=seed)
    held = np.random.default_rng(seed).normal(size=(int(mask.sum()), 3)).astype(dtype)
    dense = np.zeros((*SHAPE, 3), dtype)
    dense[mask] = held
    return SparseFrame.of(mask, held), dense


def bits_of(mask: npt.NDArray[np.bool_]) -> RankedBits:
    return RankedBits.of_octets(np.packbits(mask, bitorder="little"))


@pytest.mark.parametrize("size", [1, 63, 64, 65, 255, 256, 257, 1000, 4096])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 1.0])
def test_a_rank_is_the_number_of_ones_before(size: int, share: float) -> None:
    mask = mask_of(share, (size,))
    bits = bits_of(mask)
    expected = np.where(mask, np.cumsum(mask) - 1, mask.sum())
    np.testing.assert_array_equal(bits.lookup(np.arange(size)), expected)
    np.testing.assert_array_equal(bits.positions(), np.flatnonzero(mask))
    assert bits.count == mask.sum()


def test_more_ones_than_a_count_holds_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranked, "MAX_COUNT", 99)
    with pytest.raises(InputError, match="needs 100 vertices at one time; at most 99"):
        bits_of(np.ones(100, np.bool_))


@pytest.mark.parametrize("dtype", ["float16", "float32"])
@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_a_sparse_frame_reads_as_a_dense_one(share: float, dtype: str) -> None:
    frame, dense = frame_of(share, dtype)
    for region in (
        (slice(0, 5), slice(0, 7), slice(0, 13)),
        (slice(1, 4), slice(0, 7), slice(0, 13)),
        (slice(2, 3), slice(1, 6), slice(4, 5)),
        (slice(4, 5), slice(6, 7), slice(0, 13)),
    ):
        read = frame.read(region)
        assert read.dtype == dense.dtype
        np.testing.assert_array_equal(read, dense[region])


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_a_frame_between_two_has_the_bits_of_dense_ones(dtype: str) -> None:
    (before, dense_before), (after, dense_after) = (
        frame_of(share, dtype, seed) for share, seed in ((0.2, 3), (0.3, 4))
    )
    weight = np.float32(0.3)
    mixed = between(before, after, weight)
    dense = dense_before * np.float32(1 - weight) + dense_after * weight
    whole = tuple(slice(0, n) for n in SHAPE)
    np.testing.assert_array_equal(mixed.read(whole), dense)
    assert mixed.values.dtype == np.float32
    assert mixed.bits.count < before.bits.count + after.bits.count
