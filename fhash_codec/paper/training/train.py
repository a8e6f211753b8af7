"""The training loop: batches of bricks, a learning rate that falls to zero, history, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from math import log10, prod

import numpy as np
import numpy.typing as npt
from torch import Tensor

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.engines import Engine
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import TrainingError
from fhash_formats.support.interrupts import StopRequest

BATCH_BRICKS = 64  # of 1024 vertices: below 2^16 samples a step, its fixed cost shows; above, each epoch teaches less
STEPS_AN_EPOCH = (20, 256)
USUAL_EPOCHS, USUAL_STEPS = 20, 1000
HISTORY_POINTS = 100
PROBE_BRICKS = 512  # on which the quality of an epoch is measured
DIVERGED = 4.0
"""Mean squared error of a batch, in squares of the range, above which a training diverged: no start is as wrong, and what is ends as a
constant for the most part (a rate of 0.1 reaches 2.3 and recovers)."""
WATCHED = 16
"""Batches after which their errors are looked at: a GPU would have to wait after each."""
USUAL_RATE, DEAD, STILL = 0.01, 0.05, 0.5
"""A model is dead whose error is the values' variance but for a share of DEAD, and moved by no more than STILL dB over the second half of
the training: it says a constant, and a rate above the usual one killed it. What learnt too little is still on its way."""
LOWER, MAX_RESTARTS = 0.25, 8
"""What a rate that diverged is multiplied by, and how often."""


class Diverged(TrainingError):
    """The error grew beyond all that a lower learning rate would not mend."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The course of a training: `epochs` passes over `bricks` bricks in `batches` random batches each.

    rates: learning rate of every step, 1-based, float64 (epochs * batches + 1,).
    """

    epochs: int
    bricks: int
    batches: int
    seed: int
    rates: npt.NDArray[np.float64]

    @property
    def batch_bricks(self) -> int:
        """Bricks of the largest batch."""
        return -(-self.bricks // self.batches)

    def order(self, epoch: int) -> list[npt.NDArray[np.int64]]:
        """The batches of an epoch: every brick once; depends on nothing but the seed and the epoch."""
        return np.array_split(
            np.random.default_rng([self.seed, epoch]).permutation(self.bricks), self.batches
        )


def plan_training(
    coreset: Coreset, *, epochs: int, learning_rate: float, schedule: str, batch: int, seed: int
) -> Plan:
    """A plan for a coreset.

    epochs: 0 for 20 of them, or as many as make 1000 steps. batch: in samples, 0 for 64 bricks where that makes 20 to 256 steps an
    epoch, else the nearest size that does.
    """
    bricks = len(coreset.bricks)
    if batch:
        batches = max(1, round(bricks * prod(coreset.brick_shape) / batch))
    else:
        low, high = STEPS_AN_EPOCH
        batches = min(max(-(-bricks // BATCH_BRICKS), low), high)
    batches = min(batches, bricks)
    epochs = epochs or max(USUAL_EPOCHS, -(-USUAL_STEPS // batches))
    share = np.arange(epochs * batches + 1) / max(epochs * batches, 1)
    rates = learning_rate * (
        0.5 + 0.5 * np.cos(np.pi * share) if schedule == "cosine" else np.ones_like(share)
    )
    return Plan(epochs=epochs, bricks=bricks, batches=batches, seed=seed, rates=rates)


@dataclass(kw_only=True)
class Course:
    """How far a training has come: finished epochs, batches within the present one, seconds spent, and the quality after each epoch.

    restarts: how often it diverged and began again, each time at LOWER times the learning rate; the seconds are those of all.
    """

    epoch: int = 0
    batch: int = 0
    seconds: float = 0.0
    history: list[dict[str, float | None]] = field(default_factory=list)
    restarts: int = 0

    def rate(self, asked: float) -> float:
        """The learning rate to begin with where `asked` was asked for."""
        return asked * LOWER**self.restarts

    def again(self) -> Course:
        """The course from the start at a lower rate. What led here is no place to go back to: the state of Adam has grown with it."""
        return Course(seconds=self.seconds, restarts=self.restarts + 1)


def train(
    engine: Engine,
    plan: Plan,
    coreset: Coreset,
    course: Course,
    *,
    stop: StopRequest | None = None,
    save: Callable[[Course], None] | None = None,
    save_seconds: float = 60.0,
    budget_seconds: float = float("inf"),
    progress: Progress = silent,
) -> bool:
    """Train from where `course` stands to the end of the plan; true if it got there.

    Every epoch (of more than 100: every 2nd, 3rd, ...) adds {seconds, epoch, psnr} to the history; PSNR in dB of the normalised
    values on a fixed random choice of bricks.
    `save` is called with the course every `save_seconds`, and when `stop` asks for an end, which comes after the running batch.
    The loop also ends once `budget_seconds` are spent. Raises Diverged where the error of a batch is above DIVERGED or not finite,
    and where a higher rate than the usual one left nothing but a constant.
    """
    probe = np.sort(np.random.default_rng(plan.seed).permutation(plan.bricks)[:PROBE_BRICKS])
    begun = saved = time.perf_counter()
    before, note = course.seconds, ""
    every = -(-plan.epochs // HISTORY_POINTS)
    counts, worst = np.diff(coreset.offsets), None
    while course.epoch < plan.epochs:
        for chosen in plan.order(course.epoch)[course.batch :]:
            error = engine.train(chosen) / max(int(counts[chosen].sum()), 1)
            worst = error if worst is None else worst.maximum(error)
            course.batch += 1
            now = time.perf_counter()
            course.seconds = before + now - begun
            asked = stop is not None and stop.asked
            saving = save is not None and (asked or now - saved > save_seconds)
            if saving or course.batch % WATCHED == 0 or course.batch == plan.batches:
                _watch(worst, course)
                worst = None
            if save and saving:
                save(course)
                # Saving may take long for a large model: never more than a twentieth of the time.
                saved = time.perf_counter()
                save_seconds = max(save_seconds, 20 * (saved - now))
            if asked or course.seconds > budget_seconds:
                return False
            progress(
                "training",
                course.epoch * plan.batches + course.batch,
                plan.epochs * plan.batches,
                note,
            )
        course.epoch, course.batch = course.epoch + 1, 0
        if course.epoch % every == 0 or course.epoch == plan.epochs:
            psnr = probe_psnr(engine, coreset, probe)
            course.seconds = before + time.perf_counter() - begun
            course.history.append({"seconds": course.seconds, "epoch": course.epoch, "psnr": psnr})
            note = "exact" if psnr is None else f"epoch {course.epoch}: {psnr:.1f} dB"
    if plan.rates[0] > USUAL_RATE and _dead(course, _variance(coreset, probe)):
        raise Diverged("training ended in a constant")
    return True


def probe_psnr(engine: Engine, coreset: Coreset, bricks: npt.NDArray[np.int64]) -> float | None:
    """PSNR in dB of the normalised values (range 1) over the coreset vertices of `bricks`; None where the error is exactly 0."""
    samples = int(np.diff(coreset.offsets)[bricks].sum())
    error = sum(
        engine.squared_error(part)
        for part in np.array_split(bricks, -(-len(bricks) // BATCH_BRICKS))
    )
    if not np.isfinite(error):
        raise Diverged(
            "training diverged: the error is no longer finite; set a lower --learning-rate"
        )
    return None if error == 0 else -10 * log10(error / samples)


def _watch(worst: Tensor | None, course: Course) -> None:
    """Raise Diverged for a largest mean squared error that is beyond DIVERGED or not finite."""
    error = 0.0 if worst is None else float(worst)
    if not error <= DIVERGED:
        raise Diverged(
            f"training diverged in epoch {course.epoch + 1}: the error reached {error**0.5:.3g} times the range of the values"
        )


def _dead(course: Course, variance: float) -> bool:
    """Whether the second half of a training said nothing but the mean of values of this variance (normalised)."""
    late = [point["psnr"] for point in course.history[len(course.history) // 2 :]]
    if not variance > 0 or len(late) < 2:
        return False
    constant = -10 * log10(variance)
    off = [abs(psnr - constant) for psnr in late if psnr is not None]
    return len(off) == len(late) and max(off) <= STILL and off[-1] <= -10 * log10(1 - DEAD)


def _variance(coreset: Coreset, bricks: npt.NDArray[np.int64]) -> float:
    """Of the normalised values over the coreset vertices of `bricks`."""
    parts = [
        coreset.values[first:end]
        for first, end in zip(coreset.offsets[bricks], coreset.offsets[bricks + 1], strict=True)
    ]
    return float(np.var(np.concatenate(parts), dtype=np.float64))
