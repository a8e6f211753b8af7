"""Work of an encoding by the profile compact: what its stages code, and how long that takes.

The counts follow the encoder (fhash_codec/compact/stages.py). What depends on the data, such as the
number of trials until a step is found, is a constant here: its mean over many series.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import prod

from fhash_codec.compact.attempt import MAX_WHOLE_VERTICES, cheap_tiling, tiles_to_try
from fhash_codec.compact.goal import EXCHANGE
from fhash_codec.compact.head import (
    EFFORTS,
    MIN_BYTES,
    MIN_GAIN,
    NEAR_GAIN,
    TRAINING_VERTICES,
    TRIAL_BUDGET,
    TRIAL_HEAD,
    expected_gain,
    likely_heads,
)
from fhash_codec.compact.head_training import Budget
from fhash_codec.compact.labels import ends_trials
from fhash_codec.compact.predictor import TRIAL_VERTICES as PREDICTED_VERTICES
from fhash_codec.compact.stages import (
    LARGE,
    LEAST,
    MAX_SEARCHED_VERTICES,
    MIN_HEAD_EFFORT,
    SAMPLE_VERTICES,
    TRIAL_VERTICES,
)
from fhash_codec.compact.step import allows_trellis
from fhash_codec.compact.tilings import PICKED_VERTICES, largest_tile
from fhash_codec.compact.transform import basis_bytes, count_trials
from fhash_codec.comparison import ssim_budget
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.compact_probe import Look, Rates
from fhash_codec.cost.head_probe import HeadProbe, updates_of
from fhash_codec.encoding import DECODED_AGAIN
from fhash_codec.measure.ssim import ssim_steps
from fhash_formats.support.threads import usable_threads
from fhash_formats.transform.head import CROSS
from fhash_formats.transform.tile_format import Shape

__all__ = ["stage_seconds"]

TRIES = 2.5
"""Trials of a search for the step of a PSNR."""
HEAD_TRIES = 1.5
"""Trials of that search with the head that is kept, after the one by which heads are compared."""
NEAR_TRIES = 1.5
"""Trials of that search where it begins near its end: for another tile, or the same sample."""
TRIAL_SHARE = 0.8
"""Time of coding with a candidate for the transform, as a share of that with the usual one."""
TILINGS = 4
"""Tilings that are coded to choose the tiles."""
PICKS = 5
"""Trials of a transform for each of them, on a part of the series."""
REFIT_TRIES = 4
"""Further trials where the data's own bases are fitted again."""
NEAR_REFIT_TRIES = 1.5
"""Such trials before a head is tried, which needs the step less precisely."""
BOUND_TRIALS = 8
"""Trials of a search for the step under a bound."""
SIZE_TRIES = 3
"""Trials of a search for the step of a size."""
QUANTISER_TRIES = 3
"""Codings of the sample by which the quantiser is chosen for a PSNR; the last begins the search."""
QUANTISER_TRIES_OF_BOUND = 2
"""Such codings under a bound."""
COARSER_TRIES = 4
"""Codings of the sample with coarser bases of the data's own, where these are tried."""
PASSES = 0.2
"""Times that all tiles are coded for a PSNR, where the step was searched on all of them: the search
has coded them already, with the step that mostly keeps the promise."""
SAMPLED_PASSES = 2.0
"""Times that all tiles are coded for a PSNR, where the step was searched on a sample."""
SIZE_PASSES = 2.0
"""Times that all tiles are coded for a promised ratio."""
GAIN_AFTER = 1.6
"""Gain of the trial head as a multiple of that after the few updates of a probe."""


@dataclass(frozen=True, kw_only=True)
class _Work:
    """Counts of the work for one setting."""

    look: Look
    rates: Rates
    config: EncodeConfig

    @property
    def vertices(self) -> int:
        """Vertices of the box over all steps."""
        return prod(self.look.shape)

    @property
    def bytes_of_tiles(self) -> float:
        """Approximate bytes of all tiles."""
        return self.rates.outcome.size / self.look.share

    def tiles(self, tile: Shape, limit: int | None = None) -> int:
        """The number of tiles of the series, or of a sample of at most `limit` vertices."""
        count = prod(-(-n // m) for n, m in zip(self.look.shape, tile, strict=True))
        return count if limit is None else min(count, max(1, limit // prod(tile)))

    def wall(self, rate: float, tile: Shape, jobs: float) -> float:
        """Seconds of coding some tiles at once."""
        threads = usable_threads()
        rounds = math.ceil(jobs / threads) if jobs < 4 * threads else jobs / threads
        return rounds * prod(tile) * rate

    @property
    def coded_anew(self) -> bool:
        """Whether all tiles must be coded once more after the search under a bound."""
        blocks, vertices = self.look.task.blocks, self.vertices
        filled_anew = not blocks.complete and blocks.dtype.kind != "f"
        return filled_anew or vertices > MAX_SEARCHED_VERTICES or self.config.effort == 1

    def tries(self, usual: float) -> float:
        """Trials of a search for the step, one after the other; `usual` for a PSNR."""
        goal = self.look.task.goal
        if goal.data_range == 0 or goal.error == 0:
            return 1
        if goal.error is not None:
            return BOUND_TRIALS
        return SIZE_TRIES if goal.size is not None else usual


def stage_seconds(
    look: Look, rates: Rates, head: HeadProbe | None, config: EncodeConfig
) -> dict[str, float]:
    """Return the predicted seconds of each stage of an encoding, by the names of its record.

    head: None for no head.
    """
    work = _Work(look=look, rates=rates, config=config)
    seconds = {"scan": look.selecting, "measuring": _measuring(work, head)}
    labels = look.labels
    if labels is not None:
        seconds["labels"] = look.labelling
    if labels is not None and (labels.clearly or ends_trials(labels, look.attempt.outcome.size)):
        if not labels.clearly:
            seconds["first guess"] = look.guessing
        return seconds | {"coding": _all_tiles(work, rates.final)}
    if _estimated(look, config):
        trials = work.wall(rates.trial, rates.sample.blocks.tile, 8)
        return seconds | {
            "estimate": 2 * look.costing + trials,
            "coding": _all_tiles(work, rates.trial),
        }
    seconds["first guess"] = look.guessing
    seconds |= _choices(work)
    final = rates.final
    if head is not None:
        told = _head(work, head)
        seconds |= told
        final += head.final if "head" in told else 0.0
    if look.task.goal.error and config.effort > 1 and "predictor" not in config.without:
        seconds["predictor"] = _predictor(work)
    goal = look.task.goal
    passes = PASSES if work.vertices <= MAX_SEARCHED_VERTICES else SAMPLED_PASSES
    if goal.psnr is None:
        passes = float(work.coded_anew) if goal.error is not None else SIZE_PASSES
    return seconds | {"coding": passes * _all_tiles(work, final)}


def _estimated(look: Look, config: EncodeConfig) -> bool:
    """Whether effort 1 estimates the step, as `plan` decides."""
    return (
        config.effort == 1
        and look.task.goal.psnr is not None
        and look.task.goal.data_range > 0
        and look.task.blocks.in_memory
        and look.task.blocks.complete
        and not look.attempt.settings.double
    )


def _choices(work: _Work) -> dict[str, float]:
    """Seconds of the choices by trial: sample, transform, tiles, filling, step."""
    look, rates, config = work.look, work.rates, work.config
    tile, seconds = look.tile, {"sample": look.costing}
    tried = work.tiles(tile, TRIAL_VERTICES)
    in_memory = look.task.blocks.in_memory
    if config.effort > 1:
        trials, bases = count_trials(tile, in_memory=in_memory)
        search = work.tries(TRIES) * work.wall(rates.trial, tile, tried)
        if "transform" in config.without:
            trials = bases = 0
        coding = TRIAL_SHARE * work.wall(rates.trial, tile, trials * tried)
        if prod(tile) > LARGE * TRIAL_VERTICES:
            # A part stands for the tile in all trials but two.
            parts = trials * TRIAL_VERTICES / usable_threads() + 2 * prod(tile)
            coding = TRIAL_SHARE * rates.trial * parts
        seconds["transform"] = coding + search
        seconds["bases"] = bases * rates.basis * work.vertices
        if look.task.fixed_tile is None and "tiles" not in config.without:
            seconds["tiles"] = _tiles(work)
    vertices = work.vertices
    limit = MAX_SEARCHED_VERTICES if vertices <= MAX_SEARCHED_VERTICES else SAMPLE_VERTICES
    searched = work.tiles(tile, limit)
    once = work.wall(rates.search, tile, searched)
    if not look.task.blocks.complete:
        fill = work.wall(rates.fill, tile, searched)
        if config.effort > 1 and "filling" not in config.without:
            seconds["filling"] = 4 * fill + 4 * work.tries(2.5) * once
        seconds["sample"] += 2 * fill
    usual = NEAR_TRIES if searched == tried and config.effort > 1 else TRIES
    refits = NEAR_REFIT_TRIES if config.effort >= MIN_HEAD_EFFORT else REFIT_TRIES
    tries = work.tries(usual + (refits if rates.has_bases else 0))
    if allows_trellis(look.attempt.settings, look.task.goal, config.effort):
        quantisers = QUANTISER_TRIES if look.task.goal.error is None else QUANTISER_TRIES_OF_BOUND
        tries += quantisers - 1
    seconds["step"] = tries * once
    taken = basis_bytes(rates.settings.transform)
    if (
        config.effort > 1
        and look.task.goal.size is None
        and taken >= LEAST * (work.bytes_of_tiles + taken)
        and taken
    ):
        seconds["coarser bases"] = min(COARSER_TRIES, work.tries(COARSER_TRIES)) * once
    return seconds


def _tiles(work: _Work) -> float:
    """Seconds of the trials of tilings, see fhash_codec/compact/tilings.py."""
    look, rates = work.look, work.rates
    shape = look.shape
    whole = work.vertices <= MAX_WHOLE_VERTICES
    tried = shape if whole else largest_tile(shape)
    if tiles_to_try(tried, MAX_WHOLE_VERTICES) == [tried]:
        return 0.0
    # Some of the tilings have few tiles, which leave a thread without work.
    share = (1 + 1 / usable_threads()) / 2
    picked = PICKS * min(PICKED_VERTICES, prod(tried)) / usable_threads()
    once = share * prod(tried) + picked
    return look.costing + TILINGS * TRIAL_SHARE * rates.trial * once


def _head(work: _Work, head: HeadProbe) -> dict[str, float]:
    """Seconds of the trial of a head and of the training; only the trial where it gains nothing."""
    look, rates, config = work.look, work.rates, work.config
    tile, threads = look.tile, usable_threads()
    limit = MAX_SEARCHED_VERTICES if work.vertices <= MAX_SEARCHED_VERTICES else SAMPLE_VERTICES
    searched = work.tiles(tile, limit)
    size = work.bytes_of_tiles
    if size < MIN_BYTES:
        return {}
    strict = bool(look.task.goal.error)
    # Without a bound the tiles are coded already, and are only decoded.
    known = rates.search if strict else rates.decode
    pairs = work.wall(known, tile, searched)
    seconds = {"head trial": pairs + _training(head, TRIAL_BUDGET, 1.0, 1.0)}
    gain = GAIN_AFTER * head.gain_db
    if gain < MIN_GAIN:
        return seconds
    shapes = likely_heads(size, expected_gain(gain), EXCHANGE, config.effort)
    if not shapes:
        return seconds
    spent = EFFORTS[config.effort]
    parts = [
        _training(
            head,
            spent.budget_of(shape),
            shape.products / TRIAL_HEAD.products,
            1.0 if shape.cross else 1 / len(CROSS),
        )
        for shape in shapes
    ]
    # Each training takes one thread.
    alone = max(max(parts), sum(parts) / threads)
    again = gain > NEAR_GAIN or searched < work.tiles(tile)
    wider = work.wall(rates.search, tile, work.tiles(tile, TRAINING_VERTICES)) if again else 0.0
    looks = 0 if strict and len(shapes) == 1 else len(shapes)
    search = work.tries(HEAD_TRIES) * work.wall(rates.search + head.final, tile, searched)
    search += looks * work.wall((known if again else rates.search) + head.final, tile, searched)
    return seconds | {"head": wider + alone + search}


def _training(head: HeadProbe, budget: Budget, work: float, sampling: float) -> float:
    """Seconds of a training, whose updates and samples cost a multiple of those of the trial."""
    updates = updates_of(budget.updates, budget.samples)
    return updates * head.update * work + 1.2 * budget.samples * head.sampling * sampling


def _predictor(work: _Work) -> float:
    """Seconds of the choice of a predictor."""
    look, rates, effort = work.look, work.rates, work.config.effort
    trials = 1 + 3 * (effort > 2) + 2 * (effort > 3)
    coded = min(work.vertices, PREDICTED_VERTICES) * rates.predict / usable_threads()
    last = work.wall(rates.predict, look.tile, work.tiles(look.tile, MAX_SEARCHED_VERTICES))
    return trials * (rates.fit + coded) + 3 * rates.fit + last


def _all_tiles(work: _Work, rate: float) -> float:
    """Seconds of coding all tiles once."""
    tile = work.look.tile
    if _estimated(work.look, work.config) and work.look.task.fixed_tile is None:
        tile = cheap_tiling(work.look.shape, work.bytes_of_tiles, work.config.access).tile
    return work.wall(rate, tile, work.tiles(tile))


def _measuring(work: _Work, head: HeadProbe | None) -> float:
    """Seconds of decoding the file and comparing it with the source."""
    rates, look = work.rates, work.look
    steps, plane = look.shape[0], prod(look.task.blocks.shape[1:])
    decode = rates.decode + (0.0 if head is None else head.final)
    budget = ssim_budget(work.config)
    measured = len(ssim_steps(steps, plane, budget)) if budget else 0
    again = 1.0 / DECODED_AGAIN if _estimated(look, work.config) else 1.0
    return (
        again * work.wall(decode, look.tile, work.tiles(look.tile))
        + rates.compare * work.vertices
        + rates.ssim * measured * plane
    )


assert MIN_HEAD_EFFORT in EFFORTS
