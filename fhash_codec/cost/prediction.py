"""Prediction of an encoding: seconds, bytes and PSNR before it is done; effort by a time budget."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import prod
from typing import Annotated, TypedDict

import numpy as np

from fhash_codec.compact.attempt import MAX_WHOLE_VERTICES, cheap_tiling, tiles_to_try
from fhash_codec.compact.goal import EXCHANGE
from fhash_codec.compact.head import (
    EFFORTS,
    GAIN_OF_HEAD,
    LEAST_GAIN,
    NEAR_GAIN,
    PERCEPTRON,
    TRAINING_VERTICES,
    likely_heads,
)
from fhash_codec.compact.head_training import Budget
from fhash_codec.compact.plan import ends_trials
from fhash_codec.compact.planner import CODED_VERTICES, PRICED_VERTICES, is_priced
from fhash_codec.compact.predictor import TRIAL_VERTICES as PREDICTED_VERTICES
from fhash_codec.compact.stages import (
    LEAST,
    MAX_SEARCHED_VERTICES,
    MIN_HEAD_EFFORT,
    SAMPLE_VERTICES,
    TRIAL_VERTICES,
    allows_trellis,
    is_tried_in_parts,
    vertices_of_trials,
)
from fhash_codec.compact.tilings import PICKED_VERTICES, largest_tile
from fhash_codec.compact.transform import CODED, basis_bytes, count_trials
from fhash_codec.comparison import ssim_budget
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.probe import (
    OVERHEAD_BYTES,
    HeadProbe,
    Look,
    PaperProbe,
    Rates,
    look_at,
    now,
    probe_head,
    probe_paper,
    probe_rates,
    updates_of,
)
from fhash_codec.cost.results import seconds_text
from fhash_codec.encoding import DECODED_AGAIN
from fhash_codec.measure.metrics import ssim_steps
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import FhashWarning
from fhash_formats.series import Series, StepsSeries
from fhash_formats.support.threads import thread_pool, usable_threads
from fhash_formats.transform.tile_format import Shape

TRIES = 2.5
"""Trials of a search for the step of a PSNR."""
QUICK_TRIES = 2
"""Such trials at most, where few are made."""
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
PRICES_OF_PARTS = 20
"""Times that the parts of a series are priced."""


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
    if by_prices := is_priced(look.task, look.task.blocks, look.attempt.settings):
        seconds |= _prices(work)
    else:
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
    if by_prices:
        passes = 1.0 + PASSES
    elif goal.psnr is None:
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


def _prices(work: _Work) -> dict[str, float]:
    """Seconds of a plan by prices, see fhash_codec/compact/planner.py."""
    look, rates = work.look, work.rates
    priced = min(2 * PRICED_VERTICES, work.vertices)
    price = rates.trial if rates.price is None else rates.price
    coded = min(2 * CODED_VERTICES, 2 * work.vertices) / usable_threads()
    return {
        "plan": 2 * look.costing + PRICES_OF_PARTS * priced * price / usable_threads(),
        "bases": (rates.basis if rates.has_bases else 0.0) * work.vertices,
        "step": look.costing + coded * rates.search,
    }


def _choices(work: _Work) -> dict[str, float]:
    """Seconds of the choices by trial: sample, transform, tiles, filling, step."""
    look, rates, config = work.look, work.rates, work.config
    tile, seconds = look.tile, {"sample": look.costing}
    quick, tried = look.attempt.quick, work.tiles(tile, TRIAL_VERTICES)
    in_memory = look.task.blocks.in_memory
    if config.effort > 1:
        trials, bases = count_trials(tile, in_memory=in_memory)
        search = work.tries(QUICK_TRIES if quick else TRIES) * work.wall(rates.trial, tile, tried)
        if "transform" in config.without:
            trials = bases = 0
        coded = trials if rates.price is None else min(trials, CODED)
        coding = TRIAL_SHARE * work.wall(rates.trial, tile, coded * tried)
        pricing = work.wall(rates.price or 0.0, tile, trials * tried)
        if is_tried_in_parts(tile, look.attempt):
            # A part stands for the tile in all trials but two.
            part = vertices_of_trials(look.attempt) / usable_threads()
            coding = TRIAL_SHARE * rates.trial * (coded * part + 2 * prod(tile))
            pricing = (rates.price or 0.0) * trials * part
        coding += pricing
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
    usual = NEAR_TRIES if quick or (searched == tried and config.effort > 1) else TRIES
    refits = NEAR_REFIT_TRIES if quick or config.effort >= MIN_HEAD_EFFORT else REFIT_TRIES
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
    if rates.price is None:
        once = TRIAL_SHARE * rates.trial * (share * prod(tried) + picked)
    else:
        once = TRIAL_SHARE * rates.trial * share * prod(tried) + rates.price * picked
    return look.costing + TILINGS * once


def _head(work: _Work, head: HeadProbe) -> dict[str, float]:
    """Seconds of the trial of a head and of the training; only the trial where it gains nothing."""
    look, rates, config = work.look, work.rates, work.config
    tile, threads = look.tile, usable_threads()
    limit = MAX_SEARCHED_VERTICES if work.vertices <= MAX_SEARCHED_VERTICES else SAMPLE_VERTICES
    searched = work.tiles(tile, limit)
    size = work.bytes_of_tiles
    spent = EFFORTS[config.effort]
    strict = bool(look.task.goal.error)
    # Without a bound the tiles are coded already, and are only decoded.
    known = rates.search if strict else rates.decode
    pairs = work.wall(known, tile, searched)
    seconds = {"head trial": head.looking}
    if head.gain_db < LEAST_GAIN:
        return seconds
    seconds["head trial"] += pairs
    shapes = likely_heads(size, GAIN_OF_HEAD * head.gain_db, EXCHANGE, spent)
    if not shapes:
        return seconds
    trial = PERCEPTRON
    parts = [
        _training(
            head,
            spent.budget_of(shape),
            shape.products / trial.products,
            shape.looked_at / trial.looked_at,
        )
        for shape in shapes
    ]
    # Each training takes one thread.
    alone = max(max(parts), sum(parts) / threads)
    again = GAIN_OF_HEAD * head.gain_db > NEAR_GAIN or searched < work.tiles(tile)
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
        time = work.look.attempt.settings.transform.axes[0]
        tile = cheap_tiling(work.look.shape, work.bytes_of_tiles, work.config.access, time).tile
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


LOOKED_AT = 32 << 20
"""Vertices of a series up to which all of it is looked at."""
TRAINED_ON = 4 << 20
"""Vertices of a series up to which the profile paper is probed on all of it."""
WINDOW_STEPS = 8
"""Successive steps of each part of a longer series that is looked at: those of a tile."""
WHOLE_PASSES = 0.15
"""Seconds besides all stages, as a share of those of scanning and measuring."""
MAX_MISSING = 10.0
"""Distance in dB of the probed tiles from the promise up to which bytes are corrected for it."""
SHORT_LOOK = 1.5
"""Seconds of a first look up to which it is taken twice."""
SLIMMER = 0.97
"""Bytes after all trials of a transform, as a share of those after a quick choice."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Prediction of an encoding.

    Attributes:
        seconds: of the whole job, measuring included.
        bytes: of the file; None where nothing tells them.
        psnr: in dB over the coreset; None where nothing tells it, and for exact values.
        basis: what the prediction rests on, and how uncertain it is, as one line of text.
        stages: seconds of each stage, by the names of `fhash_codec.progress`.
    """

    seconds: float
    bytes: int | None
    psnr: float | None
    basis: str
    stages: dict[str, float] = field(default_factory=dict)


@contextmanager
def predictor(series: Series) -> Iterator[Predictor]:
    """A predictor of a series, which keeps its probes for all settings that share them."""
    with thread_pool() as workers:
        yield Predictor(series, workers)


class Predictor:
    """Prediction of several encodings of one series; probes that they share are made once."""

    def __init__(self, series: Series, workers: ThreadPoolExecutor) -> None:
        self._series, self._workers = series, workers
        self._looks: dict[EncodeConfig, Look] = {}
        self._rates: dict[EncodeConfig, Rates] = {}
        self._heads: dict[EncodeConfig, HeadProbe | None] = {}
        self._trainings: dict[EncodeConfig, PaperProbe] = {}

    def predict(self, config: EncodeConfig) -> Prediction:
        """Predict the encoding with some settings; at least a part of the series is read.

        Raises InputError for settings that do not fit the series.
        """
        with warnings.catch_warnings():
            # The encoding itself will say them.
            warnings.simplefilter("ignore", FhashWarning)
            return self._paper(config) if config.profile == "paper" else self._compact(config)

    def _compact(self, config: EncodeConfig) -> Prediction:
        begun = now()
        plain = replace(config, timings=True, seed=0, without=())
        key = replace(plain, effort=1)
        if key not in self._looks:
            self._looks[key] = self._look(key)
        look = self._looks[key]
        # Efforts of one class code alike.
        effort = (
            1 if config.effort == 1 else 2 if config.effort == 2 else 3 if config.effort < 7 else 7
        )
        key = replace(plain, effort=effort, without=config.without)
        if key not in self._rates:
            self._rates[key] = probe_rates(look, key)
        rates, head = self._rates[key], None
        if self._may_have_head(look, config):
            key = replace(key, effort=config.effort)  # each has a trial of its own
            if key not in self._heads:
                self._heads[key] = probe_head(look, rates, key)
            head = self._heads[key]
        stages = stage_seconds(look, rates, head, config)
        rest = WHOLE_PASSES * (stages["scan"] + stages["measuring"])
        stages = {**stages, "other": rest}
        return Prediction(
            seconds=sum(stages.values()),
            bytes=_bytes(look, rates),
            psnr=_psnr(look, rates),
            basis=_basis(look, rates, now() - begun),
            stages=stages,
        )

    def _look(self, config: EncodeConfig) -> Look:
        """Look at the series; a first look that was short is taken again.

        The first one also pays for what is loaded and read for the first time. The encoding that
        follows does not pay it again.
        """
        part, steps = self._windows(LOOKED_AT), self._series.shape[0]
        begun = now()
        look = look_at(part, steps, config, self._workers)
        if self._looks or now() - begun > SHORT_LOOK:
            return look
        return look_at(part, steps, config, self._workers)

    def _may_have_head(self, look: Look, config: EncodeConfig) -> bool:
        """Whether the encoder would train a head."""
        goal = look.task.goal
        return (
            config.effort >= MIN_HEAD_EFFORT
            and "head" not in config.without
            and goal.size is None
            and goal.error != 0
            and goal.data_range > 0
            and not look.attempt.settings.double
        )

    def _paper(self, config: EncodeConfig) -> Prediction:
        begun = now()
        key = replace(config, epochs=0, timings=True)
        part = self._windows(TRAINED_ON) if config.key_frames == "all" else self._series
        share = part.shape[0] / self._series.shape[0]
        if key not in self._trainings:
            self._trainings[key] = probe_paper(part, share, key)
        probe = self._trainings[key]
        stages = probe.stage_seconds(config)
        more = config.coded and not config.epochs
        return Prediction(
            seconds=sum(stages.values()),
            bytes=None if config.coded else probe.bytes,
            psnr=None,
            basis=f"two epochs on {_steps(part, self._series)}, in {now() - begun:.1f} s"
            + ("; further rounds for the promise are not counted" if more else "")
            + "; the PSNR is not told before the training",
            stages=stages,
        )

    def _windows(self, vertices: int) -> Series:
        """Return the series, or windows of it, evenly spread, of at most some vertices."""
        steps = self._series.shape[0]
        count = vertices // prod(self._series.shape[1:])
        if steps <= max(count, 1):
            return self._series
        window = min(WINDOW_STEPS, max(count, 1))
        windows = max(1, count // window)
        starts = [(2 * number + 1) * (steps - window) // (2 * windows) for number in range(windows)]
        return StepsSeries(
            self._series, sorted({start + n for start in starts for n in range(window)})
        )


def _steps(part: Series, series: Series) -> str:
    """The part of a series that was looked at, in words."""
    if part.shape[0] == series.shape[0]:
        return "the whole series"
    return f"{part.shape[0]} of {series.shape[0]} steps"


def _bytes(look: Look, rates: Rates) -> int:
    """The predicted bytes of a compact file."""
    goal = look.task.goal
    if goal.size is not None:
        return round(goal.size / look.share)
    tiles = look.attempt.outcome.size if rates.outcome.size == 0 else rates.outcome.size
    if look.labels is not None:
        tiles = min(tiles, look.labels.attempt.outcome.size)
    missing = _missing(look, rates)
    return round(SLIMMER * tiles * 2 ** (missing / EXCHANGE) / look.share) + OVERHEAD_BYTES


def _missing(look: Look, rates: Rates) -> float:
    """The PSNR in dB by which the probed tiles miss the promise; negative where they exceed it."""
    goal = look.task.goal
    if goal.psnr is None or goal.data_range == 0:
        return 0.0
    missing = goal.psnr - rates.outcome.psnr(goal.data_range)
    return missing if abs(missing) < MAX_MISSING else 0.0


def _psnr(look: Look, rates: Rates) -> float | None:
    """The predicted PSNR of a compact file: the promised one, or that of the probed tiles."""
    goal = look.task.goal
    if goal.lossless or goal.data_range == 0:
        return None
    if goal.psnr is not None and goal.bulk is None:
        return goal.psnr
    outcome = rates.outcome
    mean = outcome.squares / outcome.count if outcome.count else 0.0
    if mean <= 0:
        return None
    psnr = float(10 * np.log10(goal.data_range**2 / mean)) + _missing(look, rates)
    # Beside a promise about the bulk, that about all values holds as well.
    return (
        psnr if goal.psnr is None or goal.bulk is None or goal.bulk.alone else max(psnr, goal.psnr)
    )


def _basis(look: Look, rates: Rates, seconds: float) -> str:
    """The basis of a prediction, in words."""
    vertices = sum(tile.values.size for tile in rates.sample.tiles)
    part = "all steps" if look.share == 1 else f"{look.share:.0%} of the steps"
    uncertain = "seconds within 25 % as a rule, bytes within 20 %"
    if rates.has_bases:
        uncertain = "seconds within 35 %; bytes up to twice those of the file, as bases pay here"
    if look.task.goal.error is not None or look.task.goal.size is not None:
        uncertain = "seconds within 50 % for a bound or a ratio, bytes within 30 %"
    return f"a look at {part} and {vertices:,} vertices coded, in {seconds:.1f} s; {uncertain}"


MARGIN = 1.15
"""Factor on predicted seconds that must fit: they are uncertain."""
MAX_EFFORT = 9
"""Highest effort."""
MAX_EPOCHS = 2000
"""Epochs from which on more hardly change a model."""
PROBED = 0.4
"""Share of the budget after which no further effort is probed."""


class Predicted(TypedDict):
    """A prediction of an encoding, as JSON values."""

    seconds: Annotated[float, "of the encoding, without the predictions"]
    bytes: Annotated[int | None, "of the file"]
    psnr: Annotated[float | None, "in dB over the coreset"]
    basis: Annotated[str, "what the prediction rests on, and how uncertain it is"]


class TimeBudget(TypedDict):
    """The choice of effort or epochs by a time budget, as JSON values."""

    seconds: Annotated[float, "the budget"]
    probing_seconds: Annotated[float, "of it, what the predictions took"]
    chosen: Annotated[str, "the option that was chosen, such as `--effort 3`"]
    why: Annotated[str, "why"]
    fits: Annotated[bool, "whether the encoding was predicted to fit"]
    predicted: Annotated[Predicted, "what was predicted"]


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Settings that were chosen by a time budget.

    Attributes:
        config: the settings, with the effort or the epochs that were chosen.
        prediction: what they should take.
        seconds: the budget.
        probing: seconds that the predictions took.
        fits: whether the prediction keeps the budget.
        why: what was chosen and why, as one line of text.
    """

    config: EncodeConfig
    prediction: Prediction
    seconds: float
    probing: float
    fits: bool
    why: str

    @property
    def option(self) -> str:
        """The option that was chosen, as the command line takes it."""
        return _option(self.config)

    def to_dict(self) -> TimeBudget:
        """The choice as JSON values."""
        told = self.prediction
        return {
            "seconds": self.seconds,
            "probing_seconds": round(self.probing, 3),
            "chosen": self.option,
            "why": self.why,
            "fits": self.fits,
            "predicted": {
                "seconds": told.seconds,
                "bytes": told.bytes,
                "psnr": told.psnr,
                "basis": told.basis,
            },
        }


def choose(
    series: Series,
    config: EncodeConfig,
    seconds: float,
    *,
    capped: bool = False,
    progress: Progress = silent,
) -> Choice:
    """Choose the highest effort, or the most epochs, that a series should be encoded with in time.

    config: the settings; the profile says which of the two is chosen.
    seconds: the time that probing and encoding may take together.
    capped: whether the effort or epochs of the settings are the most that may be chosen.

    Where even the least does not fit, it is chosen all the same, and `Choice.fits` says so.
    """
    begun = time.perf_counter()

    def left() -> float:
        return seconds - (time.perf_counter() - begun)

    with predictor(series) as one:
        progress("predicting", 0, 1, "")
        search = _most_epochs if config.profile == "paper" else _highest_effort
        chosen, prediction, beyond = search(one, config, seconds, capped, left)
        progress("predicting", 1, 1, "")
    remaining = left()
    fits = MARGIN * prediction.seconds <= remaining
    return Choice(
        config=chosen,
        prediction=prediction,
        seconds=seconds,
        probing=seconds - remaining,
        fits=fits,
        why=_why(seconds, seconds - remaining, chosen, prediction, beyond, fits=fits),
    )


def _highest_effort(
    one: Predictor, config: EncodeConfig, seconds: float, capped: bool, left: Callable[[], float]
) -> tuple[EncodeConfig, Prediction, str]:
    """Return the settings with the highest effort that fits, their prediction, and why no higher.

    left: returns the seconds that are left.
    """
    chosen = replace(config, effort=1)
    prediction = one.predict(chosen)
    for effort in range(2, (config.effort if capped else MAX_EFFORT) + 1):
        if left() < (1 - PROBED) * seconds:
            return chosen, prediction, "probing more would take too much of it"
        further = replace(config, effort=effort)
        predicted = one.predict(further)
        if predicted.seconds * MARGIN > left():
            return (
                chosen,
                prediction,
                f"{_option(further)} would take {seconds_text(predicted.seconds)}",
            )
        chosen, prediction = further, predicted
    return chosen, prediction, "the most that is allowed" if capped else "the highest"


def _most_epochs(
    one: Predictor, config: EncodeConfig, seconds: float, capped: bool, left: Callable[[], float]
) -> tuple[EncodeConfig, Prediction, str]:
    """Return the settings with the most epochs that fit; see `_highest_effort`."""

    def at(epochs: int) -> tuple[EncodeConfig, Prediction]:
        settings = replace(config, epochs=epochs)
        return settings, one.predict(settings)

    most = config.epochs if capped and config.epochs else MAX_EPOCHS
    chosen = at(1)
    low, high = 1, most
    # All epochs share one probe, so that each of these predictions takes no time.
    while low < high:
        middle = (low + high + 1) // 2
        candidate = at(middle)
        if MARGIN * candidate[1].seconds <= left():
            low, chosen = middle, candidate
        else:
            high = middle - 1
    return *chosen, "the most that is allowed" if low == most else "more would not fit"


def _option(config: EncodeConfig) -> str:
    """The option of a choice, as the command line takes it."""
    if config.profile == "paper":
        return f"--epochs {config.epochs}"
    return f"--effort {config.effort}"


def _why(
    seconds: float,
    probing: float,
    chosen: EncodeConfig,
    prediction: Prediction,
    beyond: str,
    *,
    fits: bool,
) -> str:
    """One line that says what was chosen and why."""
    told = seconds_text(prediction.seconds)
    budget, probed = seconds_text(seconds), seconds_text(probing)
    if prediction.bytes is not None:
        told += f" and {prediction.bytes:,} bytes"
    if not fits:
        return (
            f"the time budget of {budget} may not be kept: even {_option(chosen)} is"
            f" predicted to take {told}, after {probed} of probing; it is done anyway"
        )
    return (
        f"time budget {budget}: {_option(chosen)}, predicted to take {told} after"
        f" {probed} of probing; {beyond}"
    )
