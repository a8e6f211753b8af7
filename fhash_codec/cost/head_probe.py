"""Rates of the training of heads, from that of one which is trained for a moment."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fhash_codec.compact.head import TRIAL_HEAD, training_pairs
from fhash_codec.compact.head_training import (
    BATCH_VOXELS,
    CHOSEN_AT,
    MEASUREMENTS,
    STARTS,
    Budget,
    train_head,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.compact_probe import Look, Rates, coded_tiles, now, search_coding

__all__ = ["HeadProbe", "probe_head", "updates_of"]

HEAD_UPDATES = 120
"""Updates of the head that is trained for the rate of its training."""
HEAD_SAMPLES = 40_000
"""Voxels that this head learns from."""
TESTED = 0.2
"""Voxels that the gain is measured on, as a share of those that are learned from."""
FORWARD = 1 / 3
"""Time of evaluating a batch, as a share of that of an update."""


@dataclass(frozen=True, kw_only=True)
class HeadProbe:
    """A short training of the trial head, and the rates that follow from it.

    Attributes:
        gain_db: gain in dB on held-out voxels, after HEAD_UPDATES updates.
        update: seconds of an update of the trial head.
        sampling: seconds for each voxel that is drawn.
        final: rate of coding with the head, beyond that without.
    """

    gain_db: float
    update: float
    sampling: float
    final: float


def probe_head(look: Look, rates: Rates, config: EncodeConfig) -> HeadProbe | None:
    """Train a head for a moment; None where there is nothing to learn."""
    coding = replace(search_coding(look, config.effort), error=None)
    pairs = training_pairs(rates.sample, rates.settings, coding)
    begun = now()
    low, high = rates.settings.low, rates.settings.high
    budget = Budget(updates=HEAD_UPDATES, samples=HEAD_SAMPLES)
    trained = train_head(pairs, low, high, TRIAL_HEAD, budget, seed=config.seed)
    if trained is None:
        return None
    seconds = now() - begun
    training = min(trained.history[-1][0], seconds)
    with_head = replace(rates.settings, head=trained.head)
    final = coded_tiles(rates.sample, with_head, search_coding(look, config.effort))[0]
    return HeadProbe(
        gain_db=trained.gain_db,
        update=training / updates_of(HEAD_UPDATES, HEAD_SAMPLES),
        sampling=(seconds - training) / (HEAD_SAMPLES * (1 + TESTED)),
        final=max(final - rates.search, 0.0),
    )


def updates_of(updates: int, samples: int) -> float:
    """The number of updates of one network that take as long as a whole training.

    STARTS networks begin side by side, and the best goes on alone. The gain is measured on held-out
    voxels, once for each network at that place and some times on the way.
    """
    learning = updates * (1 + (STARTS - 1) * CHOSEN_AT)
    batches = max(1.0, samples * TESTED / BATCH_VOXELS)
    return learning + (MEASUREMENTS + STARTS - 1) * batches * FORWARD
