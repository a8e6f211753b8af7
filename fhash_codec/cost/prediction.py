"""Prediction of an encoding: seconds, bytes and PSNR for some settings, before it is done.

The work is counted as the encoder does it, and its rates are probed on this machine and this series
in a few seconds: a few tiles are coded under the promise, a head or a network is trained for a
moment.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import prod

import numpy as np

from fhash_codec.compact.goal import EXCHANGE
from fhash_codec.compact.stages import MIN_HEAD_EFFORT
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.compact_probe import (
    OVERHEAD_BYTES,
    Look,
    Rates,
    look_at,
    now,
    probe_rates,
)
from fhash_codec.cost.compact_work import stage_seconds
from fhash_codec.cost.head_probe import HeadProbe, probe_head
from fhash_codec.cost.paper_work import PaperProbe, probe_paper
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import FhashWarning
from fhash_formats.series import Series, StepsSeries
from fhash_formats.support.threads import thread_pool

__all__ = ["Prediction", "Predictor", "predict"]

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


def predict(
    series: Series, configs: Sequence[EncodeConfig], *, progress: Progress = silent
) -> list[Prediction]:
    """Predict the encodings of a series, one for each of the settings.

    series: the data; at least a part of them is read.
    configs: the settings.
    progress: called with each step of the work.

    Raises InputError for settings that do not fit the series, and MissingDependencyError for the
    profile paper without torch.
    """
    with predictor(series) as one:
        predictions = []
        for number, config in enumerate(configs):
            progress("predicting", number, len(configs), "")
            predictions.append(one.predict(config))
        progress("predicting", len(configs), len(configs), "")
        return predictions


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
        """Predict the encoding with some settings; raises what `predict` raises."""
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
        part, steps = self._part(LOOKED_AT), self._series.shape[0]
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
        part = self._part(TRAINED_ON) if config.key_frames == "all" else self._series
        share = part.shape[0] / self._series.shape[0]
        if key not in self._trainings:
            self._trainings[key] = probe_paper(part, share, key)
        probe = self._trainings[key]
        stages = probe.stage_seconds(config)
        more = config.psnr is not None and config.tables == "transform"
        return Prediction(
            seconds=sum(stages.values()),
            bytes=None if config.tables == "transform" else probe.bytes,
            psnr=None,
            basis=f"two epochs on {_steps(part, self._series)}, in {now() - begun:.1f} s"
            + ("; further rounds for --psnr are not counted" if more else "")
            + "; the PSNR is not told before the training",
            stages=stages,
        )

    def _part(self, vertices: int) -> Series:
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
