"""Choice of the head: whether it is worth its bytes, and its training in rounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Event
from typing import NamedTuple

from fhash_codec.compact.attempt import Attempt, HeadHistory, PlanTask
from fhash_codec.compact.goal import EXCHANGE, STEP_AIM, step_after_gain
from fhash_codec.compact.head_training import (
    Budget,
    Pair,
    Shape,
    TrainedHead,
    train_head,
)
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Coding, Outcome
from fhash_codec.progress import Parts, skip, stage
from fhash_formats.support.threads import at_most, usable_threads
from fhash_formats.transform.tile_format import TileSettings

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


StepSearch = Callable[[TileSettings], tuple[TileSettings, Outcome]]
"""Search for the step that keeps the promise, from that of the settings on."""
TRAINING_VERTICES = 48 << 20
"""Vertices of the tiles that are learned from: what few tiles teach holds for them alone."""
UNUSUAL = 1.0
"""dB by which tiles may lose more or less than a head gains, before another step is looked for."""
FARTHEST = 2.0
"""Power of the usual factor of the step that is taken at most where tiles lose less."""
POINTLESS = 0.005
"""Share of the bytes that a head must cost before the step is searched: then it is left out."""
LEAST_OCTAVE = 2.0
"""Fewest dB that an octave of bytes is believed to buy."""
MOST_OCTAVE = 12.0
"""Most dB that it is believed to buy."""
CLOSE = 0.004
"""Distance in dB from the PSNR that is searched for at which no further step is tried."""


class _Candidate(NamedTuple):
    """A trained head, settings with it, and what the sample takes with these."""

    trained: TrainedHead
    settings: TileSettings
    outcome: Outcome


def choose_head(
    task: PlanTask,
    attempt: Attempt,
    foretold: float,
    find_step: StepSearch,
    look: Callable[[TileSettings], Outcome],
) -> tuple[TileSettings, Outcome, HeadHistory]:
    """Return settings with a head and a larger step if they make the sample smaller.

    Otherwise the settings and their outcome are returned as they are. The last result is the
    training history of the best head, empty if none was trained.

    attempt: without a head.
    foretold: gain in dB of least squares.
    find_step: search for the step that keeps the promise with a head.
    look: codes the sample once, as that search does.
    """
    sample, settings, outcome = attempt.sample, attempt.settings, attempt.outcome
    data_range, spent = task.goal.data_range, EFFORTS[task.config.effort]
    # Sizes are compared at a PSNR; under a bound, which all outcomes keep, as they are.
    aim = None if task.goal.psnr is None else task.goal.psnr + STEP_AIM

    def train(shape: Shape, budget: Budget, tell: Callable[[float], None]) -> TrainedHead | None:
        low, high, seed = settings.low, settings.high, task.config.seed
        return train_head(pairs, low, high, shape, budget, seed=seed, progress=tell)

    gain = GAIN_OF_HEAD * foretold
    shapes = likely_heads(outcome.size, gain, EXCHANGE, spent)
    if not shapes:
        skip("head", f"least squares gain {foretold:.2f} dB: no head would save enough")
        return settings, outcome, []
    why = f"at effort {task.config.effort}; least squares gain {foretold:.2f} dB"
    with stage("head", why):
        # A head is trained on what it will meet: coarser data, which it lifts to the promise.
        coarser, octave = replace(settings, step=step_after_gain(settings.step, gain)), EXCHANGE
        if aim is not None:
            other = look(coarser)
            lost = outcome.psnr(data_range) - other.psnr(data_range)
            if lost > 0 and outcome.size > other.size:
                octave = lost / math.log2(outcome.size / max(other.size, 1))
                octave = min(max(octave, LEAST_OCTAVE), MOST_OCTAVE)
            coarser = _coarsened(settings, coarser, lost, gain)
        pairs = training_pairs(sample.wider(TRAINING_VERTICES), coarser, attempt.coding)

        def train_fully(shape: Shape, tell: Callable[[float], None]) -> TrainedHead | None:
            return train(shape, spent.budget_of(shape), tell)

        trained = _side_by_side(shapes, train_fully, task.parts)
        heads = [head for head in trained if head is not None]
        without = _Compared(outcome, octave, aim, data_range)
        best = _searched(without, [(head, coarser) for head in heads], find_step, look)
    if best is None:
        return settings, outcome, []
    history = _history(best, data_range)
    if without.extra_bytes(best) < 0:
        return best.settings, best.outcome, history
    return settings, outcome, history


def _coarsened(
    settings: TileSettings, coarser: TileSettings, lost: float, gain: float
) -> TileSettings:
    """Return settings of a step at which tiles lose about the dB that a head gains.

    Where most vertices lie on a plateau, tiles lose them much faster than usual.

    coarser: settings of a step at which they lose `lost` dB.
    """
    if abs(lost - gain) < UNUSUAL:
        return coarser
    share = gain / max(lost, gain / FARTHEST)
    return replace(settings, step=settings.step * (coarser.step / settings.step) ** share)


@dataclass(frozen=True)
class _Compared:
    """Comparison of candidates with the tiles without a head."""

    outcome: Outcome
    """Outcome without a head."""
    octave: float
    """dB that an octave of bytes buys."""
    aim: float | None
    """PSNR in dB that is searched for; None for a bound, which all outcomes keep."""
    data_range: float
    """Range of the values, in data units."""

    def missing(self, candidate: _Candidate) -> float:
        """Return the dB that a candidate is worse than the tiles without a head."""
        return self.outcome.psnr(self.data_range) - candidate.outcome.psnr(self.data_range)

    def extra_bytes(self, candidate: _Candidate) -> float:
        """Return the bytes more than without a head, at the same quality."""
        size = candidate.outcome.size
        own_bytes = len(candidate.trained.head.to_bytes()) + HEAD_BYTES
        extra: float = size - self.outcome.size + own_bytes
        if self.aim is None:
            return extra
        return extra + self.outcome.size * (2 ** (self.missing(candidate) / self.octave) - 1)


def _searched(
    without: _Compared,
    heads: Sequence[tuple[TrainedHead, TileSettings]],
    find_step: StepSearch,
    look: Callable[[TileSettings], Outcome],
) -> _Candidate | None:
    """Return the best of some heads with the step that keeps the promise; None of none.

    They are compared at one step, and the step is searched for the best of them alone. It is not
    where the head would not pay in any case.

    heads: trained heads, each with the settings that it was trained for.
    """
    if not heads:
        return None
    trained = [(head, replace(settings, head=head.head)) for head, settings in heads]
    candidates = [_Candidate(head, settings, look(settings)) for head, settings in trained]
    best = min(candidates, key=without.extra_bytes)
    if without.aim is None:
        if without.extra_bytes(best) > POINTLESS * without.outcome.size:
            return best
        return _Candidate(best.trained, *find_step(best.settings))
    missing = without.aim - best.outcome.psnr(without.data_range)
    if abs(missing) < CLOSE or without.extra_bytes(best) > POINTLESS * without.outcome.size:
        return best
    nearer = replace(best.settings, step=step_after_gain(best.settings.step, -missing))
    return _Candidate(best.trained, *find_step(nearer))


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
