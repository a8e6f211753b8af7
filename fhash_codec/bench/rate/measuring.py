"""The measurements of `fhash bench rate`: the smallest size of each codec at each quality, and
speed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.rate.clock import Spent, spent
from fhash_codec.bench.rate.coded import AnyVariant, PeerFiles, there_and_back
from fhash_codec.bench.rate.filters import SMALL_CHUNK, small_chunks
from fhash_codec.bench.rate.own import Own, promised
from fhash_codec.bench.rate.peers import Variant, filled
from fhash_codec.bench.rate.programs.program import ProgramVariant, folder_of
from fhash_codec.bench.rate.results import OWN, Access, Point, Speed, TilePrice
from fhash_codec.bench.rate.search import UNIFORM, Search, Trial, trial_of
from fhash_codec.bench.rate.timing import (
    LONG_SECONDS,
    PLACES,
    RUNS,
    Read,
    access_of,
    shown_psnr,
    speed_of,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.devices import need_torch
from fhash_codec.measure.errors import Errors
from fhash_codec.progress import Progress
from fhash_codec.volume import decoded_type
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import ArraySeries

TRIALS = 8
"""New trials of each search, at most."""
SLACK = 0.05
"""dB of PSNR above the target at which a search ends."""
BOUND_SLACK = 0.1
"""dB of the largest error below the bound at which a search ends."""
ONE_TILE_VERTICES = 12_000_000
"""Vertices that are coded as one tile at most, to find the price of tiles; of longer series some
steps in the middle."""


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
    how: AnyVariant | EncodeConfig


class Bench:
    """One run of the bench: the data, and the best trial so far by quality and codec.

    Attributes:
        price_tiles: whether the profile compact is also encoded as one tile.
    """

    price_tiles = True

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
        self.value_range, self.missing = value_range, missing
        self.range = value_range[1] - value_range[0]
        floats = np.asarray(series.values, dtype=decoded_type(series.dtype))
        self.filled: npt.NDArray[Any] = filled(floats) if missing else floats
        self.own = Own(series, self.range, folder)
        self._crop: Own | None = None
        self.best: dict[tuple[str, float], dict[str, Best]] = {goal: {} for goal in goals}
        self.refused: dict[str, str] = {}
        self.speeds: list[Speed] = []
        self.access: list[Access] = []
        self.tiles: list[TilePrice] = []
        self.done, self.total = 0, 1

    def search(self, variant: AnyVariant) -> None:
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

    def _search(self, variant: AnyVariant) -> Search:
        """The trials of a variant on these data."""
        values = self._values(variant)

        def measure(level: float) -> Trial:
            decoded, count = there_and_back(values, variant, self.range, level, self.folder)
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
            if profile == "compact" and self.price_tiles:
                self._price_tiles(goal, asked, config, trial)

    def _price_tiles(self, goal: str, asked: float, config: EncodeConfig, trial: Trial) -> None:
        """Encode as one tile, too, unless the file has one."""
        steps, *space = self.series.shape
        most = max(1, ONE_TILE_VERTICES // math.prod(space))
        own, count = self.own, trial.bytes
        if steps > most:
            own, steps = self._cropped(most), most
            count = own.trial(config).bytes
        whole = replace(config, tile="whole")
        one = count if own.has_one_tile(config) else own.trial(whole).bytes
        self.tiles.append(
            TilePrice(
                goal=goal,
                asked=asked,
                bytes=count,
                one_tile_bytes=one,
                price=count / one,
                steps=steps,
            )
        )

    def _cropped(self, steps: int) -> Own:
        """Encodings of so many steps in the middle of the series."""
        if self._crop is None:
            first = (self.series.shape[0] - steps) // 2
            folder = self.folder / "crop"
            folder.mkdir()
            values = self.series.values[first : first + steps]
            self._crop = Own(ArraySeries(values, name=self.series.name), self.range, folder)
        return self._crop

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
                psnr=shown_psnr(best.trial),
                max_error=best.trial.max_error,
                setting=best.setting,
                as_asked=best.as_asked,
            )
            for (goal, asked), codecs in self.best.items()
            for best in codecs.values()
        ]

    def measure_speed(self, target: float, variants: Mapping[str, Sequence[AnyVariant]]) -> None:
        """Measure encoding, decoding and access of each codec at its setting for a PSNR.

        Peers that are filters are also measured with small chunks at the same PSNR.
        """
        codecs = self.best["psnr", target].values()
        for number, best in enumerate(codecs):
            self.time(best)
            if isinstance(best.how, Variant) and max(self.series.shape[1:]) > SMALL_CHUNK:
                filters = [one for one in variants[best.codec] if isinstance(one, Variant)]
                self._small_access(small_chunks(filters), target)
            self.progress("timing", number + 1, len(codecs), best.codec)

    def time(self, best: Best) -> None:
        """Measure encoding, decoding and access of a trial that was kept."""
        if isinstance(best.how, EncodeConfig):
            config, own = best.how, self.own
            while (
                len(own.times[config]) < RUNS
                and sum(run.wall for run in own.times[config]) < LONG_SECONDS
            ):
                own.encode(config)
            decoding = [own.decode(config) for _ in range(RUNS)]
            self._add(best, own.times[config], decoding, partial(own.read_region, config))
            return
        with folder_of(self.folder) as folder:
            files = self._files(best.how, best.trial, folder)
            encoding = [spent(files.encode)]
            while len(encoding) < RUNS and sum(run.wall for run in encoding) < LONG_SECONDS:
                encoding.append(spent(files.encode))
            decoding = [spent(files.decode) for _ in range(RUNS)]
            self._add(best, encoding, decoding, files.read_region)

    def _add(
        self, best: Best, encoding: Sequence[Spent], decoding: Sequence[Spent], read: Read
    ) -> None:
        """Keep the speed and the access of a trial."""
        named = (best.codec, best.setting, best.trial)
        raw_bytes = self.series.values.nbytes
        self.speeds.append(speed_of(*named, raw_bytes, encoding, decoding))
        # A program decodes everything for a region, at any place.
        count = 1 if isinstance(best.how, ProgramVariant) else PLACES
        self.access.append(access_of(*named, self.series.shape, read, count))

    def _small_access(self, variant: Variant, target: float) -> None:
        try:
            trial = self._search(variant).find(
                "psnr", target, first=target - UNIFORM, slack=SLACK, most=TRIALS
            )
        except InputError as error:
            self.refused[variant.name] = str(error)
            return
        if trial is None:
            return
        with folder_of(self.folder) as folder:
            files = self._files(variant, trial, folder)
            files.encode()
            self.access.append(
                access_of(variant.peer, variant.name, trial, self.series.shape, files.read_region)
            )

    def _files(self, variant: AnyVariant, trial: Trial, folder: Path) -> PeerFiles:
        return PeerFiles(self._values(variant), variant, self.range, trial.level, folder)

    def _values(self, variant: AnyVariant) -> npt.NDArray[Any]:
        return self.series.values if variant.lossless else self.filled
