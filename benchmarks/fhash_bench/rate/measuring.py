"""Measurements of `fhash bench rate`: smallest size of each codec at each quality, and speed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from math import prod
from pathlib import Path
from statistics import median
from typing import Annotated, Any, TypedDict

import numpy as np
import numpy.typing as npt

import fhash_codec
from fhash_bench.rate.peers import (
    SMALL_CHUNK,
    AnyVariant,
    PeerFiles,
    ProgramVariant,
    Spent,
    folder_of,
    small_chunks,
    spent,
    there_and_back,
)
from fhash_codec.boxes import Box
from fhash_codec.config import PUBLISHED, EncodeConfig
from fhash_codec.cost.peers import EXACT, UNIFORM, Search, Trial, Variant, filled, trial_of
from fhash_codec.measure.errors import Errors
from fhash_codec.measure.value_range import decoded_type
from fhash_codec.progress import Progress
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError, QualityError
from fhash_formats.series import ArraySeries, Series

PEERS = ("SZ3", "SPERR", "ZFP", "BitRound", "Blosc")
"""Names of the peers."""
OWN = "fhash "
"""Prefix of the names of fhash's own presets among the codecs."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """The smallest size at which a codec reached a quality, or the closest it came."""

    codec: Annotated[str, "name of a peer, or 'fhash PRESET'"]
    goal: Annotated[str, "`psnr` (dB) or `bound` (share of the range)"]
    asked: Annotated[float, "the quality"]
    reached: Annotated[bool, "whether the codec reached it"]
    bytes: Annotated[int, "of the file"]
    psnr: Annotated[float | None, "dB; null where exact"]
    max_error: Annotated[float, "share of the range"]
    setting: Annotated[str, "setting in words"]
    as_asked: Annotated[bool | None, "for a bound, whether the codec's own tolerance kept it"]


@dataclass(frozen=True, kw_only=True)
class Speed:
    """Speed of a codec at a quality in 10^6 bytes of raw data a second, the best of some runs."""

    codec: Annotated[str, "as of a point"]
    setting: Annotated[str, "as of a point"]
    psnr: Annotated[float | None, "dB"]
    encode_mb_s: Annotated[float, "by the clock on the wall"]
    decode_mb_s: Annotated[float, "by the clock on the wall"]
    encode_core_mb_s: Annotated[float, "by the time of all cores, so those of one"]
    decode_core_mb_s: Annotated[float, "by the time of all cores, so those of one"]
    encode_runs: Annotated[int, "runs of encoding"]


@dataclass(frozen=True, kw_only=True)
class Access:
    """Access to a small region of one step: medians over random places."""

    codec: Annotated[str, "as of a point"]
    setting: Annotated[str, "as of a point"]
    region: Annotated[tuple[int, int, int], "lengths (z, y, x)"]
    bytes: Annotated[int, "size of all the data in this layout"]
    psnr: Annotated[float | None, "dB of all the data"]
    milliseconds: Annotated[float, "by the clock on the wall"]
    core_milliseconds: Annotated[float, "of all cores together"]
    bytes_read: Annotated[int, "bytes that one region takes"]


@dataclass(frozen=True, kw_only=True)
class TilePrice:
    """Bytes of the default tiles of fhash beside those of one tile, at a quality."""

    goal: Annotated[str, "as of a point"]
    asked: Annotated[float, "as of a point"]
    bytes: Annotated[int, "of the file as it is encoded"]
    one_tile_bytes: Annotated[int, "of a file with one tile"]
    price: Annotated[float, "the first over the second"]
    steps: Annotated[int, "of the series that were encoded for both"]


class BestPeer(TypedDict):
    """The best peer at a quality."""

    goal: Annotated[str, "`psnr` or `bound`"]
    asked: Annotated[float, "dB, or share of the range"]
    peer: Annotated[str | None, "its name; null where none reached it"]
    bytes: Annotated[int | None, "that it took"]
    ratios: Annotated[dict[str, float | None], "its bytes over those of each preset of fhash"]


@dataclass(frozen=True, kw_only=True)
class RateBench:
    """Everything that `bench_rate` measured."""

    series: Annotated[str, "source and variable"]
    shape: Annotated[tuple[int, ...], "(t, z, y, x)"]
    dtype: Annotated[str, "number type"]
    raw_bytes: Annotated[int, "size of the array"]
    value_range: Annotated[tuple[float, float], "smallest and largest value"]
    missing: Annotated[int, "number of values that are not finite"]
    points: Annotated[tuple[Point, ...], "size of each codec at each quality"]
    speeds: Annotated[tuple[Speed, ...], "speed of each codec"]
    access: Annotated[tuple[Access, ...], "access to a small region"]
    tiles: Annotated[tuple[TilePrice, ...], "price of the tiles of the default preset"]
    refused: Annotated[dict[str, str], "reasons by codec that could not be measured"]
    machine: Annotated[dict[str, Any], "date, command line, processor, load, versions and more"]
    notes: Annotated[tuple[str, ...], "how the figures were taken"]

    def best_peers(self) -> list[BestPeer]:
        """The best peer at each quality, beside fhash."""
        rows: list[BestPeer] = []
        for goal, asked in dict.fromkeys((point.goal, point.asked) for point in self.points):
            here = [point for point in self.points if (point.goal, point.asked) == (goal, asked)]
            own = [point for point in here if point.codec.startswith(OWN)]
            best = min(
                (point for point in here if point.reached and point not in own),
                key=lambda point: point.bytes,
                default=None,
            )
            ratios = {
                point.codec: best.bytes / point.bytes if best and point.reached else None
                for point in own
            }
            rows.append(
                {
                    "goal": goal,
                    "asked": asked,
                    "peer": best.codec if best else None,
                    "bytes": best.bytes if best else None,
                    "ratios": ratios,
                }
            )
        return rows

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name, and "best_peers"."""
        return {**asdict(self), "best_peers": self.best_peers()}


MEASURED = ("default", PUBLISHED)
"""Presets that are measured where none is named: one of each model."""


def promised(settings: Mapping[str, Any], preset: str, goal: str, asked: float) -> EncodeConfig:
    """Settings of a preset that promise a quality.

    Settings that belong to other presets are left out. The published network is not steered by
    quality: its settings are the same for every goal.

    Args:
        settings: settings by name.
        preset: its name.
        goal: `psnr` (dB) or `bound` (largest error as a share of the range).
        asked: the quality.
    """
    published = preset == PUBLISHED
    others = {
        field.name
        for field in dataclasses.fields(EncodeConfig)
        if field.metadata.get("published", published) is not published
    }
    own = {name: value for name, value in settings.items() if name not in others}
    if published:
        return EncodeConfig.from_dict({"tables": "float16"} | own | {"preset": preset})
    promise = {"psnr" if goal == "psnr" else "max_error_rel": asked}
    return EncodeConfig.from_dict(own | {"preset": preset} | promise)


class Own:
    """Encodings of one series, each made once, and their figures.

    Attributes:
        times: of each encoding so far, by its settings.
    """

    def __init__(self, series: Series, data_range: float, folder: Path) -> None:
        """Prepare encodings of a series.

        data_range: range of the series. folder: place of the files, which the caller removes.
        """
        self._series = series
        self._range = data_range
        self._folder = folder
        self._paths: dict[EncodeConfig, Path] = {}
        self._trials: dict[EncodeConfig, Trial] = {}
        self.times: dict[EncodeConfig, list[Spent]] = {}

    def encode(self, config: EncodeConfig) -> None:
        """Encode once more, and keep how long it took."""
        path = self._paths.setdefault(config, self._folder / f"{len(self._paths)}.fhz")

        def encode() -> None:
            try:
                fhash_codec.encode(self._series, path, config, force=True)
            except QualityError as error:  # what it reaches is measured
                Path(error.figures["path"]).replace(path)

        self.times.setdefault(config, []).append(spent(encode))

    def has_one_tile(self, config: EncodeConfig) -> bool:
        """Whether the file with these settings, but for published, has a single tile."""
        with open_volume(self._paths[config]) as volume:
            table = volume.container.arrays["table_1"]
            return prod(table.grid) == 1

    def trial(self, config: EncodeConfig) -> Trial:
        """Figures of the file with these settings, from every decoded frame."""
        if config not in self._trials:
            self.encode(config)
            errors = Errors(self._range)
            with open_volume(self._paths[config]) as volume:
                for step in range(volume.shape[0]):
                    errors.add(step, self._series.read(step), volume.read(step))
            self._trials[config] = trial_of(errors, 0.0, self._paths[config].stat().st_size)
        return self._trials[config]

    def decode(self, config: EncodeConfig) -> Spent:
        """Open the file and decode all of it; what it took."""

        def decode() -> None:
            with open_volume(self._paths[config]) as volume:
                volume.read_steps(range(volume.shape[0]))

        return spent(decode)

    def read_region(self, config: EncodeConfig, step: int, region: Box) -> tuple[int, Spent]:
        """Read a region of one step of the file; bytes read of it, and seconds after opening."""
        with open_volume(self._paths[config]) as volume:
            seconds = spent(lambda: volume.read(step, region))
            return volume.container.bytes_read, seconds


RUNS = 3
"""Runs of which the best counts."""
LONG_SECONDS = 20.0
"""Seconds of encoding after which there is no further run."""
PLACES = 8
"""Random places at which access is measured."""
REGION = 16
"""Vertices of a region along each axis."""

Read = Callable[[int, Box], tuple[int, Spent]]
"""A function of a step and a region: bytes read, and seconds."""


def shown_psnr(trial: Trial) -> float | None:
    """PSNR in dB, None where nothing differs."""
    return None if trial.psnr == EXACT else trial.psnr


def speed_of(
    codec: str,
    setting: str,
    trial: Trial,
    raw_bytes: int,
    encoding: Sequence[Spent],
    decoding: Sequence[Spent],
) -> Speed:
    """The speed of the fastest runs, on the wall and by the processor each."""
    megabytes = raw_bytes / 1e6
    return Speed(
        codec=codec,
        setting=setting,
        psnr=shown_psnr(trial),
        encode_mb_s=megabytes / min(run.wall for run in encoding),
        decode_mb_s=megabytes / min(run.wall for run in decoding),
        encode_core_mb_s=megabytes / min(run.core for run in encoding),
        decode_core_mb_s=megabytes / min(run.core for run in decoding),
        encode_runs=len(encoding),
    )


def random_regions(shape: Sequence[int], count: int = PLACES) -> Iterator[tuple[int, Box]]:
    """Yield steps and regions of a series (t, z, y, x): one to warm up, and `count` others."""
    rng = np.random.default_rng(0)
    steps, *space = shape
    size = [min(REGION, n) for n in space]
    for _ in range(count + 1):
        low = [int(rng.integers(0, n - length + 1)) for n, length in zip(space, size, strict=True)]
        step = int(rng.integers(0, steps))
        yield step, Box.of_shape(size).shift(low)


def access_of(
    codec: str, setting: str, trial: Trial, shape: Sequence[int], read: Read, count: int = PLACES
) -> Access:
    """Access to regions at the same places for every codec: medians over them.

    shape: of the series (t, z, y, x). count: of the places.
    """
    measured = [read(step, box) for step, box in random_regions(shape, count)][1:]
    z, y, x = (min(REGION, n) for n in shape[1:])
    return Access(
        codec=codec,
        setting=setting,
        region=(z, y, x),
        bytes=trial.bytes,
        psnr=shown_psnr(trial),
        milliseconds=1000 * median(seconds.wall for _, seconds in measured),
        core_milliseconds=1000 * median(seconds.core for _, seconds in measured),
        bytes_read=round(median(touched for touched, _ in measured)),
    )


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
        price_tiles: whether the default preset is also encoded as one tile.
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

    def search_preset(self, settings: Mapping[str, Any], preset: str) -> None:
        """Encode with a preset for every goal."""
        for goal, asked in self.goals:
            config = promised(settings, preset, goal, asked)
            self.done += 1
            self.progress("comparing", self.done, self.total, f"{OWN}{preset}")
            trial = self.own.trial(config)
            # A bound is kept in data units; the division by the range may round the share up.
            reached = (
                trial.psnr >= asked if goal == "psnr" else trial.max_error <= asked * (1 + 1e-12)
            )
            as_asked = reached if goal == "bound" and not config.published else None
            best = Best(
                codec=f"{OWN}{preset}",
                trial=trial,
                setting=f"{OWN}{preset}",
                reached=reached,
                as_asked=as_asked,
                how=config,
            )
            self._keep((goal, asked), best)
            if preset == "default" and self.price_tiles:
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
