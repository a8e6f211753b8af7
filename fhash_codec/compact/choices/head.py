"""Choice of the trained head: it stays only where it makes a file of equal quality smaller."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from threading import Event
from typing import NamedTuple

from fhash_codec.compact.choices.head_prospects import (
    EFFORTS,
    HEAD_BYTES,
    TRIAL_BUDGET,
    TRIAL_HEAD,
    Budget,
    Shape,
    expected_gain,
    likely_heads,
)
from fhash_codec.compact.choices.head_samples import Pair
from fhash_codec.compact.choices.head_training import TrainedHead, train_head
from fhash_codec.compact.choices.octave import octave_gain
from fhash_codec.compact.choices.search import step_after_gain
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_codec.progress import Parts
from fhash_codec.stage_clock import skip, stage
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["HeadHistory", "choose_head", "training_pairs"]

HeadHistory = list[dict[str, float | None]]
"""Training of a head: `seconds`, `epoch` (training updates), `psnr` of held-out samples in dB.

`samples` is the number of voxels that it learns from, the same at each point.
"""
StepSearch = Callable[[TileSettings], tuple[TileSettings, Outcome]]
"""Search for the step that keeps the promise, from that of the settings on."""
MIN_GAIN = 0.02
"""Gain in dB of the quick trial on held-out samples below which no head will pay."""
TRAINING_VERTICES = 48 << 20
"""Vertices of the tiles that are learned from: what few tiles teach holds for them alone."""
NEAR_GAIN = 0.2
"""Gain in dB below which a head may be trained on the decoded values of its trial."""
UNUSUAL = 1.0
"""dB by which tiles may lose more or less than a head gains, before another step is looked for."""
FARTHEST = 2.0
"""Power of the usual factor of the step that is taken at most where tiles lose less."""
POINTLESS = 0.005
"""Share of the bytes that a head must cost before the step is searched: then it is left out."""
CLOSE = 0.004
"""Distance in dB from the PSNR that is searched for at which no further step is tried."""
MIN_BYTES = 900
"""Bytes of coded tiles below which a head cannot save what it takes.

The smallest head takes some 250 bytes with its history, and few save 30 % of the tiles.
"""


class _Candidate(NamedTuple):
    """A trained head, settings with it, and what the sample takes with these."""

    trained: TrainedHead
    settings: TileSettings
    outcome: Outcome


def choose_head(
    sample: Sample,
    settings: TileSettings,
    outcome: Outcome,
    coding: Coding,
    find_step: StepSearch,
    look: Callable[[TileSettings], Outcome],
    tried: list[Outcome],
    *,
    aim: float | None,
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
    look: codes the sample once, as that search does.
    tried: outcomes of that search without a head.
    aim: PSNR in dB that is searched for, at which sizes are compared; None for a bound, which all
        outcomes keep.
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
    octave = octave_gain(tried, data_range)
    shapes = likely_heads(outcome.size, expected_gain(trial.gain_db), octave, effort)
    if not shapes:
        gained = f"its trial gained {trial.gain_db:.2f} dB"
        skip("head", f"{gained}: no head would save what it takes itself")
        return settings, outcome, []
    why = f"at effort {effort}; its trial gained {trial.gain_db:.2f} dB"
    with stage("head", why):
        # A head is trained on what it will meet: coarser data, which it lifts to the promise.
        coarser = replace(settings, step=step_after_gain(settings.step, trial.gain_db))
        if aim is not None:
            lost = outcome.psnr(data_range) - look(coarser).psnr(data_range)
            coarser = _coarsened(settings, coarser, lost, trial.gain_db)
        if trial.gain_db > NEAR_GAIN or not sample.complete:
            pairs = training_pairs(sample.wider(TRAINING_VERTICES), coarser, coding)

        def train(shape: Shape, tell: Callable[[float], None]) -> TrainedHead | None:
            return training.run(pairs, coarser, shape, EFFORTS[effort].budget_of(shape), tell)

        heads = [head for head in _side_by_side(shapes, train, parts) if head is not None]
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
    if without.aim is None and len(trained) == 1:
        head, settings = trained[0]
        return _Candidate(head, *find_step(settings))
    candidates = [_Candidate(head, settings, look(settings)) for head, settings in trained]
    best = min(candidates, key=without.extra_bytes)
    if without.aim is None:
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
            "psnr": _finite(psnr_without + gain),
            "samples": trained.samples,
        }
        for seconds, update, gain in trained.history
    ]


def _side_by_side(
    shapes: Sequence[Shape],
    train: Callable[[Shape, Callable[[float], None]], TrainedHead | None],
    parts: Parts,
) -> list[TrainedHead | None]:
    """Train heads in threads: a training takes one processor.

    train: trains a head and tells the share that is done to its second argument.
    parts: progress of the planning.
    """
    shares, stopped = dict.fromkeys(shapes, 0.0), Event()

    def run(shape: Shape) -> TrainedHead | None:
        def tell(share: float) -> None:
            if stopped.is_set():
                raise CancelledError  # ends this thread where the other or the user stopped it
            shares[shape] = share

        trained = train(shape, tell)
        tell(1.0)
        return trained

    with ThreadPoolExecutor(2, thread_name_prefix="fhash-head") as workers:
        works = [workers.submit(run, shape) for shape in shapes]
        try:
            parts.wait(works, "training", lambda: sum(shares.values()) / len(shares))
            return [work.result() for work in works]
        finally:
            stopped.set()


def _finite(psnr: float) -> float | None:
    """Return a PSNR that the header can hold: None for that of values without an error."""
    return psnr if math.isfinite(psnr) else None


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
            rate=budget.rate,
            seed=self.seed,
            progress=progress,
        )
