"""Results of `fhash cost`, as records and JSON values, and the recommendation drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from fhash_codec.file_info import HistoryPoint
from fhash_codec.measure.errors import StepErrors

OWN = ("compact", "paper")
"""Codecs of this package; the others are peers."""


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """One encoding: what was predicted, and what was measured.

    Attributes:
        name: the encoding in words, such as "compact, effort 5, 50 dB".
        codec: "compact", "paper" or the name of a peer.
        group: the curve that the point belongs to, such as "compact, effort 5".
        options: options of `fhash encode` that give it again; empty for a peer.
        seconds: of the whole encoding; None where it was predicted only.
        bytes: of the file; for a peer of its stored chunks.
        ratio: raw bytes over `bytes`.
        psnr: dB over all finite values.
        psnr_bulk: dB over the middle 98 % of the values.
        max_abs_error: largest error, in data units.
        exact: whether nothing differs.
        missed: whether the file misses its promise.
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
    """The size of a compact file after a part of the search, estimated but for the last.

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
        psnr: accuracy asked for, in dB.
        aim: "smallest" or "fastest" of this package, or "smallest peer".
        name: the encoding.
        options: options of `fhash encode` that give it; empty for a peer.
        seconds, bytes, reached: its figures, reached in dB; None where exact.
    """

    psnr: float
    aim: str
    name: str
    options: str
    seconds: float
    bytes: int
    reached: float | None


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


TARGETS = (35.0, 40.0, 45.0, 50.0, 55.0, 60.0, 70.0)
"""Accuracies in dB that are asked for."""
UNITS = ("B", "kB", "MB", "GB")
"""Decimal units of sizes."""


def advise(points: Sequence[Encoded], targets: Sequence[float] = TARGETS) -> tuple[Advice, ...]:
    """The best of what was measured for each accuracy, by aim.

    The aims are the smallest and the fastest encoding of this package, and the smallest of the
    peers. Predictions do not count. An accuracy is left out where no encoding reaches it, or where
    the same are the best for a higher one.

    Args:
        points: measured encodings, and predicted ones.
        targets: accuracies in dB over all values.
    """
    rows: list[list[Advice]] = []
    for target in sorted(targets):
        reached = [
            point
            for point in points
            if point.measured and (point.exact or (point.psnr or 0.0) >= target)
        ]
        own = [point for point in reached if point.codec in OWN]
        others = [point for point in reached if point.codec not in OWN]
        row = [
            _advice(min(chosen, key=key), target, aim)
            for aim, chosen, key in (
                ("smallest", own, _size_first),
                ("fastest", own, _time_first),
                ("smallest peer", others, _size_first),
            )
            if chosen
        ]
        if rows and [entry.name for entry in rows[-1]] == [entry.name for entry in row]:
            rows.pop()
        rows.append(row)
    return tuple(
        entry
        for row in rows
        for place, entry in enumerate(row)
        if entry.name not in [before.name for before in row[:place]]
    )


def _size_first(point: Encoded) -> tuple[float, float]:
    return point.bytes or 0, point.seconds or 0.0


def _time_first(point: Encoded) -> tuple[float, float]:
    return point.seconds or 0.0, point.bytes or 0


def _advice(best: Encoded, target: float, aim: str) -> Advice:
    """The advice to take a measured encoding."""
    return Advice(
        psnr=target,
        aim=aim,
        name=best.name,
        options=best.options,
        seconds=best.seconds or 0.0,
        bytes=best.bytes or 0,
        reached=best.psnr,
    )


def told(advice: Advice) -> str:
    """A line such as "45 dB: 1.4 s, 99 kB, the smallest: compact, effort 3, 45 dB"."""
    options = f" ({advice.options})" if advice.options else ""
    return (
        f"{advice.psnr:g} dB: {seconds_text(advice.seconds)}, {bytes_text(advice.bytes)},"
        f" the {advice.aim}: {advice.name}{options}"
    )


def seconds_text(seconds: float) -> str:
    """Seconds in two digits, such as 0.43 s or 54 s."""
    return f"{seconds:.2g} s" if seconds < 9.95 else f"{seconds:.0f} s"


def bytes_text(count: float) -> str:
    """Bytes in three digits and decimal units."""
    for unit in UNITS:
        if count < 999.5 or unit == UNITS[-1]:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 99.95 else f"{count:.3g} {unit}"
        count /= 1000
    raise AssertionError
