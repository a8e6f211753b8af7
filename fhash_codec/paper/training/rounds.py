"""Further rounds of a training whose model is not yet as good as a promise needs.

A round begins with the learning rate at its top again and has as many epochs as all before it, so
that each doubles the training. numpy only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

# torch takes seconds to import. The plan alone is needed here, and its type only.
if TYPE_CHECKING:
    from fhash_codec.paper.training.train import TrainingPlan

LOWER_START = 0.5
"""Learning rate at the start of a round, as a share of that of the training."""
MAX_DOUBLINGS = 10
"""Largest number of further rounds, by the gain of the last ones, that are worth one more."""
MIN_STEPS = 8000
"""Training steps before which a small gain says nothing: many trainings pause at their start."""
WATCHED_ROUNDS = 2
"""Rounds whose gain counts: a training may pause for one and then learn again."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Quality that a model must have before its tables are coded.

    Attributes:
        psnr: PSNR in dB over the coreset.
        promised: promised PSNR in dB of the coded tables, at most `psnr`.
        seconds: time that further rounds may take.
    """

    psnr: float
    promised: float
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Round:
    """A further round of a training.

    Attributes:
        epochs: epochs of the round.
        psnr: PSNR in dB over the coreset before it.
        seconds: seconds of training before it.
    """

    epochs: int
    psnr: float
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Decision of a measurement of the model: another round or the end.

    Attributes:
        round: the next round; None to end the training.
        message: text for the user; "" where the goal is reached.
        limited: whether the limit in time ends the training.
    """

    round: Round | None
    message: str
    limited: bool = False


def decide(
    goal: Goal, psnr: float, epochs: int, steps: int, seconds: float, rounds: Sequence[Round]
) -> Decision:
    """Decide whether a training goes on.

    Args:
        goal: the quality that is needed, and the limit in time.
        psnr: PSNR in dB of the model over the coreset; infinite for an exact one.
        epochs: finished epochs.
        steps: training steps so far.
        seconds: seconds of training so far.
        rounds: the further rounds so far.
    """
    if psnr >= goal.psnr:
        return Decision(round=None, message="")
    has = f"the model has {psnr:.2f} dB over the coreset after {epochs} epochs"
    needed = f"{goal.promised:g} dB are promised"
    short = (
        "" if psnr < goal.promised else f", which costs bytes: {goal.psnr:g} dB would leave room"
    )
    if len(rounds) >= WATCHED_ROUNDS and steps >= MIN_STEPS:
        gain = psnr - rounds[-WATCHED_ROUNDS].psnr
        if gain * MAX_DOUBLINGS < WATCHED_ROUNDS * (goal.psnr - psnr):
            return Decision(
                round=None,
                message=f"training ends: {has}, {needed}{short}; "
                f"the last {WATCHED_ROUNDS} rounds brought {gain:.2f} dB",
            )
    begun = rounds[0].seconds if rounds else seconds
    left = goal.seconds - (seconds - begun)
    affordable = left / max(seconds / epochs, 1e-9)
    count = min(epochs, math.floor(min(affordable, float(epochs))))
    if count < 1:
        return Decision(
            round=None,
            message=f"training ends at its limit of {goal.seconds:g} more seconds: {has}, "
            f"{needed}{short}; --train-on-seconds sets the limit",
            limited=True,
        )
    return Decision(
        round=Round(epochs=count, psnr=psnr, seconds=seconds),
        message=f"training goes on for {count} epochs: {has}, {needed}, and {goal.psnr:g} dB "
        "before the tables are coded",
    )


def extended(plan: TrainingPlan, epochs: int, schedule: str) -> TrainingPlan:
    """Return a plan with a further round.

    Args:
        plan: the plan so far.
        epochs: epochs of the round.
        schedule: as in `plan_training`.
    """
    steps = epochs * plan.batches
    share = np.arange(1, steps + 1) / steps
    top = LOWER_START * plan.rates[0]
    rates = top * (0.5 + 0.5 * np.cos(np.pi * share) if schedule == "cosine" else share**0)
    return replace(plan, epochs=plan.epochs + epochs, rates=np.concatenate([plan.rates, rates]))
