"""The measuring behind `fhash bench rate`: for every quality asked the smallest size of each codec, then its speed."""

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
from fhash_codec.volume import decoded_type
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries

TRIALS, SLACK, BOUND_SLACK = 8, 0.05, 0.1
"""Of each search: new trials at most, and dB of quality above what is asked that end it."""
UNIFORM = 20 * math.log10(math.sqrt(3))
"""dB by which the RMSE of an even error is below the tolerance."""
RUNS, LONG_SECONDS = 3, 20.0
"""The best of so many runs counts; after so many seconds of encoding there is no further run."""
PLACES, REGION = 8, 16
"""Random places at which access is measured, and the vertices of a region along each axis."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """A trial that reached what was asked, or with `reached` unset the closest, and how to have it again."""

    codec: str
    trial: Trial
    setting: str
    reached: bool
    as_asked: bool | None
    how: Variant | EncodeConfig


class Bench:
    """One run of the bench: the data, and what has been found so far by quality asked and codec."""

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
        self.found: dict[tuple[str, float], dict[str, Found]] = {goal: {} for goal in goals}
        self.refused: dict[str, str] = {}
        self.speeds: list[Speed] = []
        self.access: list[Access] = []
        self.done, self.total = 0, 1

    def search(self, variant: Variant) -> None:
        """Find the smallest size of a variant for every goal it is tried for; the codec keeps the best of its variants."""
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
            found = Found(
                codec=variant.peer,
                trial=closest,
                setting=variant.name,
                reached=reached,
                as_asked=as_asked,
                how=variant,
            )
            self._keep((goal, asked), found)

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
        """Encode with a profile for every goal."""
        for goal, asked in self.goals:
            config = promised(settings, profile, goal, asked)
            self.done += 1
            self.progress("comparing", self.done, self.total, f"fhash {profile}")
            trial = self.own.trial(config)
            # A bound is kept in data units; dividing by the range may round the share up by its last bit.
            reached = (
                trial.psnr >= asked if goal == "psnr" else trial.max_error <= asked * (1 + 1e-12)
            )
            as_asked = reached if goal == "bound" and profile != "paper" else None
            found = Found(
                codec=f"{OWN}{profile}",
                trial=trial,
                setting=f"{OWN}{profile}",
                reached=reached,
                as_asked=as_asked,
                how=config,
            )
            self._keep((goal, asked), found)

    def _keep(self, goal: tuple[str, float], new: Found) -> None:
        """Take what was found unless the codec has something better: reached before not reached, then fewer bytes."""
        old = self.found[goal].get(new.codec)
        if old is None or (not old.reached, old.trial.bytes) > (not new.reached, new.trial.bytes):
            self.found[goal][new.codec] = new

    def points(self) -> list[Point]:
        """What was found, by goal and codec."""
        return [
            Point(
                codec=found.codec,
                goal=goal,
                asked=asked,
                reached=found.reached,
                bytes=found.trial.bytes,
                psnr=_shown(found.trial),
                max_error=found.trial.max_error,
                setting=found.setting,
                as_asked=found.as_asked,
            )
            for (goal, asked), codecs in self.found.items()
            for found in codecs.values()
        ]

    def measure_speed(self, target: float, known: Mapping[str, Sequence[Variant]]) -> None:
        """Encoding, decoding and access of every codec as it was found for a PSNR, and access to small chunks at the same PSNR."""
        codecs = self.found["psnr", target].values()
        for number, found in enumerate(codecs):
            if isinstance(found.how, EncodeConfig):
                self._speed_of_own(found, found.how)
            else:
                self._speed_of_peer(found, found.how)
                self._access_of_peer(found.how, found.trial)
                if max(self.series.shape[1:]) > SMALL_CHUNK:
                    self._small_access(small_chunks(known[found.codec]), target)
            self.progress("timing", number + 1, len(codecs), found.codec)

    def _speed_of_peer(self, found: Found, variant: Variant) -> None:
        values, path = self._values(variant), self.folder / "peer.h5"

        def encode() -> None:
            with stored(values, variant, self.range, found.trial.level, path):
                pass

        def decode() -> None:
            with opened_file(path) as file:
                read_all(file, variant)

        self._add_speed(
            found, [_timed(encode) for _ in range(RUNS)], [_timed(decode) for _ in range(RUNS)]
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

    def _speed_of_own(self, found: Found, config: EncodeConfig) -> None:
        while len(self.own.seconds[config]) < RUNS and sum(self.own.seconds[config]) < LONG_SECONDS:
            self.own.encode(config)
        self._add_speed(
            found, self.own.seconds[config], [self.own.decode(config) for _ in range(RUNS)]
        )
        self._add_access(
            found.codec,
            found.setting,
            found.trial,
            lambda step, box: self.own.read_region(config, step, box),
        )

    def _add_speed(
        self, found: Found, encoding: Sequence[float], decoding: Sequence[float]
    ) -> None:
        megabytes = self.series.values.nbytes / 1e6
        self.speeds.append(
            Speed(
                codec=found.codec,
                setting=found.setting,
                psnr=_shown(found.trial),
                encode_mb_s=megabytes / min(encoding),
                decode_mb_s=megabytes / min(decoding),
                encode_runs=len(encoding),
            )
        )

    def _add_access(
        self, codec: str, setting: str, trial: Trial, read: Callable[[int, Box], tuple[int, float]]
    ) -> None:
        """Read regions at the same places for every codec, and one before them that does not count."""
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
