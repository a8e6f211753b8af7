"""Choice of the trained head: it stays only where it makes a file of equal quality smaller."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from threading import Event
from typing import NamedTuple

from fhash_codec.compact.choices.head_samples import Pair
from fhash_codec.compact.choices.head_training import TrainedHead, train_head
from fhash_codec.compact.choices.search import EXCHANGE, SLOPE, exchange
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_codec.progress import Parts
from fhash_codec.stage_clock import skip, stage
from fhash_formats.container.table_parts import APART_BYTES
from fhash_formats.transform.head.inputs import CROSS, INPUTS
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["HeadHistory", "best_widths", "choose_head", "most_saved", "octave", "training_pairs"]

HeadHistory = list[dict[str, float | None]]
"""Training of a head: `seconds`, `epoch` (training updates), `psnr` of held-out samples in dB.

`samples` is the number of voxels that it learns from, the same at each point.
"""
StepSearch = Callable[[TileSettings, list[Outcome]], tuple[TileSettings, Outcome]]
"""Search for the step that keeps the promise; it appends all outcomes on the way to the list."""


@dataclass(frozen=True)
class Shape:
    """Widths of the two hidden layers of a head, and whether it looks at the voxels of a cross."""

    widths: tuple[int, int]
    cross: bool


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Length of the training of a head."""

    updates: int
    """Number of training updates."""
    samples: int
    """Number of voxels that are learned from: what few teach, often repeated, holds for few."""

    def times(self, factor: int) -> Budget:
        """Return a training so many times as long, with so many times as many voxels."""
        return Budget(updates=self.updates * factor, samples=self.samples * factor)


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Effort that is spent on the choice of a head."""

    candidates: int
    """Number of the first entries of GAIN_BY_WIDTHS that are considered."""
    budget: Budget
    """Training of a head."""


GAIN_BY_WIDTHS = {(3, 4): 0.67, (4, 8): 0.83, (8, 8): 1.0, (12, 12): 1.13, (14, 24): 1.22}
"""Gain in dB of a head with a cross by its widths, as a multiple of the gain of the trial head."""
EFFORTS = {
    5: Effort(candidates=4, budget=Budget(updates=2600, samples=400_000)),
    6: Effort(candidates=4, budget=Budget(updates=5000, samples=400_000)),
    7: Effort(candidates=4, budget=Budget(updates=8000, samples=400_000)),
    8: Effort(candidates=5, budget=Budget(updates=12000, samples=400_000)),
    9: Effort(candidates=5, budget=Budget(updates=20000, samples=400_000)),
}
"""Effort spent on heads by the effort of the encoder; below 5 there is no head."""
TRIAL_HEAD = Shape((8, 8), cross=True)
"""Head of the quick trial."""
TRIAL_BUDGET = Budget(updates=800, samples=160_000)
"""Training of the quick trial."""
PERCEPTRON = Shape((12, 8), cross=False)
"""Head that competes, too: where little is to be gained, its fewer weights may win."""
PERCEPTRON_LONGER = 2
"""Factor of the training of the perceptron, whose updates cost less."""
MIN_GAIN = 0.02
"""Gain in dB of the quick trial on held-out samples below which no head will pay."""
GAIN_FACTOR = 1.2
"""Gain of the full training as a multiple of the gain of the trial, roughly."""
GAIN_BESIDES = 0.02
"""Gain in dB of the full training besides that multiple."""
MAX_OF_TRIAL = 1.5
"""Largest gain of a perceptron as a multiple of that expected of the trial head."""
WEIGHT_BYTES = 0.7
"""Bytes that each weight of a head adds to the file."""
ARRAY_BYTES = 540
"""Bytes that describe the array of a head: two documents and three places of a ZIP. In a small file
there is none."""
HISTORY_BYTES = 60
"""Bytes of the training history and of the description of a head in the file."""
WEIGHT_TIME = 5e-6
"""Share of the file that each weight must save to pay for the decoding time it costs."""
TRAINING_VERTICES = 48 << 20
"""Vertices of the tiles that are learned from: what few tiles teach holds for them alone."""
MIN_BYTES = 900
"""Bytes of coded tiles below which a head cannot save what it takes.

The smallest head takes some 250 bytes with its history, and few save 30 % of the tiles.
"""


class _Candidate(NamedTuple):
    """A trained head, the step that keeps the promise with it, and the search for that step."""

    trained: TrainedHead
    settings: TileSettings
    outcome: Outcome
    tried: list[Outcome]


def choose_head(
    sample: Sample,
    settings: TileSettings,
    outcome: Outcome,
    coding: Coding,
    find_step: StepSearch,
    tried: list[Outcome],
    *,
    strict: bool,
    data_range: float,
    effort: int,
    seed: int,
    parts: Parts | None = None,
) -> tuple[TileSettings, Outcome, HeadHistory]:
    """Return settings with a head and a larger step if they make the sample smaller.

    Otherwise the settings and their outcome are returned as they are. The last result is the
    training history of the best head, empty if none was trained.

    outcome: outcome of the settings, without a head.
    coding: coding without a bound, for the values that a head is trained on.
    find_step: search for the step that keeps the promise with a head.
    tried: outcomes of that search without a head.
    strict: whether the promise is a bound, which all outcomes keep; else sizes are compared at
        the same PSNR.
    data_range: range of the values, in data units.
    parts: progress of the planning, which is told about the training.
    """
    if outcome.size < MIN_BYTES:
        skip("head", f"tiles of {outcome.size} bytes: no head saves what it takes itself")
        return settings, outcome, []
    training = _Training(seed=seed)
    parts = parts or Parts()
    tell = partial(parts.report, "training")
    with stage("head trial", "gain of a quick training, by which heads are chosen"):
        pairs = training_pairs(sample, settings, coding)
        trial = training.run(pairs, settings, TRIAL_HEAD, TRIAL_BUDGET, tell)
    if trial is None or trial.gain_db < MIN_GAIN:
        skip("head", "its trial gains nothing")
        return settings, outcome, []
    gain = GAIN_FACTOR * trial.gain_db + GAIN_BESIDES
    widths = best_widths(outcome.size, gain, octave(tried, data_range), effort)
    most = most_saved(outcome.size, gain, octave(tried, data_range))
    if widths is None and most <= 0:
        gained = f"its trial gained {trial.gain_db:.2f} dB"
        skip("head", f"{gained}: no head would save what it takes itself")
        return settings, outcome, []
    # A head is trained on what it will meet: coarser data, which it lifts to the quality asked for.
    coarser = replace(settings, step=settings.step * math.exp(trial.gain_db / SLOPE))
    why = f"at effort {effort}; its trial gained {trial.gain_db:.2f} dB"
    with stage("head", why):
        pairs = training_pairs(sample.wider(TRAINING_VERTICES), coarser, coding)
    budget = EFFORTS[effort].budget

    def train(shape: Shape, tell: Callable[[float], None]) -> _Candidate | None:
        factor = 1 if shape.cross else PERCEPTRON_LONGER
        trained = training.run(pairs, coarser, shape, budget.times(factor), tell)
        tell(1.0)
        if trained is None:
            return None
        tried_with_head: list[Outcome] = []
        with_head = replace(coarser, head=trained.head)
        settings_with_head, outcome_with_head = find_step(with_head, tried_with_head)
        return _Candidate(trained, settings_with_head, outcome_with_head, tried_with_head)

    shapes = [Shape(widths, cross=True), PERCEPTRON] if widths else [PERCEPTRON]
    with stage("head", why):
        trained_heads = _side_by_side(shapes, train, parts)
    candidates = [candidate for candidate in trained_heads if candidate is not None]
    return _cheapest(settings, outcome, candidates, strict=strict, data_range=data_range)


def _side_by_side(
    shapes: Sequence[Shape],
    train: Callable[[Shape, Callable[[float], None]], _Candidate | None],
    parts: Parts,
) -> list[_Candidate | None]:
    """Train heads in threads: a training takes one processor, and so does coding a single tile.

    train: trains a head and tells the share that is done to its second argument.
    parts: progress of the planning.
    """
    shares, stopped = dict.fromkeys(shapes, 0.0), Event()

    def run(shape: Shape) -> _Candidate | None:
        def tell(share: float) -> None:
            if stopped.is_set():
                raise CancelledError  # ends this thread where the other or the user stopped it
            shares[shape] = share

        return train(shape, tell)

    with ThreadPoolExecutor(2, thread_name_prefix="fhash-head") as workers:
        works = [workers.submit(run, shape) for shape in shapes]
        try:
            parts.wait(works, "training", lambda: sum(shares.values()) / len(shares))
            return [work.result() for work in works]
        finally:
            stopped.set()


def _cheapest(
    settings: TileSettings,
    outcome: Outcome,
    candidates: Sequence[_Candidate],
    *,
    strict: bool,
    data_range: float,
) -> tuple[TileSettings, Outcome, HeadHistory]:
    """Return the cheapest of the settings without a head and of the candidates."""
    best, lowest_cost, history = (settings, outcome), 0.0, HeadHistory()
    for candidate in candidates:
        psnr = candidate.outcome.psnr(data_range)
        # Bytes more than without a head.
        cost: float = (
            candidate.outcome.size
            - outcome.size
            + len(candidate.trained.head.to_bytes())
            + head_bytes(candidate.outcome.size)
        )
        if not strict:
            # The rest of the difference in quality between the two searches, in bytes.
            missing = outcome.psnr(data_range) - psnr
            cost += outcome.size * (2 ** (missing / octave(candidate.tried, data_range)) - 1)
        if cost < lowest_cost or not history:
            psnr_without = psnr - candidate.trained.gain_db
            history = [
                {
                    "seconds": seconds,
                    "epoch": update,
                    "psnr": _finite(psnr_without + gain),
                    "samples": candidate.trained.samples,
                }
                for seconds, update, gain in candidate.trained.history
            ]
        if cost < lowest_cost:
            best, lowest_cost = (candidate.settings, candidate.outcome), cost
    return *best, history


def _finite(psnr: float) -> float | None:
    """Return a PSNR that the header can hold: None for that of values without an error."""
    return psnr if math.isfinite(psnr) else None


def octave(tried: list[Outcome], data_range: float) -> float:
    """Return the dB that an octave of bytes buys."""
    points = [
        (math.log2(outcome.size), outcome.psnr(data_range)) for outcome in tried if outcome.size
    ]
    return exchange(points, EXCHANGE)


def head_bytes(size: float) -> float:
    """Return the bytes that a head adds to the file besides its weights.

    size: bytes of the coded tiles.
    """
    return HISTORY_BYTES + (ARRAY_BYTES if size >= APART_BYTES else 0)


def best_widths(size: float, gain: float, octave: float, effort: int) -> tuple[int, int] | None:
    """Return the widths of the head with a cross that should save most; None if none should.

    size: bytes of the coded tiles.
    gain: expected gain in dB of a head of the widths of the trial head.
    octave: dB that an octave of bytes buys.
    """

    def saved(widths: tuple[int, int]) -> float:
        first, second = widths
        weights = INPUTS * first + len(CROSS) * first * second + second
        return (
            size * (1 - 2 ** (-GAIN_BY_WIDTHS[widths] * gain / octave) - WEIGHT_TIME * weights)
            - WEIGHT_BYTES * weights
            - head_bytes(size)
        )

    best = max(list(GAIN_BY_WIDTHS)[: EFFORTS[effort].candidates], key=saved)
    return best if saved(best) > 0 else None


def most_saved(size: float, gain: float, octave: float) -> float:
    """Return the bytes that a perceptron saves at most, less those that it takes.

    The parameters are those of `best_widths`.
    """
    first, second = PERCEPTRON.widths
    weights = INPUTS * first + first * second + second
    share = 1 - 2 ** (-MAX_OF_TRIAL * gain / octave)
    return size * share - WEIGHT_BYTES * weights - head_bytes(size)


def training_pairs(sample: Sample, settings: TileSettings, coding: Coding) -> list[Pair]:
    """Return the tiles as they decode without a head, with their originals and masks."""
    decoded = sample.decoded(replace(settings, head=None, mask=None), coding)
    return [
        Pair(values, tile.values, tile.counted)
        for values, tile in zip(decoded, sample.tiles, strict=True)
    ]


@dataclass(frozen=True, kw_only=True)
class _Training:
    """Training of heads: the part of its options that is the same for all heads."""

    seed: int

    def run(
        self,
        pairs: Sequence[Pair],
        settings: TileSettings,
        shape: Shape,
        budget: Budget,
        progress: Callable[[float], None],
    ) -> TrainedHead | None:
        """Train a head; None where there is nothing to learn.

        progress: called with the share of the training that is done.
        """
        return train_head(
            pairs,
            low=settings.low,
            high=settings.high,
            hidden=shape.widths,
            cross=shape.cross,
            updates=budget.updates,
            samples=budget.samples,
            seed=self.seed,
            progress=progress,
        )
