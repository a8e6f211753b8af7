"""State of an adaptive coder, and the prior with which the coder of integers begins.

The prior (`prior.bin`) was learned from series other than those that are coded, so that small tiles
need not learn from nothing. The file is part of the format: another prior makes existing streams
unreadable. It holds what a learned state has beyond a blank one, in few bits (`unpack_state`).
Finer numbers were no better: on other series they saved 0.07 % of the bytes at most.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

__all__ = ["State", "blank_state", "prior_state", "unpack_state"]

DECISIONS = 16
"""Decisions of a magnitude, each with estimates and weights of its own."""
LANES = 8
"""Weights of a set: two per estimate."""
KINDS = 64
"""Kinds of bands."""
LEVELS = 128
"""Levels of the expected magnitude."""
SIZES = (LEVELS, 729, 12 * 12 * 12, 7 * 7 * 7 * 7)
"""Contexts of a decision, for each of the four estimates that are mixed."""
SIGN_SIZES = tuple(KINDS * size for size in (27, 108, 81, 25))
"""Contexts of a sign, for each of the four estimates that are mixed."""
SIGN_SET = 16
"""Weights of a sign: two per estimate, then that of the linear logit."""
SIGN_INPUTS = 96
"""Weights of a linear predictor of signs, each with a mean square of its gradient."""
FIRST_SQUARE = 16
"""Mean square of a gradient before anything is known, 1 is 16384."""
SIMPLES = LEVELS * 64 + 8 + KINDS
"""Simple estimates: of the escape code, of empty rows and of empty bands."""
TRUST = 12
"""Count of an estimate of a prior; it is low, so that a tile soon follows its own statistics."""
LOGITS = 44
"""Numbers of an estimate in a file of a prior."""
WEIGHT_STEP = 512
"""Unit of weights in a file of a prior, as differences from those of the blank state."""

_FILE = Path(__file__).with_name("prior.bin")


@dataclass(frozen=True, kw_only=True)
class State:
    """Estimates and weights that a coder adapts.

    Attributes:
        slots: uint16 (n, 4), the estimates that are mixed: probability by a slow and by a fast
            rate, number of observations, 0. Probabilities are in 1/65536.
        weights: int32 (n,), of the mixing and of linear predictors, within 16 bits.
        simples: uint16 (n, 2), estimates that are used alone: probability, number of observations.
    """

    slots: npt.NDArray[np.uint16]
    weights: npt.NDArray[np.int32]
    simples: npt.NDArray[np.uint16]

    @classmethod
    def even(cls, *, slots: int, weights: Sequence[tuple[int, int]], simples: int) -> State:
        """A state of even odds.

        Args:
            slots: number of slots.
            weights: runs of equal weights, each as its length and its value.
            simples: number of simple estimates.
        """
        counts, values = zip(*weights, strict=True)
        state = cls(
            slots=np.zeros((slots, 4), dtype=np.uint16),
            weights=np.repeat(np.array(values, dtype=np.int32), counts),
            simples=np.zeros((simples, 2), dtype=np.uint16),
        )
        state.slots[:, :2] = state.simples[:, 0] = 32768
        return state

    def copy(self) -> State:
        """A state with copies of the arrays."""
        return State(
            slots=self.slots.copy(), weights=self.weights.copy(), simples=self.simples.copy()
        )

    def frozen(self) -> State:
        """This state, after making its arrays read-only."""
        for array in (self.slots, self.weights, self.simples):
            array.setflags(write=False)
        return self


def blank_state() -> State:
    """A state that has learned nothing: even odds, and weights that believe the estimates."""
    weights = [(KINDS * DECISIONS * LANES, 4423), (64 * DECISIONS * LANES, 0)]
    weights += [(8, 2048), (1, 8192), (SIGN_SET - 9, 0)] * KINDS
    weights += [(SIGN_INPUTS, 0), (SIGN_INPUTS, FIRST_SQUARE)] * KINDS
    slots = sum(SIZES) * DECISIONS + sum(SIGN_SIZES)
    return State.even(slots=slots, weights=weights, simples=SIMPLES)


@cache
def prior_state(trellis: bool) -> State:
    """The prior of the coder of integers, or of those of two quantisers; it is read-only."""
    if not trellis:
        state = unpack_state(_FILE.read_bytes(), blank_state())
        squares = state.weights[-2 * KINDS * SIGN_INPUTS :].reshape(KINDS, 2, SIGN_INPUTS)[:, 1]
        # The file has the roots of mean squares.
        squares[:] = ((squares - FIRST_SQUARE) // WEIGHT_STEP) ** 2
        return state.frozen()
    state = prior_state(False).copy()
    # The decisions of class 1 of two quantisers, 14 and 15, begin as those of class 0.
    slots = state.slots[: sum(SIZES) * DECISIONS].reshape(-1, DECISIONS, 4)
    slots[:, 14:] = slots[:, :2]
    of_kinds = KINDS * DECISIONS * LANES
    for sets in (state.weights[:of_kinds], state.weights[of_kinds:][: 64 * DECISIONS * LANES]):
        by_decision = sets.reshape(DECISIONS, -1)
        by_decision[14:] = by_decision[:2]
    return state.frozen()


def unpack_state(data: bytes, blank: State) -> State:
    """A state from the bytes of a file.

    Args:
        data: deflated, a byte for each number: of the slots and then of the simple estimates n > 0
            for the logit (n - 22) / 2, seen TRUST times, and 0 for one that nothing is known of; of
            the weights the difference from the blank state, signed, in WEIGHT_STEP.
        blank: the state that has learned nothing.
    """
    state = blank.copy()
    ends = np.cumsum([len(state.slots), len(state.simples), len(state.weights)])
    slots, simples, steps, _ = np.split(np.frombuffer(zlib.decompress(data), np.uint8), ends)
    # Table look-ups of whole numbers, so that every machine has the same.
    state.slots[:, 0] = state.slots[:, 1] = _PROBABILITIES[slots]
    state.slots[:, 2] = TRUST * (slots > 0)
    state.simples[:, 0] = _PROBABILITIES[simples]
    state.simples[:, 1] = TRUST * (simples > 0)
    state.weights[:] += WEIGHT_STEP * steps.view(np.int8).astype(np.int32)
    return state


def _probabilities() -> npt.NDArray[np.uint16]:
    """Probability in 1/65536 of each number of a file, rounded; even odds for 0."""
    logits = (np.arange(LOGITS) - LOGITS // 2) / 2
    rounded = np.floor(65536 / (1 + np.exp(-logits)) + 0.5)
    rounded[0] = 32768
    return rounded.astype(np.uint16)


_PROBABILITIES = _probabilities()
