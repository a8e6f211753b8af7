"""The trained head in the race for bytes: it stays only where a file of equal quality gets smaller by it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

from fhash_codec.compact.choices.search import EXCHANGE, exchange
from fhash_codec.compact.choices.step import SLOPE
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.errors import InputError
from fhash_formats.transform.head.inputs import CROSS, INPUTS
from fhash_formats.transform.tile.settings import TileSettings

if TYPE_CHECKING:
    from fhash_codec.compact.choices.head_training import Pair, TrainedHead

HEADS = {(3, 4): 0.67, (4, 8): 0.83, (8, 8): 1.0, (12, 12): 1.13, (14, 24): 1.22}
"""Widths of the two hidden layers, the second over the cross, and their part of the gain in dB of the head that is tried first."""
CHOICES = {5: 4, 6: 4, 7: 4, 8: 5, 9: 5}
"""How many of them by effort."""
STEPS = {5: 1500, 6: 2500, 7: 4000, 8: 6000, 9: 10000}
"""Training steps by effort."""
SAMPLES = {5: 200_000, 6: 200_000, 7: 400_000, 8: 400_000, 9: 400_000}
"""Voxels that are learnt from by effort."""
PERCEPTRON = (12, 8)
"""Widths of the head without a cross that competes, too: where little is to be gained, its fewer weights may win."""
LONGER = 2
"""Times that its training is longer: its steps cost less."""
TRIED = (8, 8)
"""The head of the quick trial."""
MIN_GAIN = 0.02
"""dB on held-out samples below which a quick trial says that a head will not pay."""
GROWTH, HOPE = 1.2, 0.02
"""What the whole training gains, roughly: so many times the gain of the trial, and so many dB besides."""
WEIGHT_BYTES, HEAD_BYTES = 0.9, 240
"""Of a head in the file: per weight, and besides, the course of the training included."""
COURSE_BYTES = 200
"""Of the course of the training."""
WEIGHT_TIME = 5e-6
"""Of the file, what a weight must save for the time that decoding takes by it."""
TRAINING_VERTICES = 8 << 20
"""Of the tiles that are learnt from: few tiles teach what holds for them alone."""
MIN_BYTES = 1000
"""Of coded tiles: of less, a head could not save what it takes."""


def race(
    sample: Sample,
    settings: TileSettings,
    outcome: Outcome,
    coding: Coding,
    solve: Callable[[TileSettings, list[Outcome]], tuple[TileSettings, Outcome]],
    tried: list[Outcome],
    *,
    strict: bool,
    data_range: float,
    effort: int,
    seed: int,
    device: str,
) -> tuple[TileSettings, Outcome, list[dict[str, float | None]]]:
    """Settings with a head and a larger step if the sample gets smaller by it, else as they were; the course of the training.

    solve: the step that keeps the promise with a head, and all outcomes on the way. tried: those without a head. strict: the promise is
    a bound, which all outcomes keep; else it is a PSNR, and sizes are compared at the same one. way: without the bound, for what a head is
    trained on.
    The history has `seconds`, `epoch` (training steps) and `psnr` of held-out samples.
    """
    if outcome.size < MIN_BYTES:
        return settings, outcome, []
    wider = sample.wider(TRAINING_VERTICES)
    trial = _train(
        _pairs(wider, settings, coding),
        settings,
        hidden=TRIED,
        cross=True,
        steps=400,
        samples=80_000,
        seed=seed,
        device=device,
    )
    if trial is None or trial.gain_db < MIN_GAIN:
        return settings, outcome, []
    hidden = _widths(
        outcome.size, GROWTH * trial.gain_db + HOPE, _octave(tried, data_range), effort
    )
    # The head is trained on what it will meet: coarser data, which it lifts to the quality that was asked for.
    coarser = replace(settings, step=settings.step * math.exp(trial.gain_db / SLOPE))
    pairs = _pairs(wider, coarser, coding)

    def train(
        widths: tuple[int, int], cross: bool
    ) -> tuple[TrainedHead, tuple[TileSettings, Outcome], list[Outcome]] | None:
        longer = 1 if cross else LONGER
        steps, samples = STEPS[effort] * longer, SAMPLES[effort] * longer
        trained = _train(
            pairs,
            coarser,
            hidden=widths,
            cross=cross,
            steps=steps,
            samples=samples,
            seed=seed,
            device=device,
        )
        again: list[Outcome] = []
        return (
            None
            if trained is None
            else (trained, solve(replace(coarser, head=trained.head), again), again)
        )

    # Side by side: a training takes one processor, and so does coding a single tile.
    with ThreadPoolExecutor(2, thread_name_prefix="fhash-head") as workers:
        runs = list(
            workers.map(
                lambda head: train(*head),
                [*([(hidden, True)] if hidden else []), (PERCEPTRON, False)],
            )
        )
    best, least, curve = (settings, outcome), 0.0, list[dict[str, float | None]]()
    for run in runs:
        if run is None:
            continue
        trained, found, again = run
        reached = found[1].psnr(data_range)
        cost = found[1].size - outcome.size + len(trained.head.to_bytes()) * 4 / 3 + COURSE_BYTES
        if not strict:
            # Equal quality: what is left between the two searches, in bytes.
            cost += outcome.size * (
                2 ** ((outcome.psnr(data_range) - reached) / _octave(again, data_range)) - 1
            )
        if cost < least or not curve:
            base = reached - trained.gain_db
            curve = [
                {"seconds": seconds, "epoch": step, "psnr": base + gain}
                for seconds, step, gain in trained.history
            ]
        if cost < least:
            best, least = found, cost
    return *best, curve


def _octave(tried: list[Outcome], data_range: float) -> float:
    """dB that an octave of bytes buys."""
    return exchange(
        [(math.log2(found.size), found.psnr(data_range)) for found in tried if found.size], EXCHANGE
    )


def _widths(size: float, gain: float, octave: float, effort: int) -> tuple[int, int] | None:
    """Those of the head that should save the most in a file of so many bytes, where the tried one gains so many dB; None if none does.

    octave: dB that an octave of bytes buys.
    """

    def saved(hidden: tuple[int, int]) -> float:
        first, second = hidden
        weights = INPUTS * first + len(CROSS) * first * second + second
        return (
            size * (1 - 2 ** (-HEADS[hidden] * gain / octave) - WEIGHT_TIME * weights)
            - WEIGHT_BYTES * weights
            - HEAD_BYTES
        )

    best = max(list(HEADS)[: CHOICES[effort]], key=saved)
    return best if saved(best) > 0 else None


def _pairs(sample: Sample, settings: TileSettings, coding: Coding) -> list[Pair]:
    """The tiles as they decode without a head, as they were, and what counts in them."""
    decoded = sample.decoded(replace(settings, head=None, mask=None), coding)
    return [
        (found, values, care) for found, (values, care) in zip(decoded, sample.tiles, strict=True)
    ]


def _train(
    pairs: Sequence[Pair],
    settings: TileSettings,
    *,
    hidden: tuple[int, int],
    cross: bool,
    steps: int,
    samples: int,
    seed: int,
    device: str,
) -> TrainedHead | None:
    # torch takes seconds to import, and an effort without training does not need it.
    from fhash_codec.compact.choices.head_training import train_head

    try:
        return train_head(
            pairs,
            low=settings.low,
            high=settings.high,
            hidden=hidden,
            cross=cross,
            steps=steps,
            samples=samples,
            seed=seed,
            device=device,
        )
    except InputError:
        # Nothing to correct: the decoded values are exact.
        return None
