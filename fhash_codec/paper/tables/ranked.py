"""Tables that hold only some vertices of a level, found by the rank of a bit in a bitmap.

A bitmap has one bit for each bucket of a level at one time node, 1 where the vertex is held. The
held embeddings lie one after the other in the order of their buckets, so the place of an embedding
is the number of ones before its bit, its *rank*. Two small arrays of counts make a rank one
population count: a perfect hash of an arbitrary region, without collisions and without a search.

The bitmap with its counts takes 1.25 bits for each bucket. numpy only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.network import Floats
from fhash_formats.errors import InputError

Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]

WORD = 64
"""Bits of a word of the bitmap."""
BLOCK_WORDS = 4
"""Words of a block: ones before a word in its block fit in one byte."""
MAX_COUNT = 2**32 - 1
"""Largest number of ones in a bitmap."""


@dataclass(frozen=True, eq=False)
class RankedBits:
    """A bitmap, and for each of its ones the number of ones before it.

    Attributes:
        size: number of bits.
        words: uint64 (ceil(size / 64),); position p is bit p % 64, 0 the lowest, of word p // 64.
            Bits beyond `size` are 0.
        blocks: uint32 (ceil(words / 4) + 1,), ones before each block of 4 words; the last is the
            number of all ones.
        within: uint8 (words,), ones before each word in its block.
    """

    size: int
    words: npt.NDArray[np.uint64]
    blocks: npt.NDArray[np.uint32]
    within: npt.NDArray[np.uint8]

    @classmethod
    def of(cls, mask: Mask) -> RankedBits:
        """Return the bits of a mask of any shape, in C order."""
        flat = mask.reshape(-1)
        octets = np.zeros(-(-flat.size // WORD) * (WORD // 8), np.uint8)
        packed = np.packbits(flat, bitorder="little")
        octets[: len(packed)] = packed
        return cls.of_words(octets.view("<u8").astype(np.uint64, copy=False), flat.size)

    @classmethod
    def of_words(cls, words: npt.NDArray[np.uint64], size: int) -> RankedBits:
        """Return the bitmap of words whose bits beyond `size` are 0."""
        counts = np.zeros((-(-len(words) // BLOCK_WORDS), BLOCK_WORDS), np.uint8)
        counts.reshape(-1)[: len(words)] = np.bitwise_count(words)
        # Up to 3 words of 64 ones come before the last word of a block: 192 fit in a byte.
        before = np.cumsum(counts[:, :-1], axis=1, dtype=np.uint8)
        within = np.concatenate([np.zeros_like(before[:, :1]), before], axis=1).reshape(-1)
        blocks = np.zeros(len(counts) + 1, np.int64)
        np.cumsum(counts.sum(axis=1, dtype=np.int64), out=blocks[1:])
        if blocks[-1] > MAX_COUNT:
            raise InputError(
                f"a level needs {blocks[-1]} vertices at one time; at most {MAX_COUNT} are allowed"
            )
        return cls(size, words, blocks.astype(np.uint32), within[: len(words)])

    @property
    def count(self) -> int:
        """Number of ones."""
        return int(self.blocks[-1])

    @property
    def nbytes(self) -> int:
        """Bytes of the bitmap and its counts."""
        return self.words.nbytes + self.blocks.nbytes + self.within.nbytes

    def lookup(self, positions: Integers) -> Integers:
        """Return the place of each position among the ones, `count` where its bit is 0.

        Args:
            positions: int64 of any shape, in 0 .. size - 1.
        """
        word = positions >> 6
        # The bit moves to the top of its word, and all that come after it fall out.
        upto = self.words[word] << (~positions & 63).view(np.uint64)
        ranks = self.blocks[word >> 2] + self.within[word] + np.bitwise_count(upto)
        return np.where(upto.view(np.int64) < 0, ranks.astype(np.int64) - 1, self.count)

    def positions(self) -> Integers:
        """Return the positions of all ones, ascending."""
        octets = self.words.astype("<u8", copy=False).view(np.uint8)
        return np.flatnonzero(np.unpackbits(octets, count=self.size, bitorder="little"))

    def run(self, start: int, stop: int) -> Mask:
        """Return the bits of positions start .. stop - 1."""
        octets = self.words.astype("<u8", copy=False).view(np.uint8)[start // 8 : -(-stop // 8)]
        bits = np.unpackbits(octets, bitorder="little")
        return bits[start % 8 : start % 8 + stop - start].view(np.bool_)


@dataclass(frozen=True, eq=False)
class SparseFrame:
    """The embeddings of a level at one time, at the vertices that it holds; 0 at all others.

    Attributes:
        shape: vertices (z, y, x) of the level.
        bits: which buckets are held, in C order over (z, y, x).
        values: embeddings (bits.count + 1, E) of the held buckets, float16 or float32. The last
            row is 0: `bits.lookup` gives it for a bucket that is not held.
    """

    shape: tuple[int, int, int]
    bits: RankedBits
    values: npt.NDArray[Any]

    @classmethod
    def of(cls, shape: Sequence[int], bits: RankedBits, held: npt.NDArray[Any]) -> SparseFrame:
        """Return a frame of the embeddings (bits.count, E) of its held buckets."""
        z, y, x = shape
        nothing = np.zeros((1, held.shape[1]), held.dtype)
        return cls((z, y, x), bits, np.concatenate([held, nothing]))

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return self.bits.nbytes + self.values.nbytes

    def take(self, buckets: Integers) -> npt.NDArray[Any]:
        """Return the embeddings (..., E) of buckets (...), numbered in C order over (z, y, x)."""
        return self.values.take(self.bits.lookup(buckets), axis=0)

    def read(self, box: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return the embeddings (z, y, x, E) of a region: 3 slices with explicit ends."""
        spans = [axis.stop - axis.start for axis in box]
        (z0, z1), (y0, y1), (x0, x1) = ((axis.start, axis.stop) for axis in box)
        _, y, x = self.shape
        result = np.zeros((*spans, self.values.shape[1]), self.values.dtype)
        if (y0, y1, x0, x1) == (0, y, 0, x):
            # Whole planes are one run of bits, whose embeddings lie together as well.
            first, end = self._ranks(z0 * y * x), self._ranks(z1 * y * x)
            held = self.bits.run(z0 * y * x, z1 * y * x)
            result[held.reshape(spans)] = self.values[first:end]
            return result
        buckets = (np.arange(z0, z1)[:, None, None] * y + np.arange(y0, y1)[:, None]) * x
        return self.take(buckets + np.arange(x0, x1))

    def _ranks(self, position: int) -> int:
        """Return the number of held buckets before a position in 0 .. size."""
        word, bit = divmod(position, WORD)
        before = int(self.bits.blocks[word // BLOCK_WORDS])
        if bit or word % BLOCK_WORDS:
            first = word // BLOCK_WORDS * BLOCK_WORDS
            before += int(np.bitwise_count(self.bits.words[first:word]).sum())
        if bit:
            before += (int(self.bits.words[word]) & ((1 << bit) - 1)).bit_count()
        return before


def between(before: SparseFrame, after: SparseFrame, after_weight: np.float32) -> SparseFrame:
    """Return the frame between two frames of a level, linear in time, float32.

    It holds the buckets that either of them holds. Each embedding is that of dense frames, bit for
    bit: before * (1 - after_weight) + after * after_weight.
    """
    words = before.bits.words | after.bits.words
    bits = RankedBits.of_words(words, before.bits.size)
    buckets = bits.positions()
    mixed: Floats = before.take(buckets) * np.float32(1 - after_weight)
    mixed += after.take(buckets) * after_weight
    return SparseFrame.of(before.shape, bits, mixed)
