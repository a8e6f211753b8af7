"""State of an adaptive coder, and the prior with which the coder of integers begins.

The prior (`prior.bin`) was learned from series other than those that are coded. The file is part
of the format: changing it makes existing streams unreadable, so another prior would be another file
and another number in the stream. It holds, deflated: for each slot of the coder its probability as
a logit in 8 bits and how far to trust it, the mixing weights, and the simple estimates.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

__all__ = [
    "CODERS",
    "State",
    "blank_state",
    "pack_linear",
    "pack_prior",
    "pack_signs",
    "pack_state",
    "prior_state",
    "unpack_signs",
    "unpack_state",
]

CODERS = ("contexts", "signs", "linear")
"""Models of the coefficients. All files before version 1.5 have "contexts": adaptive estimates by
contexts. "signs" adds linear predictors of signs; "linear" has these, and linear predictors of
magnitudes as well."""

DECISIONS = 16
"""Decisions of a magnitude, each with estimates and weights of its own."""
LANES = 12
"""Weights of a set: two per estimate."""
KINDS = 64
"""Kinds of bands."""
LEVELS = 128
"""Levels of the expected magnitude."""
SIZES = (LEVELS, KINDS * 64, 729, 12 * 12 * 12, 7 * 7 * 7 * 7, 12 * 12 * KINDS)
"""Contexts of a decision, for each of the six estimates that are mixed."""
SIGN_SIZES = (KINDS * 27, KINDS * 81, KINDS * 27)
"""Contexts of a sign, for each of the three estimates that are mixed."""
MORE_SIGN_SIZES = (KINDS * 108, KINDS * 27, KINDS * 81, KINDS * 54, KINDS * 25)
"""Contexts of the five further estimates of a sign of the coders that predict signs linearly."""
SIGN_SET = 24
"""Weights of a sign of these coders: two per estimate, then that of the linear logit."""
SIGN_INPUTS = 96
"""Weights of a linear predictor of signs, each with a mean square of its gradient."""
INPUTS = 64
"""Weights of a linear predictor of magnitudes, each with a mean square of its gradient."""
SET_CLASSES = (KINDS, 64, 343, 64 * 8)
"""Classes of each of the four sets of mixing weights of the linear coder."""
SETS = len(SET_CLASSES)
"""Sets of mixing weights of the linear coder."""
SET_NUMBERS = 17
"""Numbers of such a set: two weights per estimate, of the logit, of a constant, two 0; its uses."""
FIRST_SQUARE = 16
"""Mean square of a gradient before anything is known, 1 is 16384."""
BASE_WEIGHTS = (KINDS * DECISIONS + 64 * DECISIONS + KINDS) * LANES
"""Weights of the mixing by contexts alone, which come first."""
SLOTS = sum(SIZES) * DECISIONS + sum(SIGN_SIZES)
"""Estimates that are mixed by contexts alone."""
SIMPLES = LEVELS * 64 + 8 + KINDS
"""Simple estimates: of the escape code, of empty rows and of empty bands."""
TRUST = 12
"""Highest count in the prior; it is low, so that a tile soon follows its own statistics."""

SIGN_END = BASE_WEIGHTS + KINDS * (SIGN_SET + 2 * SIGN_INPUTS)
"""Numbers of the coder "signs" in `State.weights`; those of "linear" follow."""

_FILE = Path(__file__).with_name("prior.bin")
_SIGNS_FILE = Path(__file__).with_name("prior_signs.bin")
_LINEAR_FILE = Path(__file__).with_name("prior_linear.bin")


@dataclass(frozen=True, kw_only=True)
class State:
    """Estimates and weights that a coder adapts.

    Attributes:
        slots: uint16 (n, 4), the estimates that are mixed: probability by a slow and by a fast
            rate, number of observations, 0. Probabilities are in 1/65536.
        weights: int32 (n,), of the mixing.
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


def blank_state(coder: str = CODERS[0]) -> State:
    """A state that has learned nothing: even odds, and weights that believe the estimates."""
    slots, weights = (
        SLOTS,
        [
            (KINDS * DECISIONS * LANES, 4423),
            (64 * DECISIONS * LANES, 0),
            (KINDS * LANES, 4096),
        ],
    )
    if coder != CODERS[0]:
        slots += sum(MORE_SIGN_SIZES)
        weights += [(16, 2048), (1, 8192), (7, 0)] * KINDS
        weights += [(SIGN_INPUTS, 0), (SIGN_INPUTS, FIRST_SQUARE)] * KINDS
    if coder == "linear":
        weights += [(INPUTS, 0), (INPUTS, FIRST_SQUARE)] * (DECISIONS * KINDS)
        weights += [(12, 2731), (1, 8192), (4, 0)] * (DECISIONS * sum(SET_CLASSES))
        weights += [(SETS * DECISIONS * KINDS, 16384)]
    return State.even(slots=slots, weights=weights, simples=SIMPLES)


@cache
def prior_state(coder: str = CODERS[0], trellis: bool = False) -> State:
    """The prior of a coder of integers, or of indices of two quantisers; it is read-only."""
    if trellis:
        state = prior_state(coder).copy()
        _share(state)
    elif coder == CODERS[0]:
        state = unpack_state(zlib.decompress(_FILE.read_bytes()), blank_state())
        state.slots[:] = _reordered(state.slots, for_file=False)
    else:
        base = prior_state(CODERS[CODERS.index(coder) - 1])
        state = blank_state(coder)
        state.slots[: len(base.slots)] = base.slots
        state.weights[: len(base.weights)] = base.weights
        state.simples[:] = base.simples
        if coder == CODERS[1]:
            unpack_signs(_SIGNS_FILE.read_bytes(), state)
        else:
            state.weights[SIGN_END:] = _unpack_numbers(_LINEAR_FILE.read_bytes())
    return state.frozen()


def _share(state: State) -> None:
    """Begin the decisions of class 1 of two quantisers, 14 and 15, as those of class 0."""
    contexts = sum(SIZES) * DECISIONS
    slots = state.slots[:contexts].reshape(-1, DECISIONS, 4)
    slots[:, 14:] = slots[:, :2]
    weights = (KINDS + 64) * DECISIONS * LANES
    for sets in np.split(state.weights[:weights], [KINDS * DECISIONS * LANES]):
        by_decision = sets.reshape(DECISIONS, -1)
        by_decision[14:] = by_decision[:2]
    if len(state.weights) == SIGN_END:
        return
    sizes = [KINDS * 2 * INPUTS, *(classes * SET_NUMBERS for classes in SET_CLASSES), KINDS * SETS]
    for numbers in np.split(state.weights[SIGN_END:], DECISIONS * np.cumsum(sizes)[:-1]):
        by_decision = numbers.reshape(DECISIONS, -1)
        by_decision[14:] = by_decision[:2]


def pack_signs(state: State) -> bytes:
    """Bytes of what a learned state has beyond a blank one of "contexts" for signs, as a file.

    These are the further estimates, each as its logit plus 256 times its count; then the mixing
    weights of signs and their linear predictors.
    """
    slots = state.slots[SLOTS:]
    numbers = _logits(slots).astype(np.int32)
    numbers += 256 * np.minimum(slots[:, 2], TRUST).astype(np.int32)
    return _pack_numbers(np.concatenate([numbers, state.weights[BASE_WEIGHTS:SIGN_END]]))


def unpack_signs(data: bytes, state: State) -> None:
    """Fill a state from the bytes of `pack_signs`."""
    slots, weights = np.split(_unpack_numbers(data), [len(state.slots) - SLOTS])
    state.slots[SLOTS:, 0] = state.slots[SLOTS:, 1] = _PROBABILITIES[slots & 255]
    state.slots[SLOTS:, 2] = slots >> 8
    state.weights[BASE_WEIGHTS:SIGN_END] = weights


def pack_linear(state: State) -> bytes:
    """Bytes of what a learned state of "linear" has beyond one of "signs", as a file."""
    return _pack_numbers(state.weights[SIGN_END:])


def _pack_numbers(numbers: npt.NDArray[np.int32]) -> bytes:
    """Numbers from -2^23 to 2^23 - 1, deflated: all low bytes, all middle ones, all high ones."""
    planes = numbers.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3]
    return zlib.compress(np.ascontiguousarray(planes.T).tobytes(), 9)


def _unpack_numbers(data: bytes) -> npt.NDArray[np.int32]:
    planes = np.frombuffer(zlib.decompress(data), dtype=np.uint8).reshape(3, -1).astype(np.int32)
    numbers: npt.NDArray[np.int32]
    numbers = planes[0] | (planes[1] << 8) | (((planes[2] ^ 128) - 128) << 16)
    return numbers


def unpack_state(data: bytes, state: State) -> State:
    """`state`, after filling its arrays from bytes of `pack_state` for the same sizes."""
    slots, weights, simples = len(state.slots), len(state.weights), len(state.simples)
    lengths = [slots, slots, 2 * weights, 2 * simples, simples]
    logits, counts, mixing, chances, seen, _ = np.split(
        np.frombuffer(data, dtype=np.uint8), np.cumsum(lengths)
    )
    # Table look-ups of whole numbers, so that every machine has the same; 128 is even odds.
    state.slots[:, 0] = state.slots[:, 1] = _PROBABILITIES[logits]
    state.slots[:, 2] = counts
    state.weights[:] = mixing.view("<i2")
    state.simples[:, 0] = chances.view("<u2")
    state.simples[:, 1] = seen
    return state


def _probabilities() -> npt.NDArray[np.uint16]:
    """Probability in 1/65536 of each logit (i - 128) / 12, rounded."""
    return np.clip(
        np.floor(65536 / (1 + np.exp(-(np.arange(256) - 128) / 12)) + 0.5), 1, 65535
    ).astype(np.uint16)


_PROBABILITIES = _probabilities()


def pack_prior(state: State) -> bytes:
    """A learned state as the bytes of `prior.bin`."""
    slots = _reordered(state.slots, for_file=True)
    in_file = State(slots=slots, weights=state.weights, simples=state.simples)
    return zlib.compress(pack_state(in_file), 9)


def _reordered(slots: npt.NDArray[np.uint16], *, for_file: bool) -> npt.NDArray[np.uint16]:
    """Slots from the order of the file into that of the coder, or back with `for_file`.

    The file keeps the slots of a decision together, the coder those of a context.
    """
    result, at = slots.copy(), 0
    for size in SIZES:
        end = at + size * DECISIONS
        lengths = (size, DECISIONS) if for_file else (DECISIONS, size)
        result[at:end] = slots[at:end].reshape(*lengths, 4).swapaxes(0, 1).reshape(-1, 4)
        at = end
    return result


def _logits(slots: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint8]:
    """The nearest logit of each estimate; even odds where nothing was observed."""
    slow = slots[:, 0]
    upper = np.searchsorted(_PROBABILITIES, slow).clip(1, 255)
    below = _PROBABILITIES[upper - 1].astype(np.int32)
    above = _PROBABILITIES[upper].astype(np.int32)
    logits = np.where(slow - below < above - slow, upper - 1, upper).astype(np.uint8)
    logits[slots[:, 2] == 0] = 128
    return logits


def pack_state(state: State) -> bytes:
    """A learned state as bytes, not deflated: probabilities rounded, counts at most TRUST."""
    counts = np.minimum(state.slots[:, 2], TRUST).astype(np.uint8)
    logits = _logits(state.slots)
    sections = [
        logits,
        counts,
        state.weights.astype("<i2"),
        state.simples[:, 0].astype("<u2"),
        np.minimum(state.simples[:, 1], TRUST).astype(np.uint8),
    ]
    return b"".join(section.tobytes() for section in sections)
