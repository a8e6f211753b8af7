"""Training of the neighbourhood head (fhash_formats.transform.head.head).

It learns from decoded tiles and their originals. The same seed gives the same head on every
machine; `head_network` says why.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.choices.head_network import Network, adam_factors
from fhash_codec.compact.choices.head_samples import (
    BATCH_VOXELS,
    MAX_ERROR,
    Batches,
    ErrorRange,
    Pair,
    Voxels,
    batches,
    count_voxels,
    draw,
)
from fhash_formats.transform.head.head import SIGMA_RANGE, NeighbourHead
from fhash_formats.transform.head.inputs import CROSS

__all__ = ["TrainedHead", "train_head"]

Doubles = npt.NDArray[np.float64]

WARM_UP = 0.1
"""Share of the schedule in which the learning rate rises."""
ROUNDED_FROM = 0.6
"""Share of the schedule from which on weights are rounded as in the file."""
STARTS = 3
"""Networks that are trained side by side at first."""
CHOSEN_AT = 0.15
"""Share of the schedule at which the best of them goes on alone."""
MEASUREMENTS = 10
"""Number of measurements of the gain during the training."""
UPDATES_AT_ONCE = 20
"""Updates after which the training says how far it is, and may be stopped."""


@dataclass(frozen=True, kw_only=True)
class TrainedHead:
    """A trained head and what it gains."""

    head: NeighbourHead
    gain_db: float
    """Gain in dB on held-out voxels."""
    history: tuple[tuple[float, int, float], ...]
    """Gain during the training: (seconds, update, gain in dB)."""
    samples: int
    """Voxels that it learned from."""


def train_head(
    pairs: Sequence[Pair],
    *,
    low: float,
    high: float,
    updates: int,
    samples: int,
    rate: float = 1e-2,
    hidden: tuple[int, int] = (12, 8),
    cross: bool = False,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> TrainedHead | None:
    """Train a head that lowers the squared error of the voxels that count.

    The result is None where there is nothing to learn: where no voxel counts, where the decoded
    values are the original ones, or where their error is beyond what a head can state.

    pairs: decoded and original tiles (t, z, y, x) in data units.
    low, high: range that decoded values are clipped to.
    updates: number of training updates, 1 or more.
    samples: approximate number of voxels to learn from; a fifth as many measure the gain.
    rate: highest learning rate.
    hidden: widths of the hidden layers.
    cross: whether the head looks at the hidden values of neighbours, see `NeighbourHead`.
    progress: called with the share of the training that is done, 0 to 1, after every few updates.
        What it raises ends the training.
    """
    if not count_voxels(pairs).sum():
        return None
    random = np.random.default_rng(seed)
    bounds = np.float32(low), np.float32(high)
    learned, tested = (
        draw(pairs, max(1, round(count / BATCH_VOXELS)) * BATCH_VOXELS, random, *bounds)
        for count in (samples, samples // 5)
    )
    sigma = _sigma(learned)
    if not SIGMA_RANGE[0] <= sigma <= SIGMA_RANGE[1]:
        return None
    value_range = ErrorRange(low=bounds[0], high=bounds[1], sigma=sigma)
    offsets = CROSS if cross else CROSS[:1]
    training, held_out = (
        batches(pairs, drawn, offsets, random, value_range) for drawn in (learned, tested)
    )
    networks = [Network(hidden, len(offsets), random) for _ in range(STARTS)]
    history, network = _optimise(networks, training, held_out, _rates(updates, rate), progress)
    head = NeighbourHead(
        layers=network.layers(),
        sigma=float(sigma),
        low=float(bounds[0]),
        high=float(bounds[1]),
        cross=cross,
    )
    return TrainedHead(
        head=head,
        gain_db=history[-1][2],
        history=tuple(history),
        samples=sum(voxels.values.size for voxels in learned),
    )


def _sigma(drawn: Sequence[Voxels]) -> np.float32:
    """Return the root of the mean squared error of the drawn voxels."""
    errors = np.concatenate(
        [voxels.originals - voxels.values.astype(np.float64) for voxels in drawn]
    )
    with np.errstate(over="ignore", under="ignore"):
        return np.float32(np.sqrt(np.mean(errors * errors)))


def _optimise(
    networks: list[Network],
    training: Batches,
    held_out: Batches,
    rates: Doubles,
    progress: Callable[[float], None] | None,
) -> tuple[list[tuple[float, int, float]], Network]:
    """Train networks, from some update on only the best; return its gains on the way and it.

    The gains are tuples (seconds, update, dB).

    rates: learning rate of each update.
    """
    history: list[tuple[float, int, float]] = []
    updates = len(rates)
    factors, roots = adam_factors(rates)
    chosen, unrounded = (
        max(1, math.ceil(CHOSEN_AT * updates) - 1),
        math.floor(ROUNDED_FROM * updates),
    )
    measured = {-(-updates * number // MEASUREMENTS) for number in range(1, MEASUREMENTS + 1)}
    pauses = {*range(UPDATES_AT_ONCE, updates, UPDATES_AT_ONCE), *measured, chosen, unrounded}
    began, done = perf_counter(), 0
    for pause in sorted(pauses - {0}):
        for network in networks:
            network.learn(
                training,
                done + 1,
                factors[done:pause],
                roots[done:pause],
                as_in_file=done >= unrounded,
            )
        done = pause
        if done == chosen:
            gains = [_gain(network, held_out, as_in_file=False) for network in networks]
            networks = [networks[gains.index(max(gains))]]
        if done in measured:
            gains = [_gain(network, held_out, as_in_file=True) for network in networks]
            history.append((perf_counter() - began, done, max(gains)))
        if progress is not None:
            progress(done / updates)
    return history, networks[0]


def _rates(updates: int, highest: float) -> Doubles:
    """Return the learning rate of each update: a linear rise, then a smooth fall to 0.

    The fall is the cubic 1 - f**2 (3 - 2 f), within 0.01 of a half cosine. The last bit of a
    cosine would depend on the machine.
    """
    share = np.arange(1, updates + 1) / updates
    fall = np.maximum(share - WARM_UP, 0) / (1 - WARM_UP)
    return highest * np.where(share < WARM_UP, share / WARM_UP, 1 - fall * fall * (3 - 2 * fall))


def _gain(network: Network, held_out: Batches, *, as_in_file: bool) -> float:
    """Return the dB that a network gains on the held-out voxels.

    Squares below that of the unit of errors count as that of the unit, so the gain is finite.
    """
    after = sum(network.squared_errors(held_out, as_in_file=as_in_file))
    return 10 * math.log10(max(_squares_before(held_out), 1) / max(after, 1))


def _squares_before(held_out: Batches) -> int:
    """Return the sum of the squared errors of the decoded values, in the unit of a network's."""
    sums = 0
    for targets in held_out.targets:
        errors = np.clip(targets.astype(np.int64), -MAX_ERROR, MAX_ERROR)
        sums += int((errors * errors).sum())
    return sums
