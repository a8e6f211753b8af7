"""Results of `fhash cost`, as records and JSON values, and the recommendation drawn from them."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from fhash_codec.config import DEFAULT_PSNR, DEFAULT_PSNR_BULK, PRESETS, PUBLISHED
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
    """One encoding, with the figures of the whole series.

    Attributes:
        name: the encoding in words, such as "effort 5, 60 dB".
        codec: the preset, or the name of a peer.
        group: the curve that the point belongs to, such as "effort 5".
        options: options of `fhash encode` that give it again; empty for a peer.
        seconds: of the whole encoding.
        bytes: of the file; for a peer of its stored chunks.
        ratio: raw bytes over `bytes`.
        psnr: dB over all finite values; None where exact.
        psnr_bulk: dB over the middle 98 % of the values.
        max_abs_error: largest error, in data units.
        exact: whether nothing differs.
        missed: whether the file misses its promise.
        region_ms: milliseconds in which the file is opened and a region of 16^3 is read.
        seconds_range, bytes_range: lower and upper estimate where a sample was encoded, with the
            middle in `seconds` and `bytes`; None where the whole series was.
    """

    name: str
    codec: str
    group: str
    options: str = ""
    seconds: float = 0.0
    bytes: int = 0
    ratio: float | None = None
    psnr: float | None = None
    psnr_bulk: float | None = None
    max_abs_error: float | None = None
    exact: bool = False
    missed: bool = False
    region_ms: float | None = None
    seconds_range: tuple[float, float] | None = None
    bytes_range: tuple[int, int] | None = None

    def grown(
        self, seconds: tuple[float, float], sizes: tuple[float, float], raw_bytes: int
    ) -> Encoded:
        """The encoding of a whole series, from that of a sample.

        Args:
            seconds, sizes: lower and upper factor on the seconds and bytes.
            raw_bytes: of the whole series.
        """
        took = (self.seconds * seconds[0], self.seconds * seconds[1])
        size = (round(self.bytes * sizes[0]), round(self.bytes * sizes[1]))
        return replace(
            self,
            seconds=sum(took) / 2,
            seconds_range=took,
            bytes=sum(size) // 2,
            bytes_range=size,
            ratio=2 * raw_bytes / sum(size),
        )

    @property
    def seconds_text(self) -> str:
        """The seconds, or their interval, such as 40 to 66 s."""
        return _span(seconds_text, self.seconds, self.seconds_range)

    @property
    def bytes_text(self) -> str:
        """The bytes, or their interval, such as 58 to 75 kB."""
        return _span(bytes_text, self.bytes, self.bytes_range)


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
        raw_bytes: of the whole series.
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
        return asdict(self)


TARGETS = (40.0, 50.0, 60.0)
"""Accuracies in dB that are advised for."""
ERRORS = (0.01, 0.001)
"""Largest errors that are advised for, as fractions of the range."""
BOUND = "--max-error"
"""Beginning of the options that promise a largest error."""
AS_SMALL = 1.01
"""Factor on the fewest bytes within which the fastest encoding is the smallest."""
UNITS = ("B", "kB", "MB", "GB")
"""Decimal units of sizes."""


def advise(points: Sequence[Encoded], width: float) -> tuple[Advice, ...]:
    """The best of what was measured for each accuracy, by aim.

    The aims are the fastest and the smallest encoding of this package, and the smallest with the
    default effort. An encoding of a higher accuracy counts for the lower ones, too. For a PSNR only
    encodings count that promise one, and likewise for a largest error: others keep it by chance.

    Args:
        points: measured encodings.
        width: of the range of the values, in data units.
    """
    usual = next((point.group for point in points if point.name == DEFAULT), None)
    found = []
    goals = [*((psnr, None) for psnr in TARGETS), *((0.0, share) for share in ERRORS)]
    for psnr, share in goals:
        bound = math.inf if share is None else share * width * (1 + 1e-9)  # it is rounded itself
        reached = [
            point
            for point in points
            if point.codec in OWN
            and (
                point.exact
                or (
                    (share is None) != (BOUND in point.options)
                    and (point.psnr or 0.0) >= psnr
                    and (math.inf if point.max_abs_error is None else point.max_abs_error) <= bound
                )
            )
        ]
        for aim, best in (
            ("fastest", min(reached, key=_shown_seconds, default=None)),
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


def _shown_seconds(point: Encoded) -> tuple[float, int]:
    """Seconds as they are shown, and bytes, which decide between encodings of the same time."""
    return float(f"{point.seconds:.2g}"), point.bytes


def smallest(points: Sequence[Encoded]) -> Encoded | None:
    """The smallest of some encodings, the fastest of those of nearly its size."""
    least = min((point.bytes for point in points), default=0)
    able = [point for point in points if point.bytes <= AS_SMALL * least]
    return min(able, key=lambda point: point.seconds, default=None)


ADVICE = ("accuracy", "encoding", "time", "size", "16^3 region", "options")
"""Header of the table of advice."""


def advice_rows(report: CostReport) -> list[tuple[str, ...]]:
    """The table of advice: a row for each accuracy and encoding, with all its aims in one cell.

    The accuracy stands in the first of its rows alone; options leave out the features of all rows.
    The smallest encoding of each peer follows those of this package, and the published network
    those with the promise of the default settings. The last rows are those of `by_training`.
    """
    points = {point.name: point for point in report.encodings}
    groups: dict[str, list[tuple[str, ...]]] = {}
    aims: dict[tuple[str, str], list[str]] = {}
    for advice in report.advice:
        aims.setdefault((advice.goal, advice.name), []).append(advice.aim)
    for (goal, name), each in aims.items():
        aim = ", ".join(each) if len(each) < 3 else "all three"
        groups.setdefault(goal, []).append(_row(report, aim, points[name]))
    for psnr in TARGETS:
        rows = groups.setdefault(f"{psnr:g} dB", [])
        if psnr == DEFAULT_PSNR:
            rows += _network_rows(report)
        for peer in dict.fromkeys(point.codec for point in points.values()):
            best = smallest(
                [
                    point
                    for point in points.values()
                    if point.codec == peer not in OWN and (point.exact or (point.psnr or 0) >= psnr)
                ]
            )
            rows += [_row(report, peer, best)] if best else []
    groups[TRAINING] = [
        _row(report, "default" if point.name == DEFAULT else point.options.split()[-1], point)
        for point in by_training(report)
    ]
    return [
        (goal if place == 0 else "", *row)
        for goal, rows in groups.items()
        for place, row in enumerate(rows)
    ]


def _row(report: CostReport, what: str, point: Encoded) -> tuple[str, ...]:
    """The cells of an encoding after the accuracy; a peer has its layout in place of options."""
    common = " ".join(feature_options(report))
    options = " ".join(point.options.replace(common, "").split())
    if point.codec not in OWN:
        options = point.name.removeprefix(f"{point.codec} ")
    remarks = ["misses its promise"] * point.missed
    remarks += ["larger than the data"] * (point.bytes >= report.raw_bytes)
    return (
        what,
        point.seconds_text,
        point.bytes_text,
        "-" if point.region_ms is None else seconds_text(point.region_ms, "ms"),
        "; ".join([options or DEFAULT_OPTIONS, *remarks]),
    )


DEFAULT_OPTIONS = f"default: {DEFAULT_PSNR:g} dB and {DEFAULT_PSNR_BULK:g} dB of the bulk"
"""Text in place of the options of the default settings."""


def _network_rows(report: CostReport) -> list[tuple[str, ...]]:
    """The row of the published network, or of why it has no figures."""
    measured = [point for point in report.encodings if point.name == NETWORK]
    if measured:
        if any(entry.name == NETWORK and entry.psnr == DEFAULT_PSNR for entry in report.advice):
            return []
        return [_row(report, NETWORK, measured[0])]
    return [
        (NETWORK, "-", "-", "-", f"--preset {PUBLISHED}: {entry.why}")
        for entry in report.left_out
        if entry.what == NETWORK
    ]


def by_training(report: CostReport) -> list[Encoded]:
    """The default settings and what differs from them in its training alone, the fastest first.

    It is empty where no other training was measured.
    """
    points = report.encodings
    if all(point.group != TRAINING for point in points):
        return []
    chosen = [point for point in points if point.group == TRAINING or point.name == DEFAULT]
    return sorted(chosen, key=lambda point: point.seconds)


def feature_options(report: CostReport) -> list[str]:
    """Options that name the features of a report; none where everything is encoded."""
    if "all" in report.features:
        return []
    return [f"--feature {shlex.quote(feature)}" for feature in report.features]


def conclusion(report: CostReport) -> str:
    """One sentence on what was measured; empty where the default settings were not."""
    points = {point.name: point for point in report.encodings}
    usual, network = points.get(DEFAULT), points.get(NETWORK)
    if usual is None:
        return ""
    sizes = (usual.bytes,) if usual.bytes_range is None else usual.bytes_range[::-1]
    ratios = [report.raw_bytes / size for size in sizes]
    ratio = " to ".join(f"{each:,.{0 if each > 99 else 1}f}" for each in ratios)
    fastest = [
        f"Fastest that keeps {advice.goal}, {advice.options}: {told(points[advice.name])}. "
        for advice in report.advice
        if (advice.psnr, advice.aim) == (DEFAULT_PSNR, "fastest")
        and advice.name not in (DEFAULT, NETWORK)
    ]
    parts = [f"The default settings make the data {ratio} times smaller: {told(usual)}"]
    # The promise of the default, not the higher PSNR that its file may have.
    reached = min(usual.psnr or math.inf, DEFAULT_PSNR)
    better = [each for each in points.values() if each.exact or (each.psnr or 0.0) >= reached]
    peer = smallest([each for each in better if each.codec not in OWN])
    if peer is not None:
        parts.append(f"the smallest peer, {peer.codec}: {told(peer)}")
    if network is not None:
        parts.append(f"the published network: {told(network)}")
    return "".join(fastest) + "; ".join(parts) + "."


def told(point: Encoded) -> str:
    """Size, time and quality of an encoding."""
    quality = ", exact" if point.exact else "" if point.psnr is None else f", {point.psnr:.1f} dB"
    return f"{point.bytes_text}, {point.seconds_text}{quality}"


def _span(text: Callable[[float], str], value: float, ends: tuple[float, float] | None) -> str:
    """The text of a value, or of its interval."""
    if ends is None:
        return text(value)
    low, high = (text(end).split() for end in ends)
    return " ".join([*(low[:1] if low[1] == high[1] else low), "to", *high])


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
