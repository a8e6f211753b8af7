"""Heads that are worth a training, by the gain of a quick trial and the bytes of the tiles."""

from __future__ import annotations

from dataclasses import dataclass

from fhash_formats.transform.head.inputs import CROSS, INPUTS

__all__ = [
    "EFFORTS",
    "HEAD_BYTES",
    "PERCEPTRON",
    "TRIAL_BUDGET",
    "TRIAL_HEAD",
    "Budget",
    "Effort",
    "Shape",
    "best_widths",
    "expected_gain",
    "likely_heads",
    "most_saved",
]


@dataclass(frozen=True)
class Shape:
    """Widths of the two hidden layers of a head, and whether it looks at the voxels of a cross."""

    widths: tuple[int, int]
    cross: bool

    @property
    def weights(self) -> int:
        """Number of weights, biases not included."""
        first, second = self.widths
        return INPUTS * first + self._seen * first * second + second

    @property
    def products(self) -> int:
        """Multiplications for a voxel in training."""
        first, second = self.widths
        return self._seen * (INPUTS * first + first * second) + second

    @property
    def _seen(self) -> int:
        """Voxels whose first layer the second layer sees."""
        return len(CROSS) if self.cross else 1


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Length of the training of a head."""

    updates: int
    """Number of training updates."""
    samples: int
    """Number of voxels that are learned from: what few teach, often repeated, holds for few."""
    rate: float = 1e-2
    """Highest learning rate. A short training gains as much as one of twice its length where it
    learns three times as fast; a long one does not."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Effort that is spent on the choice of a head."""

    candidates: int
    """Number of the first entries of GAIN_BY_WIDTHS that are considered."""
    budget: Budget
    """Training of a head with a cross."""
    perceptron: Budget
    """Training of the perceptron, whose updates cost a fifth."""

    def budget_of(self, shape: Shape) -> Budget:
        """Return the training of a head of a shape."""
        return self.budget if shape.cross else self.perceptron


GAIN_BY_WIDTHS = {(3, 4): 0.67, (4, 8): 0.83, (8, 8): 1.0, (12, 12): 1.13, (14, 24): 1.22}
"""Gain in dB of a head with a cross by its widths, as a multiple of the gain of the trial head."""
EFFORTS = {
    5: Effort(
        candidates=4,
        budget=Budget(updates=1300, samples=400_000, rate=3e-2),
        perceptron=Budget(updates=5200, samples=800_000),
    ),
    6: Effort(
        candidates=4,
        budget=Budget(updates=5000, samples=400_000),
        perceptron=Budget(updates=10000, samples=800_000),
    ),
    7: Effort(
        candidates=4,
        budget=Budget(updates=8000, samples=400_000),
        perceptron=Budget(updates=16000, samples=800_000),
    ),
    8: Effort(
        candidates=5,
        budget=Budget(updates=12000, samples=400_000),
        perceptron=Budget(updates=24000, samples=800_000),
    ),
    9: Effort(
        candidates=5,
        budget=Budget(updates=20000, samples=400_000),
        perceptron=Budget(updates=40000, samples=800_000),
    ),
}
"""Effort spent on heads by the effort of the encoder; below 5 there is no head."""
TRIAL_HEAD = Shape((8, 8), cross=True)
"""Head of the quick trial."""
TRIAL_BUDGET = Budget(updates=400, samples=160_000, rate=3e-2)
"""Training of the quick trial."""
PERCEPTRON = Shape((12, 8), cross=False)
"""Head that competes, too: where little is to be gained, its fewer weights may win."""
GAIN_FACTOR = 1.2
"""Gain of the full training as a multiple of the gain of the trial, roughly."""
GAIN_BESIDES = 0.02
"""Gain in dB of the full training besides that multiple."""
MAX_OF_TRIAL = 1.5
"""Largest gain of a perceptron as a multiple of that expected of the trial head."""
LIKELY_OF_TRIAL = (0.85, 1.1)
"""Such multiples that nearly all gains of perceptrons lie between."""
WEIGHT_BYTES = 0.7
"""Bytes that each weight of a head adds to the file."""
HEAD_BYTES = 60
"""Bytes that a head adds to the file besides its weights: its history and description."""
WEIGHT_TIME = 5e-6
"""Share of the file that each weight must save to pay for the decoding time it costs."""


def expected_gain(gain_of_trial: float) -> float:
    """Return the gain in dB that a full training of the trial head is expected to have."""
    return GAIN_FACTOR * gain_of_trial + GAIN_BESIDES


def likely_heads(size: float, gain: float, octave: float, effort: int) -> list[Shape]:
    """Return the heads that are worth a training; none where none should save anything.

    That with a cross and the perceptron are both trained where nothing but a training says which of
    them saves more.

    size: bytes of the coded tiles.
    gain: expected gain in dB of a head of the widths of the trial head.
    octave: dB that an octave of bytes buys.
    """
    widths = best_widths(size, gain, octave, effort)
    if widths is None:
        return [PERCEPTRON] if most_saved(size, gain, octave) > 0 else []
    with_cross = Shape(widths, cross=True)
    saved = _saved(with_cross, size, GAIN_BY_WIDTHS[widths] * gain, octave)
    least, most = (_saved(PERCEPTRON, size, ratio * gain, octave) for ratio in LIKELY_OF_TRIAL)
    if least >= saved:
        return [PERCEPTRON]
    return [with_cross] if most <= saved else [with_cross, PERCEPTRON]


def best_widths(size: float, gain: float, octave: float, effort: int) -> tuple[int, int] | None:
    """Return the widths of the head with a cross that should save most; None if none should.

    The parameters are those of `likely_heads`.
    """

    def saved(widths: tuple[int, int]) -> float:
        return _saved(Shape(widths, cross=True), size, GAIN_BY_WIDTHS[widths] * gain, octave)

    best = max(list(GAIN_BY_WIDTHS)[: EFFORTS[effort].candidates], key=saved)
    return best if saved(best) > 0 else None


def most_saved(size: float, gain: float, octave: float) -> float:
    """Return the bytes that a perceptron saves at most, less those that it takes.

    The parameters are those of `likely_heads`.
    """
    return _saved(PERCEPTRON, size, MAX_OF_TRIAL * gain, octave)


def _saved(shape: Shape, size: float, gain: float, octave: float) -> float:
    """Return the bytes that a head of this gain in dB saves, less those that it takes."""
    share = 1 - 2 ** (-gain / octave) - WEIGHT_TIME * shape.weights
    return size * share - WEIGHT_BYTES * shape.weights - HEAD_BYTES
