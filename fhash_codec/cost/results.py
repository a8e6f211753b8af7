"""Results of `fhash cost`, as records and JSON values, and the recommendation drawn from them."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from fhash_codec.config import PRESETS
from fhash_codec.file_info import HistoryPoint
from fhash_codec.measure.errors import StepErrors

OWN = PRESETS
"""Codecs of this package, by their presets; the others are peers."""
DEFAULT = "default settings"
"""Name of the encoding that `fhash encode` makes without options."""
TRAINING = "training"
"""Curve of the encodings that differ from the default settings in `--train` alone."""
NETWORK = "published network"
"""Name of the encoding with `--preset published` alone, and of its curve."""


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """One encoding: what was predicted, and what was measured.

    Attributes:
        name: the encoding in words, such as "effort 5, 60 dB".
        codec: the preset, or the name of a peer.
        group: the curve that the point belongs to, such as "effort 5".
        options: options of `fhash encode` that give it again; empty for a peer.
        seconds: of the whole encoding; None where it was predicted only.
        bytes: of the file; for a peer of its stored chunks.
        ratio: raw bytes over `bytes`.
        psnr: dB over all finite values.
        psnr_bulk: dB over the middle 98 % of the values.
        max_abs_error: largest error, in data units.
        exact: whether nothing differs.
        missed: whether the file misses its promise.
        region_ms: milliseconds in which the file is opened and a region of 16^3 is read.
        predicted_seconds, predicted_bytes, predicted_psnr: what was foretold; None where it was
            not.
        basis: what the prediction rests on, in words; empty without one.
    """

    name: str
    codec: str
    group: str
    options: str = ""
    seconds: float | None = None
    bytes: int | None = None
    ratio: float | None = None
    psnr: float | None = None
    psnr_bulk: float | None = None
    max_abs_error: float | None = None
    exact: bool = False
    missed: bool = False
    region_ms: float | None = None
    predicted_seconds: float | None = None
    predicted_bytes: int | None = None
    predicted_psnr: float | None = None
    basis: str = ""

    @property
    def measured(self) -> bool:
        """Whether the encoding was made, and not predicted only."""
        return self.seconds is not None

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name, and `measured`."""
        return {**asdict(self), "measured": self.measured}


@dataclass(frozen=True, kw_only=True)
class Curve:
    """The course of one training.

    Attributes:
        name: the encoding. points: the course.
    """

    name: str
    points: tuple[HistoryPoint, ...]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage of one encoding.

    Attributes:
        stage: its name. why: why it ran, or was left out.
        seconds: in it, without those of stages inside.
        times: how often it was entered; 0 for one that was left out.
    """

    stage: str
    seconds: float
    times: int
    why: str


@dataclass(frozen=True, kw_only=True)
class Gain:
    """The size of a file after a part of the search, estimated but for the last.

    Attributes:
        what: the part. bytes: the size.
        seconds: since the search began; None where the file does not tell.
    """

    what: str
    bytes: int
    seconds: float | None


@dataclass(frozen=True, kw_only=True)
class Read:
    """One kind of read from one file: medians over random places.

    Attributes:
        file: name of the encoding.
        file_psnr: dB of the whole file.
        what: kind of the read, such as "frame".
        values: number of values that one read gives.
        milliseconds: of a read, opening the file included.
        bytes_read: of the file, its directory included.
        psnr: dB of what was read against the source, with the range of the series.
        max_abs_error: largest difference, in data units.
    """

    file: str
    file_psnr: float | None
    what: str
    values: int
    milliseconds: float
    bytes_read: int
    psnr: float | None
    max_abs_error: float | None


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One picture.

    Attributes:
        group: what is varied, such as "step length" or "effect".
        setting: its value in words.
        milliseconds: median of some runs, of marching and lighting a frame that is decoded already,
            except for the group "first picture".
        counters: see `fhash_codec.rendering.march_task.COUNTERS`.
        psnr, ssim: of the picture against the best one of its group; None where the group has none,
            psnr also where nothing differs.
        best: whether the others are compared with this one.
    """

    group: str
    setting: str
    milliseconds: float
    counters: dict[str, int]
    psnr: float | None
    ssim: float | None
    best: bool = False


@dataclass(frozen=True, kw_only=True)
class Advice:
    """The best of what was measured for an accuracy.

    Attributes:
        psnr: accuracy asked for, in dB; None where `max_error_rel` is.
        max_error_rel: largest error asked for, as a fraction of the range; None where `psnr` is.
        aim: "fastest", "smallest" or "default".
        name: the encoding.
        options: options of `fhash encode` that give it.
        seconds, bytes, region_ms, reached: its figures, reached in dB; None where exact.
    """

    psnr: float | None = None
    max_error_rel: float | None = None
    aim: str
    name: str
    options: str
    seconds: float
    bytes: int
    region_ms: float | None
    reached: float | None

    @property
    def goal(self) -> str:
        """The accuracy in words."""
        if self.max_error_rel is None:
            return f"{self.psnr:g} dB"
        return f"within {100 * self.max_error_rel:g} %"


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """A thing that was not measured.

    Attributes:
        what: what. why: why. late: whether time alone was wanting.
    """

    what: str
    why: str
    late: bool = False


@dataclass(frozen=True, kw_only=True)
class CostReport:
    """Everything that `fhash cost` measured.

    Attributes:
        series: source and variable. shape: (t, z, y, x) of the whole series.
        units: of the values; may be empty. dtype: number type.
        features: of all encodings, as `fhash encode` takes them.
        measured: the part that was measured, in words. measured_shape: its shape.
        raw_bytes: of the measured part.
        value_range: smallest and largest value of it.
        budget_seconds, seconds: what was allowed, and what it took.
        interrupted: whether Ctrl-C ended it.
        curves: of the encodings that were trained.
        stages, gains: of the one encoding of a report.
        per_step: figures of each step of the one encoding of a report.
        machine: where it was measured. notes: how.
    """

    series: str
    units: str
    dtype: str
    shape: tuple[int, ...]
    features: tuple[str, ...] = ("all",)
    measured: str
    measured_shape: tuple[int, ...]
    raw_bytes: int
    value_range: tuple[float, float]
    budget_seconds: float
    seconds: float
    interrupted: bool
    encodings: tuple[Encoded, ...] = ()
    curves: tuple[Curve, ...] = ()
    stages: tuple[Stage, ...] = ()
    gains: tuple[Gain, ...] = ()
    per_step: tuple[StepErrors, ...] = ()
    reads: tuple[Read, ...] = ()
    pictures: tuple[Picture, ...] = ()
    advice: tuple[Advice, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    machine: dict[str, Any]
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        return {**asdict(self), "encodings": [entry.to_dict() for entry in self.encodings]}


TARGETS = (40.0, 45.0, 50.0, 60.0)
"""Accuracies in dB that are advised for."""
ERRORS = (0.01, 0.001)
"""Largest errors that are advised for, as fractions of the range."""
CLOSE = 5.0
"""Excess in dB up to which the fastest is looked for first: times are noisy, and sizes count."""
AS_SMALL = 1.01
"""Factor on the fewest bytes within which the fastest encoding is the smallest."""
UNITS = ("B", "kB", "MB", "GB")
"""Decimal units of sizes."""


def advise(points: Sequence[Encoded], width: float) -> tuple[Advice, ...]:
    """The best of what was measured for each accuracy, by aim.

    The aims are the fastest and the smallest encoding of this package, and the smallest with the
    default effort. Predictions do not count, and an accuracy that nothing reaches is left out. For
    a largest error only encodings count that promise one: others keep it by chance.

    Args:
        points: measured encodings, and predicted ones.
        width: of the range of the values, in data units.
    """
    own = [point for point in points if point.measured and point.codec in OWN]
    usual = next((point.group for point in own if point.name == DEFAULT), None)
    found = []
    goals = [*((psnr, None) for psnr in TARGETS), *((0.0, share) for share in ERRORS)]
    for psnr, share in goals:
        bound = math.inf if share is None else share * width * (1 + 1e-9)  # it is rounded itself
        reached = [
            point
            for point in own
            if point.exact
            or (
                (share is None or "--max-error" in point.options)
                and (point.psnr or 0.0) >= psnr
                and (math.inf if point.max_abs_error is None else point.max_abs_error) <= bound
            )
        ]
        close = [point for point in reached if _excess(point, psnr, bound) < CLOSE]
        for aim, best in (
            ("fastest", min(close or reached, key=lambda point: point.seconds or 0, default=None)),
            ("smallest", smallest(reached)),
            ("default", smallest([point for point in reached if point.group == usual])),
        ):
            if best is not None:
                names = ("name", "options", "seconds", "bytes", "region_ms")
                figures: dict[str, Any] = {name: getattr(best, name) for name in names}
                found.append(
                    Advice(
                        psnr=psnr or None,
                        max_error_rel=share,
                        aim=aim,
                        reached=best.psnr,
                        **figures,
                    )
                )
    return tuple(found)


def _excess(point: Encoded, psnr: float, bound: float) -> float:
    """Excess in dB of an encoding over the accuracy asked for, a PSNR or else a bound."""
    if psnr:
        return math.inf if point.psnr is None else point.psnr - psnr
    return 20 * math.log10(bound / point.max_abs_error) if point.max_abs_error else math.inf


def smallest(points: Sequence[Encoded]) -> Encoded | None:
    """The smallest of some measured encodings, the fastest of those of nearly its size."""
    least = min((point.bytes or 0 for point in points), default=0)
    able = [point for point in points if (point.bytes or 0) <= AS_SMALL * least]
    return min(able, key=lambda point: point.seconds or 0.0, default=None)


ADVICE = ("accuracy", "encoding", "time", "size", "16^3 region", "options")
"""Header of the table of advice."""


def advice_rows(report: CostReport) -> list[tuple[str, ...]]:
    """The table of advice: a row for each accuracy and encoding, with all its aims in one cell.

    The accuracy stands in the first of its rows alone; options leave out the features of all rows.
    The last rows are those of `by_training`.
    """
    common = " ".join(feature_options(report))
    rows: dict[tuple[str, str], list[Advice]] = {}
    for advice in report.advice:
        rows.setdefault((advice.goal, advice.name), []).append(advice)
    cells: list[tuple[str, ...]] = []
    last = ""
    for (goal, _), entries in rows.items():
        one = entries[0]
        cells.append(
            (
                "" if goal == last else goal,
                ", ".join(entry.aim for entry in entries) if len(entries) < 3 else "all three",
                seconds_text(one.seconds),
                bytes_text(one.bytes),
                "-" if one.region_ms is None else seconds_text(one.region_ms, "ms"),
                " ".join(one.options.replace(common, "").split()) or "none",
            )
        )
        last = goal
    for place, point in enumerate(by_training(report)):
        setting = "default" if point.name == DEFAULT else point.name.removeprefix(f"{TRAINING} ")
        region = "-" if point.region_ms is None else seconds_text(point.region_ms, "ms")
        size, options = bytes_text(point.bytes or 0), point.options.replace(common, "").strip()
        goal = "" if place else TRAINING
        took = seconds_text(point.seconds or 0.0)
        cells.append((goal, setting, took, size, region, options or "none"))
    return cells


def by_training(report: CostReport) -> list[Encoded]:
    """The default settings and what differs from them in its training alone, the fastest first.

    It is empty where no other training was measured.
    """
    points = [point for point in report.encodings if point.measured]
    if all(point.group != TRAINING for point in points):
        return []
    chosen = [point for point in points if point.group == TRAINING or point.name == DEFAULT]
    return sorted(chosen, key=lambda point: point.seconds or 0.0)


def feature_options(report: CostReport) -> list[str]:
    """Options that name the features of a report; none where everything is encoded."""
    if "all" in report.features:
        return []
    return [f"--feature {shlex.quote(feature)}" for feature in report.features]


def conclusion(report: CostReport) -> str:
    """One sentence on what was measured; empty where the default settings were not."""
    points = {point.name: point for point in report.encodings if point.measured}
    usual, network = points.get(DEFAULT), points.get(NETWORK)
    if usual is None:
        return ""
    data = "the data" if report.measured_shape == report.shape else "this crop of the data"
    ratio = f"{usual.ratio:,.{0 if (usual.ratio or 0) > 99 else 1}f}"
    parts = [f"The default settings make {data} {ratio} times smaller: {told(usual)}"]
    parts += [
        f"the fastest for 50 dB, {advice.options}: {told(points[advice.name])}"
        for advice in report.advice
        if (advice.psnr, advice.aim) == (50.0, "fastest") and advice.name not in (DEFAULT, NETWORK)
    ]
    peers = [point for point in points.values() if point.codec not in OWN]
    peer = smallest([each for each in peers if _excess(each, usual.psnr or math.inf, 0.0) >= 0])
    if peer is not None:
        parts.append(f"the smallest peer, {peer.codec}: {told(peer)}")
    if network is not None:
        parts.append(f"the published network: {told(network)}")
    return "; ".join(parts) + "."


def told(point: Encoded) -> str:
    """Size, time and quality of an encoding."""
    quality = ", exact" if point.exact else "" if point.psnr is None else f", {point.psnr:.1f} dB"
    return f"{bytes_text(point.bytes or 0)}, {seconds_text(point.seconds or 0.0)}{quality}"


NEAR = 1.25
"""Factor between what was predicted and what was measured up to which predictions are drawn."""


def trusted(points: Sequence[Encoded]) -> set[str]:
    """The groups whose predictions are worth drawing.

    In this run seconds and bytes of each encoding of such a group that was predicted and measured,
    at least two, lay within NEAR of its prediction.
    """
    worst: dict[str, list[float]] = {}
    for point in points:
        if point.measured and point.predicted_seconds is not None:
            pairs = (point.seconds, point.predicted_seconds), (point.bytes, point.predicted_bytes)
            ratios = [a / b if a and b else math.inf for a, b in pairs]
            worst.setdefault(point.group, []).append(max(max(ratio, 1 / ratio) for ratio in ratios))
    return {group for group, each in worst.items() if len(each) >= 2 and max(each) <= NEAR}


def seconds_text(seconds: float, unit: str = "s") -> str:
    """Seconds, or another unit of time, in two digits or whole, such as 0.43 s or 154 s."""
    return f"{seconds:.2g} {unit}" if seconds < 9.95 else f"{seconds:.0f} {unit}"


def bytes_text(count: float) -> str:
    """Bytes in three digits and decimal units."""
    for unit in UNITS:
        if count < 999.5 or unit == UNITS[-1]:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 99.95 else f"{count:.3g} {unit}"
        count /= 1000
    raise AssertionError
