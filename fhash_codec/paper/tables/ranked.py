"""Tables that hold only some vertices of a level, found by the rank of a bit in a bitmap.

A bitmap has one bit for each vertex of a level at one time, 1 where the vertex is held. The held
embeddings lie one after the other in the order of their bits, so the place of an embedding is the
number of ones before its bit, its *rank*. Two small arrays of counts make a rank one population
count: a perfect hash of an arbitrary region, without collisions and without a search.

The bitmap with its counts takes 1.25 bits for each vertex of the level. numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError

Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]

BLOCK_WORDS = 4
"""Words of a block: ones before a word in its block fit in one byte."""
MAX_COUNT = 2**32 - 1
"""Largest number of ones in a bitmap."""


@dataclass(frozen=True, eq=False)
class RankedBits:
    """A bitmap, and for each of its ones the number of ones before it.

    Attributes:
        words: uint64 (n,); position p is bit p % 64, 0 the lowest, of word p // 64.
        blocks: uint32 (ceil(n / 4) + 1,), ones before each block of 4 words; the last is the
            number of all ones.
        within: uint8 (n,), ones before each word in its block.
    """

    words: npt.NDArray[np.uint64]
    blocks: npt.NDArray[np.uint32]
    within: npt.NDArray[np.uint8]

    @classmethod
    def of_octets(cls, octets: npt.NDArray[np.uint8]) -> RankedBits:
        """Return the bitmap of bytes; position p is bit p % 8, 0 the lowest, of byte p // 8."""
        filled = np.zeros(-(-len(octets) // 8) * 8, np.uint8)
        filled[: len(octets)] = octets
        return cls.of_words(filled.view("<u8").astype(np.uint64, copy=False))

    @classmethod
    def of_words(cls, words: npt.NDArray[np.uint64]) -> RankedBits:
        """Return the bitmap of words; position p is bit p % 64, 0 the lowest, of word p // 64."""
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
        return cls(words, blocks.astype(np.uint32), within[: len(words)])

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
            positions: int64 of any shape, in 0 .. 64 n - 1.
        """
        word = positions >> 6
        # The bit moves to the top of its word, and all that come after it fall out.
        upto = self.words[word] << (~positions & 63).view(np.uint64)
        ranks = self.blocks[word >> 2] + self.within[word] + np.bitwise_count(upto)
        return np.where(upto.view(np.int64) < 0, ranks.astype(np.int64) - 1, self.count)

    def before(self, position: int) -> int:
        """Return the number of ones before a position in 0 .. 64 n."""
        word, bit = divmod(position, 64)
        block = word - word % BLOCK_WORDS
        whole = int(np.bitwise_count(self.words[block:word]).sum())
        part = int(self.words[word]) & ((1 << bit) - 1) if bit else 0
        return int(self.blocks[block // BLOCK_WORDS]) + whole + part.bit_count()

    @property
    def octets(self) -> npt.NDArray[np.uint8]:
        """The bitmap as bytes, in the order of `of_octets`, filled up to whole words."""
        return self.words.astype("<u8", copy=False).view(np.uint8)

    def positions(self) -> Integers:
        """Return the positions of all ones, ascending."""
        return np.flatnonzero(np.unpackbits(self.octets, bitorder="little"))


@dataclass(frozen=True, eq=False)
class SparseFrame:
    """The embeddings of a level at one time, at the vertices that it holds; 0 at all others.

    Attributes:
        shape: vertices (z, y, x) of the level.
        bits: which vertices are held. Rows along x are filled up to whole bytes of bits.
        values: embeddings (bits.count + 1, E) of the held vertices in C order over (z, y, x),
            float16 or float32. The last row is 0: `bits.lookup` gives it for other vertices.
    """

    shape: tuple[int, int, int]
    bits: RankedBits
    values: npt.NDArray[Any]

    @classmethod
    def of(cls, mask: Mask, held: npt.NDArray[Any]) -> SparseFrame:
        """Return a frame of the embeddings (held vertices, E) of a mask (z, y, x)."""
        z, y, x = mask.shape
        rows = np.packbits(mask, axis=2, bitorder="little")
        return cls._with((z, y, x), RankedBits.of_octets(rows.reshape(-1)), held)

    @classmethod
    def _with(
        cls, shape: tuple[int, int, int], bits: RankedBits, held: npt.NDArray[Any]
    ) -> SparseFrame:
        nothing = np.zeros((1, held.shape[1]), held.dtype)
        return cls(shape, bits, np.concatenate([held, nothing]))

    @property
    def row(self) -> int:
        """Bits of a row along x; vertex (z, y, x) has bit (z * shape[1] + y) * row + x."""
        return row_bits(self.shape[2])

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return self.bits.nbytes + self.values.nbytes

    def take(self, z: Integers, y: Integers, x: Integers) -> npt.NDArray[Any]:
        """Return the embeddings (..., E) of vertices, whose indices broadcast to (...)."""
        positions = (z * self.shape[1] + y) * self.row + x
        return self.values.take(self.bits.lookup(positions), axis=0)

    def read(self, box: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return the embeddings (z, y, x, E) of a region: 3 slices with explicit ends."""
        z, y, x = box
        octets = self.bits.octets[: prod(self.shape[:2]) * self.row // 8]
        rows = octets.reshape(*self.shape[:2], -1)[z, y, x.start // 8 : -(-x.stop // 8)]
        bits = np.unpackbits(rows, axis=2, bitorder="little").view(np.bool_)
        held = bits[:, :, x.start % 8 : x.start % 8 + x.stop - x.start]
        result = np.zeros((*held.shape, self.values.shape[1]), self.values.dtype)
        if (y.start, y.stop, x.start, x.stop) == (0, self.shape[1], 0, self.shape[2]):
            # The embeddings of whole planes lie together.
            first = self.bits.before(z.start * self.shape[1] * self.row)
            result[held] = self.values[first : first + np.count_nonzero(held)]
        else:
            at = held.nonzero()
            result[at] = self.take(*(i + axis.start for i, axis in zip(at, box, strict=True)))
        return result


def row_bits(vertices: int) -> int:
    """Return the bits of a row of vertices along x, filled up to whole bytes."""
    return -(-vertices // 8) * 8


def between(before: SparseFrame, after: SparseFrame, after_weight: np.float32) -> SparseFrame:
    """Return the frame between two frames of a level, linear in time, float32.

    It holds the vertices that either of them holds. Each embedding is that of dense frames, bit for
    bit: before * (1 - after_weight) + after * after_weight.
    """
    bits = RankedBits.of_words(before.bits.words | after.bits.words)
    positions = bits.positions()
    mixed: Floats = before.values[before.bits.lookup(positions)] * np.float32(1 - after_weight)
    mixed += after.values[after.bits.lookup(positions)] * after_weight
    return SparseFrame._with(before.shape, bits, mixed)
