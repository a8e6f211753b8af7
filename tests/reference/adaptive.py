"""The range coder, and adaptive estimates of binary decisions.

A decision is a bit. Its probability of a 1 comes from several *estimates*, each by a context.
An estimate keeps two probabilities, a slow and a fast one, and how often it was used. Their logits
are the inputs of a *mixer*: a weighted sum, whose weights learn from each bit. A *simple* estimate
is one probability that is used alone. Everything is in integers.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

LARGEST_LOGIT = 2816
"""Largest logit, in 1/256: 11."""
FULL_TRUST = 13
"""Uses from which on an estimate is believed in full; the logit of another is scaled down."""
FAST_USES = 20
"""Uses after which the fast probability no longer learns more slowly."""
SIMPLE_USES = 60
"""The same of a simple estimate."""

_P = (np.arange(65536) + 0.5) / 65536
_LOGITS = np.arange(-LARGEST_LOGIT, LARGEST_LOGIT + 1)
STRETCH: list[int] = (
    np.clip(np.floor(np.log(_P / (1 - _P)) * 256 + 0.5), -LARGEST_LOGIT, LARGEST_LOGIT)
    .astype(int)
    .tolist()
)
"""Logit of each probability in 1/65536, in 1/256."""
SQUASH: list[int] = (
    np.clip(np.floor(65536 / (1 + np.exp(-_LOGITS / 256)) + 0.5), 1, 65535).astype(int).tolist()
)
"""Probability in 1/65536 of each logit, from -LARGEST_LOGIT on."""
LOG: list[int] = np.floor(np.log2(np.maximum(np.arange(4096), 1)) * 16 + 0.5).astype(int).tolist()
"""16 log2 of each number below 4096."""
RATE = [655360 // (10 * uses + 16) for uses in range(401)]
"""Rate at which an estimate learns, by its uses, in 1/65536."""


def clamp(value: int, low: int, high: int) -> int:
    """The number in [low, high] nearest to a value."""
    return low if value < low else high if value > high else value


def squashed(logit: int) -> int:
    """Probability of a logit of any size."""
    return SQUASH[clamp(logit, -LARGEST_LOGIT, LARGEST_LOGIT) + LARGEST_LOGIT]


def log16(value: int) -> int:
    """16 log2 of a number above 0, of which only the 12 highest bits count."""
    shift = max(value.bit_length() - 12, 0)
    return LOG[value >> shift] + 16 * shift


class RangeDecoder:
    """The decisions in some bytes; zeros follow after the last one."""

    def __init__(self, data: bytes | memoryview) -> None:
        self.data = bytes(data) + bytes(4)
        self.low, self.high = 0, 0xFFFFFFFF
        self.value, self.position = int.from_bytes(self.data[:4], "big"), 4

    def bit(self, p: int) -> int:
        """The next decision. p: probability of a 1, 1 to 65535 in 1/65536."""
        middle = self.low + (((self.high - self.low) * p) >> 16)
        bit = int(self.value <= middle)
        if bit:
            self.high = middle
        else:
            self.low = middle + 1
        while (self.low ^ self.high) >> 24 == 0:  # the upper bytes agree
            byte = self.data[self.position] if self.position < len(self.data) else 0
            self.value = (self.value << 8) & 0xFFFFFFFF | byte
            self.low = (self.low << 8) & 0xFFFFFFFF
            self.high = (self.high << 8) & 0xFFFFFFFF | 255
            self.position += 1
        return bit


class Adaptive:
    """Estimates, mixing weights and simple estimates, which adapt to the bits of a range decoder.

    Args:
        data: the coded decisions.
        slots: each estimate's slow and fast probability and its uses, as rows; or their number,
            for even odds.
        weights: of the mixing.
        simples: each simple estimate's probability and uses, as rows; or their number.
    """

    def __init__(self, data: bytes | memoryview, slots: Any, weights: Any, simples: Any) -> None:
        self.range = RangeDecoder(data)
        slots = np.tile([32768, 32768, 0], (slots, 1)) if isinstance(slots, int) else slots
        simples = np.tile([32768, 0], (simples, 1)) if isinstance(simples, int) else simples
        self.slow, self.fast, self.uses = (slots[:, k].tolist() for k in range(3))
        self.weights: list[int] = np.asarray(weights).tolist()
        self.chance, self.seen = (simples[:, k].tolist() for k in range(2))

    def simple(self, number: int) -> int:
        """A decision by one simple estimate."""
        p, seen = self.chance[number], self.seen[number]
        bit = self.range.bit(clamp(p, 32, 65504))
        self.chance[number] = p + ((65535 * bit - p) * RATE[seen] >> 16)
        self.seen[number] = min(seen + 1, SIMPLE_USES)
        return bit

    def mixed(
        self,
        slots: Sequence[int],
        sets: Iterable[int],
        *,
        rate: int = 6,
        most_uses: int = 400,
        more: Sequence[int] = (),
    ) -> int:
        """A decision by several estimates.

        Args:
            slots: numbers of the estimates.
            sets: where the sets of weights begin; their sum counts.
            rate: rate at which weights learn, in 1/16.
            most_uses: uses that the slow probability counts.
            more: further inputs of the mixer.
        """
        inputs = [logit for slot in slots for logit in self._logits(slot)] + list(more)
        weights = self.weights
        total = 0
        for i, logit in enumerate(inputs):
            total += sum(weights[first + i] for first in sets) * logit >> 2
        p = squashed(total >> 12)
        bit = self.range.bit(p)
        error = (65535 * bit - p) * rate >> 4
        for i, logit in enumerate(inputs):
            change = (error * logit + 32768) >> 16
            for first in sets:
                weights[first + i] = clamp(weights[first + i] + change, -32767, 32767)
        for slot in slots:
            self._learn(slot, 65535 * bit, most_uses)
        return bit

    def _logits(self, slot: int) -> tuple[int, int]:
        slow, fast = STRETCH[self.slow[slot]], STRETCH[self.fast[slot]]
        trust = self.uses[slot] + 1
        if trust >= FULL_TRUST:
            return slow, fast
        return int(slow * trust / FULL_TRUST), int(fast * trust / FULL_TRUST)  # towards 0

    def _learn(self, slot: int, target: int, most_uses: int) -> None:
        uses = self.uses[slot]
        self.slow[slot] += (target - self.slow[slot]) * RATE[uses] >> 16
        self.fast[slot] += (target - self.fast[slot]) * RATE[min(uses, FAST_USES)] >> 16
        if uses < most_uses:
            self.uses[slot] = uses + 1
