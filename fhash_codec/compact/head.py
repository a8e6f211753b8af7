"""Joint training of the table and of the MLP behind it: whether, how long, and what it saves.

The MLP (`NeighbourHead`) learns what coded values lack; the values are then coded less by what it
adds, it learns from these, and so on. The pass that saves most is kept, or none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import prod
from typing import NamedTuple

import numpy as np

from fhash_codec.compact.attempt import Attempt, HeadHistory, PlanTask
from fhash_codec.compact.goal import MAX_SLOPE, MIN_SLOPE, find_step, step_after_gain
from fhash_codec.compact.head_device import learner_on
from fhash_codec.compact.head_training import (
    BATCH_VOXELS,
    Budget,
    Pair,
    TrainedHead,
    train_head,
    weights_of,
)
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Coding, Outcome, Tile, measured, total
from fhash_codec.compact.transform import scale_of
from fhash_codec.config import EncodeConfig
from fhash_codec.progress import stage
from fhash_formats.support.values import Single
from fhash_formats.transform.head import NeighbourHead
from fhash_formats.transform.tile import CodedTile, encode_tile
from fhash_formats.transform.tile_format import TileSettings
from fhash_formats.transform.values import cast

GAIN_BY_WIDTHS = {(12, 8): 1.0, (24, 16): 1.2, (48, 16): 1.35}
"""Gain in dB of an MLP by the widths of its hidden layers, as a multiple of that of the first."""
MOST_WIDTHS = {"fast": 1, "balanced": 2, "small": 3}
"""Number of these that are considered, by the access.

Decoding takes 5, 13 and 25 ns more for each vertex (AVX-512; 8, 20 and 45 with AVX2), where SPERR
takes some 40.
"""
LEAST_GAIN = 0.2
"""Gain in dB of least squares below which nothing is trained: up to 0.15 a training saved up to 4 %
in twice the seconds, from 0.22 on 9 to 40 %."""
MORE_AT_BOUND = 1.5
"""Factor of it under a bound, which leaves less to save: nothing at 0.21."""
GAIN_OF_MLP = 1.6
"""Gain of the narrowest as a multiple of that of least squares: 1.6 to 1.9 on three series."""
MOST_EXCESS = 6.0
"""dB above the promise that an MLP is credited with at most, since no such step was tried."""
MLP_BYTES = 110
"""Bytes of an MLP in the deflated header without its numbers: 465 in all of 440 weights and 21
biases on the vortex."""
WEIGHT_BYTES = 0.6875
"""Bytes of a weight there, a letter of a Huffman code: 5 to 6 bits."""
BIAS_BYTES = 2.5
"""The same of a bias, up to four characters and a comma."""
TRAINING_NS = 0.12
"""Nanoseconds of a product in training."""
JOINT = 1.2
"""Part of the MLP's correction that values are coded less by: it counts on what it has yet to
learn. 1 saves up to 1 % less, 1.5 diverges in the third pass."""
PASSES = 2
"""Trainings, each on what the one before left; a third saves another 1 % of the bytes."""
LONG = 2
"""Trainings of more than so many times UPDATES have a third pass."""
AGAIN = 0.3
"""Updates of each further training, as a share of those of the first."""
UPDATES = 600
"""Updates of the first training at effort 5; twice as many at each further effort."""
VERTICES_OF_UPDATE = 1500
"""Vertices of a series for each of these updates, at least: a short series trains shortly."""
LEAST_UPDATES = 300
"""Updates of the first training at least: fewer teach nothing."""
TRIED = 1 << 20
"""Vertices of the tiles that are coded with steps under a bound, unless one has more."""
SAMPLES = 200_000
"""Vertices that are learned from at least: what few teach, often repeated, holds for few."""
SAMPLES_OF_UPDATE = 333
"""Vertices that are learned from for each update of the first training."""
MOST_SAMPLES = 2_000_000
"""Vertices that are learned from at most: each takes some 80 bytes of memory."""
RATE = 3e-2
"""Highest learning rate of a first training of up to UPDATES; that of a longer one falls as the
root of its length, or it diverges."""
RATE_AGAIN = 1e-2
"""Highest learning rate of further trainings."""
MOST_AHEAD = 1.2
"""Factor of the steps of two passes that is believed at most."""
LEFT = 0.97
"""Share of the bytes that an MLP leaves at most, by default: every reader pays for it."""
AIM_OF_MLP = 0.06
"""dB above the promise that a step is for: half of the steps would miss it else."""
FAR = 0.4
"""dB from the promise from which on the next pass is coded with another step."""
OCTAVE = 8.5
"""dB that an octave of bytes buys where an MLP saves some: 8 to 9.6 on four series, of few bits."""

Widths = tuple[int, int]


def likely_widths(size: float, gain: float, access: str) -> Widths:
    """Return the widths that should save the most bytes.

    size: bytes of the coded tiles.
    gain: expected gain in dB of the first of `GAIN_BY_WIDTHS`.
    access: a name of `MOST_WIDTHS`.
    """

    def saved(of: Widths) -> float:
        share = 1 - 2 ** (-GAIN_BY_WIDTHS[of] * gain / OCTAVE)
        return size * share - WEIGHT_BYTES * weights_of(of)

    return max(list(GAIN_BY_WIDTHS)[: MOST_WIDTHS[access]], key=saved)


def least_gain(task: PlanTask) -> float:
    """Return the gain in dB of least squares below which nothing is trained.

    For the fewest bytes a training is worth its seconds for less, and one that is asked for is
    made.
    """
    if task.config.train != "auto":
        return -math.inf
    least = LEAST_GAIN * (MORE_AT_BOUND if task.goal.psnr is None else 1.0)
    return least / 2 if task.config.access == "small" else least


def expected_share(foretold: float) -> float:
    """Return the bytes with an MLP as a multiple of those without.

    foretold: gain in dB of least squares.
    """
    return float(2 ** (-GAIN_OF_MLP * GAIN_BY_WIDTHS[24, 16] * foretold / OCTAVE))


def most_left(task: PlanTask) -> float:
    """Return the share of the bytes that an MLP may leave so that it is kept.

    Who asks for a training, or for the fewest bytes at any cost, reads more slowly for any of them.
    """
    config = task.config
    return 1.0 if config.access == "small" or config.train != "auto" else LEFT


class ChosenHead(NamedTuple):
    """Settings and coding with an MLP, and what all tiles should take.

    They are without one where it does not pay; its training is told all the same.
    """

    settings: TileSettings
    coding: Coding
    outcome: Outcome
    history: HeadHistory


class _Pass(NamedTuple):
    """An MLP, and what tiles of a sample take that were coded jointly with it."""

    trained: TrainedHead
    psnr: float
    """PSNR of the sample in dB."""
    step: float
    """Step of all tiles that should keep the promise."""
    share: float
    """Bytes as a multiple of those without an MLP, at the same error."""
    joint: float
    """Part of its correction that values are coded less by."""


def head_bytes(head: NeighbourHead | None) -> int:
    """Return the bytes that an MLP adds to the file; 0 without one."""
    if head is None:
        return 0
    biases = sum(layer.biases.size for layer in head.layers)
    weights = head.size - biases
    return MLP_BYTES + math.ceil(WEIGHT_BYTES * weights + BIAS_BYTES * biases)


def choose_head(
    task: PlanTask, attempt: Attempt, learned: Sample, foretold: float
) -> ChosenHead | None:
    """Return an MLP with the step that keeps the promise; None where none was trained.

    It is trained on what it will meet, coarser data, which it lifts to the promise.

    attempt: without one.
    learned: tiles that are learned from.
    foretold: gain in dB of least squares.
    """
    settings, size = attempt.settings, attempt.outcome.size
    widths = likely_widths(size, GAIN_OF_MLP * foretold, task.config.access)
    lengths = training_lengths(task, widths)
    told = f"{lengths[0]} updates, {len(lengths)} passes; least squares gain {foretold:.2f} dB"
    with stage("head", told):
        gain = max(GAIN_OF_MLP * foretold * GAIN_BY_WIDTHS[widths], LEAST_GAIN)
        done = _trained(task, attempt, learned, widths, lengths, gain)
        best = min(done, key=lambda each: each.share, default=None)
        if best is None:
            return None
        history = _history(done)
        plain = ChosenHead(settings, attempt.coding, attempt.outcome, history)
        if task.goal.psnr is None:
            return _at_bound(task, attempt, learned, best, plain)
        left = size * best.share + head_bytes(best.trained.head)
        if left >= size * most_left(task):
            return plain
        return ChosenHead(
            replace(settings, head=best.trained.head, step=best.step),
            replace(attempt.coding, aim=0.0, joint=best.joint),
            replace(attempt.outcome, size=round(left)),
            history,
        )


def training_device(config: EncodeConfig) -> str:
    """Return where an MLP is trained: on CUDA where that is asked for.

    'auto' is the CPU: the usual 780 updates take it half a second, as long as CUDA takes to start.
    """
    return "cuda" if config.device == "cuda" else "cpu"


def training_lengths(task: PlanTask, widths: Widths) -> list[int]:
    """Return the updates of each training.

    Counted work turns seconds into updates, so that no clock changes a byte.
    """
    seconds = task.config.training_seconds
    if seconds is None:
        short = prod(task.blocks.shape) // VERTICES_OF_UPDATE
        updates = max(min(short, UPDATES), LEAST_UPDATES) << (task.config.effort - 5)
    else:
        of_update = 1e-9 * TRAINING_NS * weights_of(widths) * BATCH_VOXELS
        updates = max(1, round(seconds / of_update / (1 + AGAIN * (PASSES - 1))))
    passes = PASSES if updates <= LONG * UPDATES else PASSES + 1
    return [updates, *[max(1, round(AGAIN * updates))] * (passes - 1)]


def _trained(
    task: PlanTask,
    attempt: Attempt,
    parts: Sample,
    widths: Widths,
    lengths: Sequence[int],
    gain: float,
) -> list[_Pass]:
    """Train and code in turns; what each pass saves. Empty where there is nothing to learn.

    lengths: updates of each training.
    gain: expected of the MLP, in dB.
    """
    data_range, at = task.goal.data_range, replace(attempt.settings, mask=None)
    coding = replace(attempt.coding, aim=0.0, passes=1, rounds=0)
    coarser = replace(at, step=_step_below(attempt, at.step, gain))
    trained, corrected, done, before = None, list[Single](), list[_Pass](), 0.0
    if not coarser.step > at.step:
        return []
    slope = min(max(gain / math.log(coarser.step / at.step), MIN_SLOPE), MAX_SLOPE)
    alone = _Coded.of(parts, coarser, coding)
    promise = (task.goal.psnr or alone.psnr(data_range) + gain) + AIM_OF_MLP
    if task.goal.psnr is not None and not parts.complete:  # their PSNR is not that of all tiles
        promise = parts.run(at, attempt.coding).psnr(data_range) + AIM_OF_MLP
    slower = math.sqrt(min(UPDATES / lengths[0], 1.0))
    for number, length in enumerate(lengths):
        if trained is None:
            coded = alone
        else:
            if coded is not alone:
                corrected = _corrected(parts, alone, trained.head)
            coded = _left_to(corrected, parts, alone)
            corrected = []  # as large as the sample: not held while the MLP learns
        trained = train_head(
            coded.pairs,
            coarser.low,
            coarser.high,
            widths,
            Budget(
                updates=length,
                samples=min(max(SAMPLES, SAMPLES_OF_UPDATE * lengths[0]), MOST_SAMPLES),
                seed=task.config.seed + number,
                rate=(RATE if number == 0 else RATE_AGAIN) * slower,
                learner=learner_on(training_device(task.config)),
            ),
            progress=_report(task, sum(lengths[:number]), length, sum(lengths)),
            start=trained,
        )
        if trained is None:
            break
        corrected = _corrected(parts, coded, trained.head)
        psnr = _error_of(corrected, parts, coded).psnr(data_range)
        gained = psnr - alone.psnr(data_range)
        share = coded.size / max(alone.size, 1) * 2 ** (-gained / OCTAVE)
        excess = min(psnr - promise, MOST_EXCESS)
        step = coarser.step * math.exp(excess / slope)
        # Coded with what this pass has learned, the table gains half as much again.
        better = step * math.sqrt(min(max(step / before, 1.0), MOST_AHEAD)) if before else step
        before = step
        done.append(_Pass(trained, psnr, better, share, JOINT if number else 0.0))
        if abs(excess) > FAR and number + 1 < len(lengths):
            coarser = replace(coarser, step=step)
            alone = _Coded.of(parts, coarser, coding)
    return done


class _Coded(NamedTuple):
    """Parts as they were coded, without an MLP or less what one adds."""

    pairs: list[Pair]
    size: int
    """Bytes of all tiles."""
    outcome: Outcome
    settings: TileSettings
    coding: Coding

    @classmethod
    def of(cls, parts: Sample, settings: TileSettings, coding: Coding) -> _Coded:
        """Code parts without an MLP."""
        pairs = training_pairs(parts, settings, coding)
        outcome = parts.run(settings, coding)  # they were coded so for the pairs
        return cls(pairs, outcome.size, outcome, settings, coding)

    def psnr(self, data_range: float) -> float:
        """Return the PSNR without an MLP in dB."""
        return self.outcome.psnr(data_range)


def _left_to(corrected: Sequence[Single], parts: Sample, alone: _Coded) -> _Coded:
    """Return parts that are coded less by what an MLP adds to them.

    It is what the coder does with an MLP (native/encode.cpp, leave_to_head).

    corrected: what the MLP makes of them.
    alone: the parts coded without one.
    """

    def coded(job: tuple[Pair, Single]) -> CodedTile:
        pair, with_mlp = job
        with np.errstate(over="ignore", invalid="ignore"):
            less = np.float32(JOINT) * (with_mlp - pair.decoded)
            values = pair.original.astype(np.float32) - less
        return encode_tile(values, alone.settings, alone.coding, in_coreset=pair.counted)

    tiles = parts.each(coded, list(zip(alone.pairs, corrected, strict=True)))
    pairs = [
        pair._replace(decoded=tile.decoded) for pair, tile in zip(alone.pairs, tiles, strict=True)
    ]
    sizes = (len(tile.data) * weight for tile, weight in zip(tiles, parts.weights, strict=True))
    return alone._replace(pairs=pairs, size=sum(sizes))


def _corrected(parts: Sample, coded: _Coded, head: NeighbourHead) -> list[Single]:
    """Return what an MLP makes of coded parts."""
    return parts.each(lambda pair: head.apply(pair.decoded), coded.pairs)


def _error_of(corrected: Sequence[Single], parts: Sample, coded: _Coded) -> Outcome:
    """Return the error of coded parts with an MLP."""

    def outcome(job: tuple[Single, Tile]) -> Outcome:
        values, tile = job
        decoded = CodedTile(data=b"", decoded=cast(values, tile.values.dtype), nonzero=0)
        return measured(tile, decoded, coded.settings, coded.coding)

    jobs = list(zip(corrected, parts.tiles, strict=True))
    return total(parts.each(outcome, jobs), parts.weights)


def _report(task: PlanTask, before: int, length: int, total: int) -> Callable[[float], None]:
    """Return what reports a training of some updates among all, by the share that is done of it."""
    return lambda share: task.parts.report("training", (before + share * length) / total)


def _step_below(attempt: Attempt, step: float, decibels: float) -> float:
    """Return the step whose PSNR without an MLP is lower than that of a step.

    Coefficients predict it, where there is a promised PSNR.
    """
    if attempt.magnitudes is None:
        return step_after_gain(step, decibels)
    error = attempt.magnitudes.error(step * scale_of(attempt.settings)) * 10 ** (decibels / 10)
    return attempt.magnitudes.step_of(error, attempt.settings)


def _at_bound(
    task: PlanTask, attempt: Attempt, learned: Sample, best: _Pass, plain: ChosenHead
) -> ChosenHead:
    """Return an MLP at the step of the fewest bytes under a bound; `plain` where it saves none."""
    joint = replace(attempt.coding, aim=0.0, joint=best.joint)
    few = learned.narrower(TRIED)
    before = few.run(attempt.settings, task.goal.bounded(attempt.coding))
    trained = replace(attempt.settings, head=best.trained.head, step=best.step)
    settings, outcome = find_step(few, trained, joint, task.goal, tries=3)
    size = attempt.outcome.size * outcome.size / before.size + head_bytes(best.trained.head)
    if size >= attempt.outcome.size * most_left(task):
        return plain
    return ChosenHead(settings, joint, replace(attempt.outcome, size=round(size)), plain.history)


def _history(passes: Sequence[_Pass]) -> HeadHistory:
    """Return the training, as the file has it."""
    history, seconds, updates = HeadHistory(), 0.0, 0
    for each in passes:
        of_pass = each.trained.history
        history += [
            {
                "seconds": seconds + after,
                "epoch": updates + update,
                # The header holds no infinity: that of values without an error.
                "psnr": each.psnr + gain - of_pass[-1][2] if math.isfinite(each.psnr) else None,
                "samples": each.trained.samples,
            }
            for after, update, gain in of_pass
        ]
        seconds, updates = seconds + of_pass[-1][0], updates + of_pass[-1][1]
    return history


def training_pairs(sample: Sample, settings: TileSettings, coding: Coding) -> list[Pair]:
    """Return the tiles as they decode without an MLP, with their originals and masks."""
    decoded = sample.decoded(replace(settings, head=None, mask=None), coding)
    return [
        Pair(values, tile.values, tile.counted)
        for values, tile in zip(decoded, sample.tiles, strict=True)
    ]
