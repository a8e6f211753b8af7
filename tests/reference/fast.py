"""Integers of the fast coder: fixed distributions, of which eight lanes decode side by side.

They come band by band, row by row, in blocks of 16 along x: the even places of a block together,
then the odd ones, whose neighbours on both sides are known. The magnitudes around a vertex say
which distribution its token has; the signs around it, as far as they have agreed before, foretell
its own. Low bits of large magnitudes lie beside as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from reference.adaptive import Adaptive, clamp, log16
from reference.bands import Band
from reference.kernels import fast_prior
from reference.labels import number_in

LANES, BLOCK, LEVELS = 8, 16, 24
CLASSES = 3
"""Kinds of magnitudes of the nearest reference: 0, at most the mean of those around, or more."""
MAGNITUDES = 8 * CLASSES * LEVELS
"""Contexts of magnitudes of the plain quantiser, and of each of the two of a trellis after them."""
FIRST = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 15, 23, 39, 71, 135)
"""Smallest magnitude of each token."""
OF_SIGNS, NOTHING = 3 * MAGNITUDES, 3 * MAGNITUDES + 16
"""First context of signs, and that of a place where there is nothing to code."""
FLAG_CLASSES = 14
BANDS, ROWS, SHIFTS, BLOCKS = 0, 1, 3, 8
"""First of the flags of empty bands, of empty rows, of a band's shift, of empty blocks."""
AROUND = (
    *((0, 0, -1, 0, 16), (0, 0, -1, -1, 6), (0, 0, -1, 1, 6), (0, 0, -2, 0, 3)),
    *((0, -1, 0, 0, 16), (0, -1, 0, -1, 2), (0, -1, 0, 1, 2), (0, -2, 0, 0, 4)),
    *((0, -1, -1, 0, 4), (0, -1, 1, 0, 4)),
    *((-1, 0, 0, 0, 8), (-1, 0, 0, -1, 1), (-1, 0, 0, 1, 1), (-2, 0, 0, 0, 3)),
    *((-1, -1, 0, 0, 3), (-1, 1, 0, 0, 3), (-1, 0, -1, 0, 3), (-1, 0, 1, 0, 3)),
)
"""Moves along t, z, y, x to vertices known before, each with its weight."""
REFERENCES = ((4, 1), (12, 2), (4, 0), (3, 1))
"""Weight of the vertex of each reference, and of those on both sides."""
SIDE = 16
"""Weight of the vertices to the left and right of an odd place."""
NEXT = ((0, 5, 1, 6, 2, 4, 3, 7), (2, 7, 3, 4, 0, 6, 1, 5))
"""State of a lane after an even and an odd index, by the state before."""
PAD = 2
"""Zeros around a band along t, z and y; along x there is a block."""


def half_octaves(number: np.float32) -> int:
    """Half octaves of a number above 0 since 2^-127: its exponent and the first bit behind."""
    return int(number.view(np.int32)) >> 22


class BandNumbers:
    """Known numbers of a band: magnitudes within 255 and signs, with zeros around."""

    def __init__(self, band: Band) -> None:
        self.band, self.shift, self.any = band, 0, False
        self.n = tuple(high - low for low, high in zip(band.low, band.high, strict=True))
        self.blocks = -(-self.n[3] // BLOCK)
        padded = [n + 2 * PAD for n in self.n[:3]]
        self.magnitudes = np.zeros((*padded, (self.blocks + 2) * BLOCK), int)
        self.signs = np.zeros_like(self.magnitudes)
        self.filled = np.zeros((*padded, self.blocks + 2), bool)

    def row(self, array: npt.NDArray[Any], t: int, z: int, y: int) -> npt.NDArray[Any]:
        """A row of one of the arrays, with its zeros."""
        row: npt.NDArray[Any] = array[t + PAD, z + PAD, y + PAD]
        return row


class FastDecoder:
    """The integers in some bytes."""

    def __init__(self, data: bytes | memoryview, trellis: bool) -> None:
        self.trellis, self.lane_states = trellis, [0] * LANES
        size, data = number_in(memoryview(data))
        self.flags = Adaptive(data[:size], 0, [], BLOCKS + 8 * FLAG_CLASSES)
        size, data = number_in(data[size:])
        self.bits, self.at = int.from_bytes(data[:size], "little"), 0
        self.words, self.word = bytes(data[size:]), 4 * LANES
        self.states = np.frombuffer(self.words.ljust(4 * LANES, b"\0"), "<u4", LANES).tolist()
        prior = fast_prior()
        # One in 64 distributions of tokens, or of signs, unless it is the usual one.
        chosen = prior.defaults.tolist()
        any_chosen = 0
        for context in range(NOTHING):
            if context < OF_SIGNS and (context >= MAGNITUDES) != trellis:
                continue
            if context % LEVELS == 0:
                any_chosen = self.take(1)
            if any_chosen and self.take(1):
                chosen[context] = self.take(6)
        self.at = -(-self.at // 8) * 8
        numbers = [n + 64 * (context >= OF_SIGNS) for context, n in enumerate(chosen)] + [128]
        self.slots = [prior.slots[number].tolist() for number in numbers]
        self.agreed = np.zeros((64, 2, 5, 2), int)  # by kind of band and parity

    def take(self, count: int) -> int:
        """The next bits."""
        value = self.bits >> self.at & (1 << count) - 1
        self.at += count
        return value

    def symbols(self, contexts: Sequence[int]) -> list[int]:
        """A symbol of each lane."""
        found = []
        for lane, context in enumerate(contexts):
            slots, state = self.slots[context], self.states[lane]
            symbol, place = 0, state % 2048
            while place >= slots[symbol]:
                place -= slots[symbol]
                symbol += 1
            state = slots[symbol] * (state // 2048) + place
            if state < 1 << 16:
                word = self.words[self.word : self.word + 2].ljust(2, b"\0")
                state = state << 16 | int.from_bytes(word, "little")
                self.word += 2
            self.states[lane] = state
            found.append(symbol)
        return found

    def decode(self, shape: Sequence[int], bands: Sequence[Band]) -> npt.NDArray[np.int32]:
        """Integers (t, z, y, x) of a shape, 0 outside the bands."""
        result, self.bands = np.zeros(tuple(shape), np.int32), []
        for band in bands:
            numbers = BandNumbers(band)
            self.bands.append(numbers)
            if not all(numbers.n) or not self.flags.simple(BANDS):
                continue
            numbers.any = True
            for bit in range(4, -1, -1):
                numbers.shift |= self.flags.simple(SHIFTS + bit) << bit
            for t, z, y in np.ndindex(numbers.n[:3]):
                row = self.decode_row(numbers, t, z, y)
                place = tuple(low + i for low, i in zip(band.low, (t, z, y), strict=False))
                result[place][band.low[3] : band.high[3]] = row[: numbers.n[3]]
        return result

    def decode_row(self, band: BandNumbers, t: int, z: int, y: int) -> npt.NDArray[np.int32]:
        """The integers of a row, and zeros to the end of its last block."""
        values = np.zeros(band.blocks * BLOCK, np.int32)
        near, sums, weight, nearest, kin = self.around(band, t, z, y)
        if not near.any() and not self.flags.simple(ROWS + (band.blocks > 2)):
            return values
        before = 0
        seen = self.agreed[band.band.kind].tolist()
        odds = [[log16(16 * a + 32) - log16(16 * b + 32) for a, b in parity] for parity in seen]
        for block in range(band.blocks):
            here = slice(block * BLOCK, (block + 1) * BLOCK)
            before = self.decode_block(
                *(band, (t, z, y), block, near[block], sums[here], weight, odds),
                *(2 * before + kin[block], nearest[here], values[here]),
            )
        return values

    def around(
        self, band: BandNumbers, t: int, z: int, y: int
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[Any], int, npt.NDArray[Any], list[int]]:
        """Blocks that lie near filled ones; weighted sums of magnitudes; sum of the weights.

        Then the magnitudes of the nearest reference, and which of its blocks are filled.
        """
        near, weight = np.zeros(band.blocks, bool), 0
        nearest, kin = np.zeros(band.blocks * BLOCK, int), [0] * band.blocks
        sums = np.zeros(band.blocks * BLOCK, int)
        for dt, dz, dy, dx, share in AROUND:
            row = t + dt, z + dz, y + dy
            if not all(0 <= i < n for i, n in zip(row, band.n, strict=False)):
                continue
            weight += share
            filled = band.row(band.filled, *row)
            near |= filled[:-2] | filled[1:-1] | filled[2:]
            sums += share * np.roll(band.row(band.magnitudes, *row), -dx)[BLOCK:-BLOCK]
        for reference, (share, sides) in zip(band.band.references, REFERENCES, strict=True):
            if reference is None:
                continue
            weight += share + 2 * sides
            nearest, kin = np.zeros_like(nearest), [0] * band.blocks
            other = self.bands[reference.band]
            *_, along = halvings = reference.halvings
            moved = [
                min(i >> h, n - 1) for i, h, n in zip((t, z, y), halvings, other.n, strict=False)
            ]
            filled = other.row(other.filled, *moved)
            if not other.any or not filled.any():
                continue
            for block in range(band.blocks):
                j = 1 + min(block >> along, other.blocks - 1)
                sides_filled = (
                    filled[j + (1 if block & 1 else -1)] if along else filled[j - 1] | filled[j + 1]
                )
                near[block] |= filled[j] | sides_filled
                kin[block] = int(filled[j])
            from_x = np.minimum(np.arange(band.n[3]) >> along, other.n[3] - 1)
            magnitudes = other.row(other.magnitudes, *moved)[BLOCK + from_x]
            more = other.shift - band.shift
            magnitudes = magnitudes << min(more, 8) if more >= 0 else magnitudes >> min(-more, 8)
            there = np.zeros(len(sums) + 2, int)
            there[1 : 1 + band.n[3]] = np.minimum(magnitudes, 255)
            nearest = there[1:-1]
            sums += share * nearest + sides * (there[:-2] + there[2:])
        return near, sums, weight, nearest, kin

    def decode_block(
        self,
        band: BandNumbers,
        place: tuple[int, int, int],
        block: int,
        near: bool,
        sums: npt.NDArray[Any],
        weight: int,
        odds: list[list[int]],
        before: int,
        nearest: npt.NDArray[Any],
        values: npt.NDArray[np.int32],
    ) -> int:
        """Decode a block into `values`; whether it may have others than 0.

        before: 2 where the block before may, 1 where that of the nearest reference is filled.
        """
        plane = band.band.kind >> 2
        group = 0 if plane in (0, 13) else 1 + (plane - 1) % 3
        scale = np.float32(1) / np.float32(max(weight, 1))
        number = 0
        if near and sums.sum():
            octaves = half_octaves(np.float32(sums.sum()) * scale) - 2 * (127 - 3) + 1
            number = clamp(octaves, 1, FLAG_CLASSES - self.trellis)
        if number < FLAG_CLASSES:
            flag = BLOCKS + ((group > 0) * FLAG_CLASSES + number) * 4 + before
            if not self.flags.simple(flag):
                return 0
        there = slice((block + 1) * BLOCK, (block + 2) * BLOCK)
        magnitudes = band.row(band.magnitudes, *place)[there]
        signs = band.row(band.signs, *place)[there]
        t, z, y = place
        rows = ((t, z, y - 1), (t, z - 1, y), (t - 1, z, y))
        known = [band.row(band.signs, *row)[there] for row in rows]
        inside = min(band.n[3] - block * BLOCK, BLOCK)
        for parity in range(2):
            x = np.arange(parity, BLOCK, 2)
            around = [row[x] for row in known]
            total = sums[x]
            if parity:
                right, right_sign = np.append(magnitudes[2::2], 0), np.append(signs[2::2], 0)
                total = total + SIDE * (magnitudes[::2] + right)
                around += [signs[::2], right_sign]
                weight += 2 * SIDE
                scale = np.float32(1) / np.float32(weight)
            levels = [
                clamp(half_octaves(np.float32(s) * scale) - 2 * (127 - 5) + 1, 0, LEVELS - 1)
                for s in total.tolist()
            ]
            quantisers = [self.trellis and state & 1 for state in self.lane_states]
            classes = np.add(nearest[x] > 0, nearest[x] * weight > total, dtype=int)
            contexts = [
                ((2 * group + parity) * CLASSES + of_class) * LEVELS
                + level
                + (self.trellis + quantiser) * MAGNITUDES
                if i < inside
                else NOTHING
                for i, of_class, level, quantiser in zip(
                    x, classes.tolist(), levels, quantisers, strict=True
                )
            ]
            tokens = self.symbols(contexts)
            low = [band.shift + max(level - 13 >> 1, 0) for level in levels]
            found = [
                self.magnitude(token, bits) if i < inside else 0
                for i, token, bits in zip(x, tokens, low, strict=True)
            ]
            sign = self.signs(band.band.kind, parity, found, around, odds[parity])
            values[x] = np.array(found) * sign
            if self.trellis:
                values[x] = (2 * np.abs(values[x]) - quantisers) * sign
                for lane in np.flatnonzero(x < inside):
                    self.lane_states[lane] = NEXT[found[lane] & 1][self.lane_states[lane]]
            magnitudes[x] = np.minimum(np.array(found) >> band.shift, 255)
            signs[x] = sign
        band.row(band.filled, *place)[block + 1] = bool(values.any())
        return 1

    def magnitude(self, token: int, low: int) -> int:
        """The magnitude of a token, of which so many low bits lie beside."""
        high = token
        if token == 15:
            bits = 7
            while bits < 37 and not self.take(1):
                bits += 1
            high = FIRST[15] + (1 << bits) + self.take(bits) - 128
        elif token > 8:
            high = FIRST[token] + self.take(token - 8)
        return high << low | self.take(low)

    def signs(
        self,
        kind: int,
        parity: int,
        magnitudes: list[int],
        around: Sequence[npt.NDArray[Any]],
        odds: list[int],
    ) -> npt.NDArray[Any]:
        """The signs of the places of one parity: -1, 0 or 1."""
        result = np.zeros(LANES, int)
        if not any(magnitudes):
            return result
        totals = [
            sum(int(row[lane]) * log for row, log in zip(around, odds, strict=False))
            for lane in range(LANES)
        ]
        contexts = [
            OF_SIGNS + min(abs(total) >> 3, 15) if magnitude else NOTHING
            for total, magnitude in zip(totals, magnitudes, strict=True)
        ]
        for lane, other in enumerate(self.symbols(contexts)):
            if magnitudes[lane]:
                result[lane] = -1 if (totals[lane] < 0) != other else 1
        for number, row in enumerate(around):
            products = row * result
            self.agreed[kind, parity, number] += (products > 0).sum(), (products < 0).sum()
        return result


def decode_fast(
    data: bytes | memoryview, shape: Sequence[int], bands: Sequence[Band], trellis: bool = False
) -> npt.NDArray[np.int32]:
    """Integers (t, z, y, x) of a shape, coded by the fast coder; those of a trellis or not."""
    return FastDecoder(data, trellis).decode(shape, bands)
