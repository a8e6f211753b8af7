"""What the coder believes before it has seen anything: `prior.bin`, learned from series other than the one that is coded.

The file is part of the format: changing it makes existing streams unreadable, so another prior would be another file and another number in
the stream. It holds, deflated: for each slot of the coder its probability as a logit in 8 bits and how far to trust it, the mixing
weights, and the simple estimates.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

__all__ = ["State", "blank_state", "pack_prior", "pack_state", "prior_state", "unpack_state"]

DECISIONS, LANES, KINDS, LEVELS = 16, 12, 64, 128
SIZES = (LEVELS, KINDS * 64, 729, 12 * 12 * 12, 7 * 7 * 7 * 7, 12 * 12 * KINDS)
"""Contexts of a decision, for each of the six estimates that are mixed."""
SIGN_SIZES = (KINDS * 27, KINDS * 81, KINDS * 27)
SLOTS = sum(SIZES) * DECISIONS + sum(SIGN_SIZES)
WEIGHTS = (KINDS * DECISIONS + 64 * DECISIONS + KINDS) * LANES
SIMPLES = LEVELS * 64 + 8 + KINDS
TRUST = 12
"""Highest count in the prior: little, so that a tile soon follows its own statistics."""

_FILE = Path(__file__).with_name("prior.bin")


@dataclass(frozen=True, kw_only=True)
class State:
    """What adapts: slots uint16 (n, 4) of (slow, fast, count, 0), weights int32, simples uint16 (n, 2) of (probability, count)."""

    slots: npt.NDArray[np.uint16]
    weights: npt.NDArray[np.int32]
    simples: npt.NDArray[np.uint16]

    @classmethod
    def even(cls, *, slots: int, weights: Sequence[tuple[int, int]], simples: int) -> State:
        """Nothing known: so many slots and simple estimates of even odds, and runs of (how many, equal to what) weights."""
        counts, values = zip(*weights, strict=True)
        state = cls(
            slots=np.zeros((slots, 4), dtype=np.uint16),
            weights=np.repeat(np.array(values, dtype=np.int32), counts),
            simples=np.zeros((simples, 2), dtype=np.uint16),
        )
        state.slots[:, :2] = state.simples[:, 0] = 32768
        return state

    def copy(self) -> State:
        """Arrays of its own."""
        return State(
            slots=self.slots.copy(), weights=self.weights.copy(), simples=self.simples.copy()
        )

    def frozen(self) -> State:
        """This state, its arrays read-only from now on."""
        for array in (self.slots, self.weights, self.simples):
            array.setflags(write=False)
        return self


def blank_state() -> State:
    """Nothing known: even odds, and weights that take the estimates at their word."""
    weights = [
        (KINDS * DECISIONS * LANES, 4423),
        (64 * DECISIONS * LANES, 0),
        (KINDS * LANES, 4096),
    ]
    return State.even(slots=SLOTS, weights=weights, simples=SIMPLES)


@cache
def prior_state() -> State:
    """The prior; its arrays are read-only."""
    state = unpack_state(zlib.decompress(_FILE.read_bytes()), blank_state())
    state.slots[:] = _turned(state.slots, back=False)
    return state.frozen()


def unpack_state(data: bytes, state: State) -> State:
    """`state`, its arrays filled with what `pack_state` made of one of the same sizes."""
    slots, weights, simples = len(state.slots), len(state.weights), len(state.simples)
    parts = np.split(
        np.frombuffer(data, dtype=np.uint8),
        np.cumsum([slots, slots, 2 * weights, 2 * simples, simples]),
    )
    # Whole numbers only, so that every machine has the same: 128 is even odds.
    state.slots[:, 0] = state.slots[:, 1] = _PROBABILITIES[parts[0]]
    state.slots[:, 2] = parts[1]
    state.weights[:] = parts[2].view("<i2")
    state.simples[:, 0] = parts[3].view("<u2")
    state.simples[:, 1] = parts[4]
    return state


def _probabilities() -> npt.NDArray[np.uint16]:
    """Probability in 1/65536 of each logit (i - 128) / 12, rounded."""
    return np.clip(
        np.floor(65536 / (1 + np.exp(-(np.arange(256) - 128) / 12)) + 0.5), 1, 65535
    ).astype(np.uint16)


_PROBABILITIES = _probabilities()


def pack_prior(state: State) -> bytes:
    """A learned state as the bytes of `prior.bin`."""
    turned = State(
        slots=_turned(state.slots, back=True), weights=state.weights, simples=state.simples
    )
    return zlib.compress(pack_state(turned), 9)


def _turned(slots: npt.NDArray[np.uint16], *, back: bool) -> npt.NDArray[np.uint16]:
    """Slots in the coder's order, those of a context together, from the order of the file, those of a decision together; or back."""
    result, at = slots.copy(), 0
    for size in SIZES:
        end = at + size * DECISIONS
        lengths = (size, DECISIONS) if back else (DECISIONS, size)
        result[at:end] = slots[at:end].reshape(*lengths, 4).swapaxes(0, 1).reshape(-1, 4)
        at = end
    return result


def pack_state(state: State) -> bytes:
    """A learned state as bytes, not deflated: rounded, and with little trust."""
    order = np.searchsorted(_PROBABILITIES, state.slots[:, 0]).clip(1, 255)
    below, above = (
        _PROBABILITIES[order - 1].astype(np.int32),
        _PROBABILITIES[order].astype(np.int32),
    )
    steps = np.where(
        state.slots[:, 0] - below < above - state.slots[:, 0], order - 1, order
    ).astype(np.uint8)
    counts = np.minimum(state.slots[:, 2], TRUST).astype(np.uint8)
    steps[counts == 0] = 128
    parts = [
        steps,
        counts,
        state.weights.astype("<i2"),
        state.simples[:, 0].astype("<u2"),
        np.minimum(state.simples[:, 1], TRUST).astype(np.uint8),
    ]
    return b"".join(part.tobytes() for part in parts)
