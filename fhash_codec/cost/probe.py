"""Encodings of a part of a series, by which those of the whole are predicted."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory

from fhash_codec.boxes import Box
from fhash_codec.comparison import EncodeReport
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.plan import Facts, cropped
from fhash_codec.encoding import encode
from fhash_codec.features.bricks import BRICK_BITS
from fhash_codec.features.scan import scan
from fhash_codec.paper.train import HISTORY_POINTS, usual_batches, usual_epochs
from fhash_codec.progress import OTHER, silent
from fhash_formats.errors import FhashWarning, InputError, QualityError
from fhash_formats.series import Series, StepsSeries

now: Callable[[], float] = time.perf_counter
"""Clock of all probes, in seconds."""

WINDOW_STEPS = 8
"""Successive steps of each part of a series: those of a usual tile."""
PLANNED_VERTICES = 1 << 21
"""Vertices from which on planning takes the same time: the planner looks at about as many."""
CODED_VERTICES = 12 << 20
"""Vertices of a series that is coded as a whole to choose a head or a predictor."""
ONCE = ("opening", "engine")
"""Stages that take the same time for a part of a series."""
PLANNING = ("plan", "step", "labels", "head trial")
"""Stages that look at PLANNED_VERTICES at most."""
CHOOSING = ("head", "predictor")
"""Stages that train on a sample, and code CODED_VERTICES at most."""
FIXED_BYTES = ("model", "index")
"""Parts of a file that hardly grow with the number of steps."""


def windows_of(series: Series, vertices: int, share: float = 1.0) -> Series:
    """Return some windows of successive steps, evenly spread, or all of a series that is small.

    vertices: of the windows at most, but for a single step. share: of the steps at most.
    """
    steps = series.shape[0]
    count = max(1, min(vertices // prod(series.shape[1:]), int(share * steps)))
    if steps <= count:
        return series
    window = min(WINDOW_STEPS, count)
    windows = count // window
    starts = [(2 * number + 1) * (steps - window) // (2 * windows) for number in range(windows)]
    return StepsSeries(series, sorted({start + n for start in starts for n in range(window)}))


def part_of(series: Series, share: float) -> Series:
    """Return the part of a series that is encoded as a probe: windows, or a crop of large frames.

    share: of the steps at most.
    """
    if prod(series.shape[1:]) > PLANNED_VERTICES:
        return cropped(series, PLANNED_VERTICES)
    return windows_of(series, PLANNED_VERTICES, share)


def promise_of_part(config: EncodeConfig, part: Series, series: Series) -> EncodeConfig:
    """Return settings that allow the values of a part the errors promised for the whole series.

    A PSNR and a relative bound refer to the range of the values, which is wider in the whole. Some
    of its steps tell it.
    """
    relative = config.max_error_rel is not None or (config.psnr and config.psnr_bulk is None)
    if part is series or not relative:
        return config
    steps = series.shape[0]
    spread = sorted({(2 * n + 1) * steps // (2 * WINDOW_STEPS) for n in range(WINDOW_STEPS)})
    ranges = [scan(each, silent).value_range for each in (part, StepsSeries(series, spread))]
    width = ranges[0].high - ranges[0].low
    whole = max(each.high for each in ranges) - min(each.low for each in ranges)
    if not 0 < width < whole < math.inf:
        return config
    return of_width(config, 20 * math.log10(whole / width))


def of_width(config: EncodeConfig, decibels: float) -> EncodeConfig:
    """Return settings that allow a part the errors promised for the whole series.

    decibels: width of the range of the whole over that of the part.
    """
    if config.max_error_rel is not None:
        relative = config.max_error_rel * math.pow(10.0, decibels / 20)
        return replace(config, max_error_rel=min(relative, 1.0))
    if config.psnr is None:
        return config
    return replace(config, psnr=max(config.psnr - decibels, 0.0))


@dataclass(frozen=True, kw_only=True)
class CompactProbe:
    """An encoding of a part of a series with another preset than published.

    Attributes:
        vertices: of the part.
        stages: seconds of each stage.
        fixed_bytes, growing_bytes: of the file; the latter grow with the number of vertices.
        psnr: in dB over the coreset; None for exact values.
    """

    vertices: int
    stages: Mapping[str, float]
    fixed_bytes: int
    growing_bytes: int
    psnr: float | None

    def stage_seconds(self, vertices: int) -> dict[str, float]:
        """Return the predicted seconds of each stage for a series of so many vertices."""
        return {name: self._growth(name, vertices) * took for name, took in self.stages.items()}

    def bytes(self, vertices: int) -> int:
        """Return the predicted bytes of the file of a series of so many vertices."""
        return self.fixed_bytes + round(self.growing_bytes * vertices / self.vertices)

    def _growth(self, stage: str, vertices: int) -> float:
        """The factor by which a stage takes longer for a series of so many vertices.

        Below its limit, work on a sample grows, but less than the series: the square root is off by
        the same factor whether it stays as it is or grows in proportion.
        """

        def ratio(limit: float = math.inf) -> float:
            return min(vertices, limit) / min(self.vertices, limit)

        if stage in ONCE:
            return 1.0
        if stage in PLANNING:
            return math.sqrt(ratio(PLANNED_VERTICES))
        if stage in CHOOSING:
            return math.sqrt(ratio(CODED_VERTICES)) * ratio() / ratio(CODED_VERTICES)
        return ratio()


def probe_compact(part: Series, config: EncodeConfig) -> CompactProbe:
    """Encode a part of a series; raises InputError for settings that do not fit it."""
    with TemporaryDirectory() as folder:
        report = reported(part, Path(folder) / "part.fhz", replace(config, timings=True))
    fixed = sum(report["split"][name] for name in FIXED_BYTES)
    return CompactProbe(
        vertices=prod(part.shape),
        stages={entry["stage"]: entry["seconds"] for entry in report["stages"] if entry["times"]},
        fixed_bytes=fixed,
        growing_bytes=report["bytes"] - fixed,
        psnr=report["psnr"] if report["rmse"] else None,
    )


def sample_of(series: Series, vertices: int, around: Box) -> Series:
    """Return windows of steps with whole frames, a crop where there are few, or all of a small one.

    vertices: of the sample, about. around: box (z, y, x) around whose middle a crop lies.
    """
    if vertices >= prod(series.shape):
        return series
    if vertices >= 2 * WINDOW_STEPS * prod(series.shape[1:]):
        return windows_of(series, vertices)
    return cropped(series, vertices, around)


WITHIN = 2.0
"""Factor on growth in proportion within which the seconds of the whole stay, and below which its
bytes may be: samples of a few steps lack what later steps share with them."""
SMALLER = 4
"""Vertices of a sample over those of the smaller one to which it is compared."""
Range = tuple[float, float]
"""Lower and upper end."""


def growth_powers(sample: Series, facts: Facts, config: EncodeConfig) -> tuple[float, float]:
    """Return the powers of the number of vertices with which seconds and bytes grow; 1 as it does.

    A sample and a part of it are encoded with the same error.

    facts: with the range of the whole series. config: quick settings with a PSNR.
    """
    part = sample_of(sample, prod(sample.shape) // SMALLER, Box.of_shape(sample.shape[1:]))
    figures = []
    for series in (sample, part):
        found = scan(series, silent).value_range
        width = found.high - found.low
        asked = of_width(config, 20 * math.log10(facts.width / width) if width else 0.0)
        with TemporaryDirectory() as folder:
            try:
                report = reported(series, Path(folder) / "part.fhz", asked)
            except InputError:  # nothing of the features is in the part
                return 1.0, 1.0
        figures.append((report["seconds"], report["bytes"]))
    ratio = prod(sample.shape) / prod(part.shape)
    if ratio == 1:  # it is too small to be divided
        return 1.0, 1.0
    seconds, sizes = (math.log(a / b) / math.log(ratio) for a, b in zip(*figures, strict=True))
    return seconds, sizes


def growth_factors(powers: tuple[float, float], scale: float) -> tuple[Range, Range]:
    """Return factors from a sample to the whole, lower and upper, on seconds and on bytes.

    Bytes grow as from the part to the sample at least, and in proportion at most. Smooth data
    grow less than in proportion: a file of one large part is smaller than those of its pieces.
    The factor WITHIN is always included.

    powers: of `growth_powers`. scale: vertices of the whole over those of the sample, 1 or more.
    """
    seconds, sizes = (sorted((max(math.pow(scale, power), 1.0), scale)) for power in powers)
    return (
        (min(seconds[0], scale / WITHIN), max(seconds[1], scale * WITHIN)),
        (max(min(sizes[0], scale / WITHIN), 1.0), sizes[1]),
    )


EPOCHS = 2
"""Epochs of the probe."""


@dataclass(frozen=True, kw_only=True)
class PaperProbe:
    """An encoding of two epochs.

    Attributes:
        stages: seconds of each stage but the training, for the whole series.
        step: seconds of a training step.
        curve: seconds of a measurement after an epoch.
        samples: samples of the coreset, of the whole series.
        bricks: bricks that hold them, at most.
        bytes: of the file for the whole series.
    """

    stages: Mapping[str, float]
    step: float
    curve: float
    samples: int
    bricks: int
    bytes: int

    def stage_seconds(self, config: EncodeConfig) -> dict[str, float]:
        """Return the predicted seconds of each stage, for settings that differ in epochs alone."""
        batches = usual_batches(self.samples, self.bricks, config.batch)
        epochs = config.epochs or usual_epochs(batches)
        points = len(range(0, epochs, -(-epochs // HISTORY_POINTS)))
        return {
            **self.stages,
            "training": epochs * batches * self.step,
            "curve": points * self.curve,
        }

    def of_share(self, share: float, batch: int = 0) -> PaperProbe:
        """The probe of a share of the series, or above 1 of a larger one.

        batch: as in EncodeConfig.
        """
        samples, bricks = (max(1, round(count * share)) for count in (self.samples, self.bricks))
        before, after = (
            usual_batches(*counts, batch)
            for counts in ((self.samples, self.bricks), (samples, bricks))
        )
        return replace(
            self,
            stages={
                name: seconds if name in (*ONCE, OTHER) else seconds * share
                for name, seconds in self.stages.items()
            },
            # A step takes as long as it has samples.
            step=self.step * (samples / after) / (self.samples / before),
            samples=samples,
            bricks=bricks,
            bytes=round(self.bytes * share),
        )


def probe_paper(part: Series, share: float, config: EncodeConfig) -> PaperProbe:
    """Encode a part of a series for two epochs, with batches of its size; the probe of the whole.

    share: share of the series that the part is.
    """
    config = replace(config, epochs=EPOCHS, psnr=None, psnr_bulk=None, timings=True)
    with TemporaryDirectory() as folder:
        report = reported(part, Path(folder) / "part.fhz", config)
    stages = {entry["stage"]: entry["seconds"] for entry in report["stages"]}
    training, curve = stages.pop("training", 0.0), stages.pop("curve", 0.0)
    keys = len(report["key_frames"])
    vertices = prod(hi - lo for lo, hi in report["feature_bounding_box"]) * keys
    samples = max(1, round(report["coreset_fraction"] * prod(part.shape[1:]) * keys))
    bricks = max(1, vertices >> sum(BRICK_BITS))
    first, last = (point["seconds"] or 0.0 for point in (report["curve"][0], report["curve"][-1]))
    second = min(max(last - first - curve / EPOCHS, 0.0), training)
    return PaperProbe(
        stages=stages,
        step=second / usual_batches(samples, bricks, config.batch),
        curve=curve / EPOCHS,
        samples=samples,
        bricks=bricks,
        bytes=report["bytes"],
    ).of_share(1 / share, config.batch)


def reported(part: Series, path: Path, config: EncodeConfig) -> EncodeReport:
    """The report of an encoding, without warnings, also where it misses its promise."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        try:
            return encode(part, path, config)
        except QualityError as error:
            figures: EncodeReport = error.figures
            return figures
