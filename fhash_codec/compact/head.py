"""Choice of the head: whether it is worth its bytes, and its training in rounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Event
from typing import NamedTuple

from fhash_codec.compact.attempt import Attempt, HeadHistory, PlanTask
from fhash_codec.compact.goal import AIM, EXCHANGE, find_step, step_after_gain
from fhash_codec.compact.head_training import (
    Budget,
    Pair,
    Shape,
    TrainedHead,
    train_head,
)
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Coding, Outcome, measured, total
from fhash_codec.compact.transform import scale_of
from fhash_codec.progress import Parts, skip, stage
from fhash_formats.support.threads import at_most, usable_threads
from fhash_formats.transform.head import NeighbourHead
from fhash_formats.transform.tile import CodedTile
from fhash_formats.transform.tile_format import TileSettings
from fhash_formats.transform.values import cast

PERCEPTRON = Shape((12, 8), cross=False)
"""Head without a cross: where little is to be gained, its fewer weights may win."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Effort that is spent on the choice of a head."""

    candidates: int
    """Number of the first entries of GAIN_BY_WIDTHS that are considered; 0 for no cross."""
    budget: Budget | None
    """Training of a head with a cross; None for none."""
    perceptron: Budget
    """Training of the perceptron, whose updates cost a sixth."""

    def budget_of(self, shape: Shape) -> Budget:
        """Return the training of a head of a shape."""
        if not shape.cross:
            return self.perceptron
        assert self.budget is not None
        return self.budget


GAIN_BY_WIDTHS = {(3, 4): 0.67, (4, 8): 0.83, (8, 8): 1.0, (12, 12): 1.13, (14, 24): 1.22}
"""Gain in dB of a head with a cross by its widths, as a multiple of the gain of the trial head."""
EFFORTS = {
    5: Effort(
        candidates=0,
        budget=None,
        perceptron=Budget(updates=1000, samples=400_000, rate=3e-2),
    ),
    **{
        effort: Effort(
            candidates=candidates,
            budget=Budget(updates=updates, samples=400_000),
            perceptron=Budget(updates=2 * updates, samples=800_000),
        )
        for effort, candidates, updates in (
            *((6, 4, 5000), (7, 4, 8000)),
            *((8, 5, 12000), (9, 5, 20000)),
        )
    },
}
"""Effort spent on heads by the effort of the encoder; below 5 there is no head.

At 5 a cross is left out: it gains up to a fifth more, and takes six times as long.
"""
LEAST_GAIN = 0.1
"""Gain in dB of least squares below which no head is trained."""
GAIN_OF_HEAD = 1.6
"""Gain of a head as a multiple of that of least squares: 1.6 to 1.9 on three series."""
MAX_OF_TRIAL = 1.5
"""Largest gain of a perceptron as a multiple of that expected of the trial head."""
LIKELY_OF_TRIAL = (0.85, 1.1)
"""Such multiples that nearly all gains of perceptrons lie between."""
MOST_EXCESS = 6.0
"""dB above the promise that a head is credited with at most, since no such step was tried."""
AT_ONCE = 2
"""Heads that are trained side by side, at most."""
WEIGHT_BYTES = 0.7
"""Bytes that each weight of a head adds to the file."""
HEAD_BYTES = 60
"""Bytes that a head adds to the file besides its weights: its history and description."""
WEIGHT_TIME = 5e-6
"""Share of the file that each weight must save to pay for the decoding time it costs."""


def likely_heads(size: float, gain: float, octave: float, effort: Effort) -> list[Shape]:
    """Return the heads that are worth a training; none where none should save anything.

    That with a cross and the perceptron are both trained where nothing but a training says which of
    them saves more.

    size: bytes of the coded tiles.
    gain: expected gain in dB of a head with a cross of widths (8, 8).
    octave: dB that an octave of bytes buys.
    """
    if not effort.candidates:
        saves = _saved(PERCEPTRON, size, gain, octave)
        return [PERCEPTRON] if saves > 0 else []

    def saved(widths: tuple[int, int]) -> float:
        return _saved(Shape(widths, cross=True), size, GAIN_BY_WIDTHS[widths] * gain, octave)

    widths = max(list(GAIN_BY_WIDTHS)[: effort.candidates], key=saved)
    if saved(widths) <= 0:
        most = _saved(PERCEPTRON, size, MAX_OF_TRIAL * gain, octave)
        return [PERCEPTRON] if most > 0 else []
    with_cross = Shape(widths, cross=True)
    least, most = (_saved(PERCEPTRON, size, ratio * gain, octave) for ratio in LIKELY_OF_TRIAL)
    if least >= saved(widths):
        return [PERCEPTRON]
    return [with_cross] if most <= saved(widths) else [with_cross, PERCEPTRON]


def _saved(shape: Shape, size: float, gain: float, octave: float) -> float:
    """Return the bytes that a head of this gain in dB saves, less those that it takes."""
    share = 1 - 2 ** (-gain / octave) - WEIGHT_TIME * shape.weights
    return size * share - WEIGHT_BYTES * shape.weights - HEAD_BYTES


TRAINING_VERTICES = 24 << 20
"""Vertices of the tiles that are learned from: what few tiles teach holds for them alone."""


class ChosenHead(NamedTuple):
    """Settings with a head and their step, and what all tiles should take.

    They are without one where it does not pay; its training is told all the same.
    """

    settings: TileSettings
    outcome: Outcome
    history: HeadHistory


class _Candidate(NamedTuple):
    """A trained head, and what the tiles take with it at the step that it was trained for."""

    trained: TrainedHead
    outcome: Outcome

    @property
    def own_bytes(self) -> int:
        """Bytes that the head adds to the file."""
        return len(self.trained.head.to_bytes()) + HEAD_BYTES


def choose_head(task: PlanTask, attempt: Attempt, foretold: float) -> ChosenHead | None:
    """Return a head with the step that keeps the promise; None where none was trained.

    A head is trained on what it will meet, coarser data, which it lifts to the promise. Since it
    changes no stream, one coding tells what it gains.

    attempt: without a head; its sample is learned from.
    foretold: gain in dB of least squares.
    """
    goal, settings, spent = task.goal, attempt.settings, EFFORTS[task.config.effort]
    gain = GAIN_OF_HEAD * foretold
    shapes = likely_heads(attempt.outcome.size, gain, EXCHANGE, spent)
    if not shapes:
        skip("head", f"least squares gain {foretold:.2f} dB: no head would save enough")
        return None
    with stage("head", f"at effort {task.config.effort}; least squares gain {foretold:.2f} dB"):
        sample = attempt.sample.wider(TRAINING_VERTICES)
        coarser = replace(settings, step=_step_below(attempt, settings.step, gain))
        pairs = training_pairs(sample, coarser, attempt.coding)

        def train(shape: Shape, tell: Callable[[float], None]) -> TrainedHead | None:
            low, high, budget = settings.low, settings.high, spent.budget_of(shape)
            return train_head(pairs, low, high, shape, budget, seed=task.config.seed, progress=tell)

        heads = [head for head in _side_by_side(shapes, train, task.parts) if head is not None]
        if goal.psnr is None:
            return _at_bound(task, attempt, heads, coarser)
        # The run that the pairs are of, which is not done again.
        plain = sample.run(replace(coarser, mask=None), attempt.coding)
        found = [
            _Candidate(trained, _corrected(attempt, sample, pairs, trained.head))
            for trained in heads
        ]

        def extra(candidate: _Candidate) -> float:
            gain = candidate.outcome.psnr(goal.data_range) - plain.psnr(goal.data_range)
            return candidate.own_bytes + plain.size * (1 - 2 ** (gain / EXCHANGE))

        best = min(found, key=extra, default=None)
        if best is None:
            return None
        history = _history(best, goal.data_range)
        if extra(best) >= 0:
            return ChosenHead(settings, attempt.outcome, history)
        # Without an error left, the PSNR is infinite.
        more = min(best.outcome.psnr(goal.data_range) - goal.psnr - AIM, MOST_EXCESS)
        step = _step_below(attempt, coarser.step, more)
        size = round(plain.size * 2 ** (-more / EXCHANGE))
        return ChosenHead(
            replace(settings, head=best.trained.head, step=step),
            replace(attempt.outcome, size=size),
            history,
        )


def _step_below(attempt: Attempt, step: float, decibels: float) -> float:
    """Return the step whose PSNR without a head is lower than that of a step.

    Coefficients predict it, where there is a promised PSNR.
    """
    if attempt.magnitudes is None:
        return step_after_gain(step, decibels)
    error = attempt.magnitudes.error(step * scale_of(attempt.settings)) * 10 ** (decibels / 10)
    return attempt.magnitudes.step_of(error, attempt.settings)


def _corrected(
    attempt: Attempt, sample: Sample, pairs: Sequence[Pair], head: NeighbourHead
) -> Outcome:
    """Return the error of decoded tiles with a head."""
    outcomes = []
    for pair, tile in zip(pairs, sample.tiles, strict=True):
        values = cast(head.apply(pair.decoded), tile.values.dtype)
        coded = CodedTile(data=b"", decoded=values, nonzero=0)
        outcomes.append(measured(tile, coded, attempt.settings, attempt.coding))
    return total(outcomes, sample.weights)


def _at_bound(
    task: PlanTask, attempt: Attempt, heads: Sequence[TrainedHead], coarser: TileSettings
) -> ChosenHead | None:
    """Return the head of the fewest bytes under a bound, which all tiles keep at any step.

    Parts tell which step costs least.
    """
    assert attempt.parts is not None
    assert attempt.moved is not None
    coding, best, least = attempt.coding, None, attempt.outcome.size
    for trained in heads:
        of_parts = replace(coarser, head=trained.head, transform=attempt.moved.transform)
        found, _ = find_step(attempt.parts, of_parts, coding, task.goal, tries=3)
        settings = replace(found, transform=coarser.transform)
        outcome = attempt.sample.run(settings, task.goal.bounded(coding))
        candidate = _Candidate(trained, outcome)
        history = _history(candidate, task.goal.data_range)
        if outcome.size + candidate.own_bytes < least:
            least = outcome.size + candidate.own_bytes
            best = ChosenHead(settings, outcome, history)
        elif best is None:
            best = ChosenHead(attempt.settings, attempt.outcome, history)
    return best


def _history(candidate: _Candidate, data_range: float) -> HeadHistory:
    """Return the training of a candidate, as the file has it."""
    trained = candidate.trained
    psnr_without = candidate.outcome.psnr(data_range) - trained.gain_db
    return [
        {
            "seconds": seconds,
            "epoch": update,
            # The header holds no infinity: that of values without an error.
            "psnr": psnr if math.isfinite(psnr := psnr_without + gain) else None,
            "samples": trained.samples,
        }
        for seconds, update, gain in trained.history
    ]


def _side_by_side(
    shapes: Sequence[Shape],
    train: Callable[[Shape, Callable[[float], None]], TrainedHead | None],
    parts: Parts,
) -> list[TrainedHead | None]:
    """Train heads in threads, AT_ONCE at a time.

    train: trains a head and tells the share that is done to its second argument.
    parts: progress of the planning.
    """
    shares, stopped = dict.fromkeys(shapes, 0.0), Event()
    threads = max(1, usable_threads() // min(len(shapes), AT_ONCE))

    def run(shape: Shape) -> TrainedHead | None:
        def tell(share: float) -> None:
            if stopped.is_set():
                raise CancelledError  # ends this thread where the other or the user stopped it
            shares[shape] = share

        with at_most(threads):
            trained = train(shape, tell)
        tell(1.0)
        return trained

    with ThreadPoolExecutor(AT_ONCE, thread_name_prefix="fhash-head") as workers:
        works = [workers.submit(run, shape) for shape in shapes]
        try:
            parts.wait(works, "training", lambda: sum(shares.values()) / len(shares))
            return [work.result() for work in works]
        finally:
            stopped.set()


def training_pairs(sample: Sample, settings: TileSettings, coding: Coding) -> list[Pair]:
    """Return the tiles as they decode without a head, with their originals and masks."""
    decoded = sample.decoded(replace(settings, head=None, mask=None), coding)
    return [
        Pair(values, tile.values, tile.counted)
        for values, tile in zip(decoded, sample.tiles, strict=True)
    ]
