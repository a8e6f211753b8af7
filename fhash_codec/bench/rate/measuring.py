"""The measurements of `fhash bench rate`: the smallest size of each codec at each quality, and
speed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.rate.own import Own, promised, trial_of
from fhash_codec.bench.rate.peers import (
    SMALL_CHUNK,
    Variant,
    filled,
    opened_file,
    read_all,
    read_region,
    small_chunks,
    stored,
    stored_bytes,
    touched_bytes,
)
from fhash_codec.bench.rate.results import OWN, Access, Point, Speed
from fhash_codec.bench.rate.search import EXACT, Search, Trial
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.boxes import Box
from fhash_codec.measure.metrics import Errors
from fhash_codec.progress import Progress
from fhash_codec.training.devices import need_torch
from fhash_codec.value_type import decoded_type
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import ArraySeries

TRIALS = 8
"""New trials of each search, at most."""
SLACK = 0.05
"""dB of PSNR above the target at which a search ends."""
BOUND_SLACK = 0.1
"""dB of the largest error below the bound at which a search ends."""
UNIFORM = 20 * math.log10(math.sqrt(3))
"""dB by which the RMSE of a uniformly distributed error lies below the tolerance."""
RUNS = 3
"""Runs of which the best counts."""
LONG_SECONDS = 20.0
"""Seconds of encoding after which there is no further run."""
PLACES = 8
"""Random places at which access is measured."""
REGION = 16
"""Vertices of a region along each axis."""


@dataclass(frozen=True, kw_only=True)
class Best:
    """The trial of a codec that reached a quality, or else the closest one.

    Attributes:
        as_asked: for a bound, whether the codec's own tolerance of that bound kept it; None where
            it has no such setting.
        how: variant or settings that give the trial again.
    """

    codec: str
    trial: Trial
    setting: str
    reached: bool
    as_asked: bool | None
    how: Variant | EncodeConfig


class Bench:
    """One run of the bench: the data, and the best trial so far by quality and codec."""

    def __init__(
        self,
        series: ArraySeries,
        value_range: tuple[float, float],
        missing: int,
        folder: Path,
        goals: list[tuple[str, float]],
        progress: Progress,
    ) -> None:
        self.series, self.folder, self.goals, self.progress = series, folder, goals, progress
        self.range = value_range[1] - value_range[0]
        floats = np.asarray(series.values, dtype=decoded_type(series.dtype))
        self.filled: npt.NDArray[Any] = filled(floats) if missing else floats
        self.own = Own(series, self.range, folder)
        self.best: dict[tuple[str, float], dict[str, Best]] = {goal: {} for goal in goals}
        self.refused: dict[str, str] = {}
        self.speeds: list[Speed] = []
        self.access: list[Access] = []
        self.done, self.total = 0, 1

    def search(self, variant: Variant) -> None:
        """Find the smallest size of a variant for each of its goals.

        The codec keeps the best of its variants.
        """
        search = self._search(variant)
        for goal, asked in self.goals:
            if goal not in variant.goals:
                continue
            self.done += 1
            self.progress("comparing", self.done, self.total, variant.name)
            if variant.name in self.refused:
                continue
            try:
                as_asked = None
                if goal == "bound" and variant.mode == "tolerance":
                    as_asked = search.try_level(-20 * math.log10(asked)).max_error <= asked
                aim = asked if goal == "psnr" else -20 * math.log10(asked)
                trial = search.find(
                    goal,
                    aim,
                    first=aim - UNIFORM,
                    slack=SLACK if goal == "psnr" else BOUND_SLACK,
                    most=TRIALS,
                )
            except InputError as error:
                self.refused[variant.name] = str(error)
                continue
            reached = trial is not None
            closest = trial or max(search.trials.values(), key=lambda tried: tried.quality(goal))
            best = Best(
                codec=variant.peer,
                trial=closest,
                setting=variant.name,
                reached=reached,
                as_asked=as_asked,
                how=variant,
            )
            self._keep((goal, asked), best)

    def _search(self, variant: Variant) -> Search:
        """The trials of a variant on these data."""
        values = self._values(variant)

        def measure(level: float) -> Trial:
            with stored(values, variant, self.range, level) as file:
                decoded, count = read_all(file, variant), stored_bytes(file)
            errors = Errors(self.range)
            for step, frame in enumerate(decoded):
                errors.add(step, self.series.read(step), frame)
            return trial_of(errors, level, count)

        return Search(measure, step=variant.step, fixed=variant.lossless)

    def search_own(self, settings: Mapping[str, Any], profile: str) -> None:
        """Encode with a profile for every goal; one that lacks a package is refused."""
        if profile == "paper":
            try:
                need_torch("profile paper")
            except MissingDependencyError as error:
                self.refused[f"{OWN}{profile}"] = str(error)
                return
        for goal, asked in self.goals:
            config = promised(settings, profile, goal, asked)
            self.done += 1
            self.progress("comparing", self.done, self.total, f"fhash {profile}")
            trial = self.own.trial(config)
            # A bound is kept in data units; the division by the range may round the share up.
            reached = (
                trial.psnr >= asked if goal == "psnr" else trial.max_error <= asked * (1 + 1e-12)
            )
            as_asked = reached if goal == "bound" and profile != "paper" else None
            best = Best(
                codec=f"{OWN}{profile}",
                trial=trial,
                setting=f"{OWN}{profile}",
                reached=reached,
                as_asked=as_asked,
                how=config,
            )
            self._keep((goal, asked), best)

    def _keep(self, goal: tuple[str, float], new: Best) -> None:
        """Keep a trial unless the codec has a better one: one that reached the goal, then fewer
        bytes."""
        old = self.best[goal].get(new.codec)
        if old is None or (not old.reached, old.trial.bytes) > (not new.reached, new.trial.bytes):
            self.best[goal][new.codec] = new

    def points(self) -> list[Point]:
        """The kept trials, by goal and codec."""
        return [
            Point(
                codec=best.codec,
                goal=goal,
                asked=asked,
                reached=best.reached,
                bytes=best.trial.bytes,
                psnr=_shown(best.trial),
                max_error=best.trial.max_error,
                setting=best.setting,
                as_asked=best.as_asked,
            )
            for (goal, asked), codecs in self.best.items()
            for best in codecs.values()
        ]

    def measure_speed(self, target: float, variants: Mapping[str, Sequence[Variant]]) -> None:
        """Measure encoding, decoding and access of each codec at its setting for a PSNR.

        Peers are also measured with small chunks at the same PSNR.
        """
        codecs = self.best["psnr", target].values()
        for number, best in enumerate(codecs):
            if isinstance(best.how, EncodeConfig):
                self._speed_of_own(best, best.how)
            else:
                self._speed_of_peer(best, best.how)
                self._access_of_peer(best.how, best.trial)
                if max(self.series.shape[1:]) > SMALL_CHUNK:
                    self._small_access(small_chunks(variants[best.codec]), target)
            self.progress("timing", number + 1, len(codecs), best.codec)

    def _speed_of_peer(self, best: Best, variant: Variant) -> None:
        values, path = self._values(variant), self.folder / "peer.h5"

        def encode() -> None:
            with stored(values, variant, self.range, best.trial.level, path):
                pass

        def decode() -> None:
            with opened_file(path) as file:
                read_all(file, variant)

        self._add_speed(
            best, [_timed(encode) for _ in range(RUNS)], [_timed(decode) for _ in range(RUNS)]
        )

    def _small_access(self, variant: Variant, target: float) -> None:
        try:
            trial = self._search(variant).find(
                "psnr", target, first=target - UNIFORM, slack=SLACK, most=TRIALS
            )
        except InputError as error:
            self.refused[variant.name] = str(error)
        else:
            if trial is not None:
                self._access_of_peer(variant, trial)

    def _access_of_peer(self, variant: Variant, trial: Trial) -> None:
        path = self.folder / "peer.h5"
        with stored(self._values(variant), variant, self.range, trial.level, path):
            pass

        def read(step: int, box: Box) -> tuple[int, float]:
            begun = time.perf_counter()
            with opened_file(path) as file:
                read_region(file, variant, step, box)
            spent = time.perf_counter() - begun
            with opened_file(path) as file:
                return touched_bytes(file, variant, step, box), spent

        self._add_access(variant.peer, variant.name, trial, read)

    def _speed_of_own(self, best: Best, config: EncodeConfig) -> None:
        while len(self.own.seconds[config]) < RUNS and sum(self.own.seconds[config]) < LONG_SECONDS:
            self.own.encode(config)
        self._add_speed(
            best, self.own.seconds[config], [self.own.decode(config) for _ in range(RUNS)]
        )
        self._add_access(
            best.codec,
            best.setting,
            best.trial,
            lambda step, box: self.own.read_region(config, step, box),
        )

    def _add_speed(self, best: Best, encoding: Sequence[float], decoding: Sequence[float]) -> None:
        megabytes = self.series.values.nbytes / 1e6
        self.speeds.append(
            Speed(
                codec=best.codec,
                setting=best.setting,
                psnr=_shown(best.trial),
                encode_mb_s=megabytes / min(encoding),
                decode_mb_s=megabytes / min(decoding),
                encode_runs=len(encoding),
            )
        )

    def _add_access(
        self, codec: str, setting: str, trial: Trial, read: Callable[[int, Box], tuple[int, float]]
    ) -> None:
        """Read regions at the same places for every codec; the first is a warm-up."""
        rng = np.random.default_rng(0)
        steps, *space = self.series.shape
        size = [min(REGION, n) for n in space]
        measured = []
        for place in range(PLACES + 1):
            low = [
                int(rng.integers(0, n - length + 1)) for n, length in zip(space, size, strict=True)
            ]
            step = int(rng.integers(0, steps))
            box = Box.of_shape(size).shift(low)
            if place:
                measured.append(read(step, box))
            else:
                read(step, box)
        self.access.append(
            Access(
                codec=codec,
                setting=setting,
                region=(size[0], size[1], size[2]),
                bytes=trial.bytes,
                psnr=_shown(trial),
                milliseconds=1000 * median(seconds for _, seconds in measured),
                bytes_read=round(median(touched for touched, _ in measured)),
            )
        )

    def _values(self, variant: Variant) -> npt.NDArray[Any]:
        return self.series.values if variant.lossless else self.filled


def _shown(trial: Trial) -> float | None:
    """PSNR in dB, None where nothing differs."""
    return None if trial.psnr == EXACT else trial.psnr


def _timed(work: Callable[[], object]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun
