"""The trained head in the race for bytes: it stays only where a file of equal quality gets smaller by it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from fhash_codec.compact.sample import Outcome, Sample, Way
from fhash_codec.compact.search import EXCHANGE, exchange
from fhash_codec.compact.steps import SLOPE
from fhash_formats.errors import InputError
from fhash_formats.transform.settings import Settings

HIDDEN = {5: (12, 8), 6: (24, 12), 7: (24, 12), 8: (48, 24), 9: (48, 24)}
"""Widths of the hidden layers by effort."""
STEPS = {5: 2500, 6: 4000, 7: 4000, 8: 6000, 9: 10000}
"""Training steps by effort."""
LEAST_GAIN = 0.02
"""dB on held-out samples below which a quick trial says that a head will not pay."""
TRAINING_VERTICES = 8 << 20
"""Of the tiles that are learnt from: few tiles teach what holds for them alone."""
LEAST_BYTES = 1000
"""Of coded tiles: of less, a head could not save what it takes."""


def race(
    sample: Sample,
    settings: Settings,
    outcome: Outcome,
    way: Way,
    solve: Callable[[Settings, list[Outcome]], tuple[Settings, Outcome]],
    *,
    strict: bool,
    data_range: float,
    effort: int,
    seed: int,
    device: str,
) -> tuple[Settings, Outcome, list[dict[str, float | None]]]:
    """Settings with a head and a larger step if the sample gets smaller by it, else as they were; the course of the training.

    solve: the step that keeps the promise with a head, and all outcomes on the way. strict: the promise is a bound, which all outcomes
    keep; else it is a PSNR, and sizes are compared at the same one. way: without the bound, for what a head is trained on.
    The history has `seconds`, `epoch` (training steps) and `psnr` of held-out samples.
    """
    if outcome.size < LEAST_BYTES:
        return settings, outcome, []
    # Where the file is small, so must be the head.
    hidden = HIDDEN[effort] if outcome.size > 20_000 else (12, 8) if outcome.size > 4_000 else (8,)
    wider = sample.wider(TRAINING_VERTICES)
    trial = _train(wider, settings, way, hidden=hidden, steps=500, samples=100_000, seed=seed, device=device)
    if trial is None or trial[1] < LEAST_GAIN:
        return settings, outcome, []
    # The head is trained on what it will meet: coarser data, which it lifts to the quality that was asked for.
    coarser = replace(settings, step=settings.step * math.exp(trial[1] / SLOPE))
    trained = _train(wider, coarser, way, hidden=hidden, steps=STEPS[effort], samples=800_000, seed=seed, device=device)
    if trained is None:
        return settings, outcome, []
    head, _, history = trained
    tried: list[Outcome] = []
    with_head, with_outcome = solve(replace(coarser, head=head), tried)
    reached = with_outcome.psnr(data_range)
    base = reached - float(history[-1]["gain"] or 0.0) if history else reached
    curve = [{"seconds": p["seconds"], "epoch": p["epoch"], "psnr": base + float(p["gain"] or 0.0)} for p in history]
    cost = with_outcome.size - outcome.size + len(head.to_bytes()) * 4 / 3
    if not strict:
        # Equal quality: what is left between the two searches, in bytes.
        octave = exchange([(math.log2(found.size), found.psnr(data_range)) for found in tried], EXCHANGE)
        cost += outcome.size * (2 ** ((outcome.psnr(data_range) - reached) / octave) - 1)
    return (with_head, with_outcome, curve) if cost < 0 else (settings, outcome, curve)


def _train(sample: Sample, settings: Settings, way: Way, *, hidden: tuple[int, ...], steps: int, samples: int, seed: int, device: str):  # type: ignore[no-untyped-def]
    # torch takes seconds to import, and an effort without training does not need it.
    from fhash_codec.head_training import train_head

    decoded = sample.decoded(replace(settings, head=None, mask=None), way)
    pairs = [(found, values, care) for found, (values, care) in zip(decoded, sample.tiles, strict=True)]
    try:
        trained = train_head(
            pairs, low=settings.low, high=settings.high, hidden=hidden, steps=steps, samples=samples, seed=seed, device=device
        )
    except InputError:
        # Nothing to correct: the decoded values are exact.
        return None
    history = [{"seconds": seconds, "epoch": step, "gain": gain} for seconds, step, gain in trained.history]
    return trained.head, trained.gain_db, history
