"""Plots of a cost report, described once for the page and for the PNG."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from fhash_codec.cost.results import CostReport, Encoded, Picture, bytes_text, seconds_text

STYLES: dict[str, tuple[str, str]] = {
    "compact, effort 1": ("#56B4E9", "circle"),
    "compact, effort 2": ("#56B4E9", "diamond"),
    "compact, effort 3": ("#2583C4", "circle"),
    "compact, effort 5": ("#D55E00", "circle"),
    "compact, effort 7": ("#D55E00", "diamond"),
    "compact, effort 9": ("#D55E00", "star"),
    "paper": ("#CC79A7", "star"),
    "SZ3": ("#009E73", "square"),
    "SPERR": ("#E69F00", "triangle-up"),
    "ZFP": ("#8A8F98", "x"),
}
"""Colour, after Okabe and Ito (told apart by colour-blind people), and symbol of each curve."""
CYCLE = ("#2583C4", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8A8F98")
"""Colours of curves that have none of their own."""
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "x", "star", "cross")
"""Symbols of curves that have none of their own."""


@dataclass(frozen=True, kw_only=True)
class Axis:
    """An axis.

    Attributes:
        label: what it shows, with its unit.
        log: whether it is logarithmic. reversed: whether small values lie above.
        unit: "B" for bytes, which are shown as kB and MB; empty for plain numbers.
    """

    label: str
    unit: str = ""
    log: bool = False
    reversed: bool = False


@dataclass(frozen=True, kw_only=True)
class Trace:
    """A curve, or bars where its panel has bars.

    Attributes:
        x, y: numbers; x of bars are lengths, y their names.
        text: what the mouse shows at each point.
        hollow: whether the points are predictions.
        line: whether the points are joined.
    """

    name: str
    colour: str
    symbol: str
    x: tuple[float, ...]
    y: tuple[float | str, ...]
    text: tuple[str, ...]
    hollow: bool = False
    line: bool = True


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A plot.

    Attributes:
        section: "encode", "read" or "picture".
        bars: whether the traces are horizontal bars.
        diagonal: whether a line shows where x equals y.
    """

    key: str
    section: str
    title: str
    x: Axis
    y: Axis
    traces: tuple[Trace, ...]
    bars: bool = False
    diagonal: bool = False

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        return asdict(self)


def style_of(name: str, place: int) -> tuple[str, str]:
    """Colour and symbol of a curve, by its name or its place."""
    return STYLES.get(name, (CYCLE[place % len(CYCLE)], SYMBOLS[place % len(SYMBOLS)]))


def curve(
    name: str, style: tuple[str, str], points: Iterable[tuple[float, Any, str]], **more: bool
) -> Trace:
    """A curve of points (x, y, text), in a colour and with a symbol."""
    x, y, text = tuple(zip(*points, strict=True)) or ((), (), ())
    return Trace(name=name, colour=style[0], symbol=style[1], x=x, y=y, text=text, **more)


def single(panel: Panel, x: Sequence[float], y: Sequence[Any]) -> Panel:
    """A panel with one curve, or with bars of one colour."""
    points = [
        (a, b, f"{b}<br>{a:.4g} {panel.x.label}" if panel.bars else f"{a:.6g}: {b:.4g}")
        for a, b in zip(x, y, strict=True)
    ]
    return replace(panel, traces=(curve("", (CYCLE[0], SYMBOLS[0]), points),))


Pick = Callable[[Encoded, bool], float | None]
"""Figure of an encoding, as measured or as predicted."""


def encode_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the encodings, empty ones included."""

    def seconds(point: Encoded, measured: bool) -> float | None:
        return point.seconds if measured else point.predicted_seconds

    def size(point: Encoded, measured: bool) -> float | None:
        return point.bytes if measured else point.predicted_bytes

    def psnr(point: Encoded, measured: bool) -> float | None:
        return point.psnr if measured else point.predicted_psnr

    def bulk(point: Encoded, measured: bool) -> float | None:
        return point.psnr_bulk if measured else None

    def largest(point: Encoded, measured: bool) -> float | None:
        return point.max_abs_error if measured else None

    units = f", {report.units}" if report.units not in ("", "1") else ", in the units of the data"
    second, byte = (
        Axis(label="seconds of encoding", log=True),
        Axis(label="size of the file, bytes", unit="B", log=True),
    )
    decibel = Axis(label="PSNR of all values, dB")
    for key, title, x, y, x_of, y_of in (
        ("encode-seconds", "Accuracy against time", second, decibel, seconds, psnr),
        ("encode-bytes", "Accuracy against size", byte, decibel, size, psnr),
        (
            "encode-bulk",
            "Accuracy of the bulk against size",
            byte,
            Axis(label="PSNR of the middle 98 %, dB"),
            size,
            bulk,
        ),
        (
            "encode-error",
            "Largest error against size",
            byte,
            Axis(label=f"largest error{units}", log=True, reversed=True),
            size,
            largest,
        ),
    ):
        traces = tuple(_frontier(report.encodings, x_of, y_of))
        if key == "encode-seconds":
            traces += tuple(trace for trace in _trainings(report) if trace.name.startswith("paper"))
        if len(report.encodings) > 1:
            yield Panel(key=key, section="encode", title=title, x=x, y=y, traces=traces)
    yield from _courses(report)
    yield _foretold(report.encodings)


def _frontier(points: Sequence[Encoded], x_of: Pick, y_of: Pick) -> Iterator[Trace]:
    """A curve of measured points for each group, and one of hollow points for the rest."""
    for place, group in enumerate(dict.fromkeys(point.group for point in points)):
        for measured in (True, False):
            mine = [
                (x, y, _hover(point, measured))
                for point in points
                if point.group == group
                and (point.measured if measured else point.predicted_seconds is not None)
                and (x := x_of(point, measured)) is not None
                and (y := y_of(point, measured)) is not None
                and x > 0
            ]
            if mine:
                mine.sort(key=lambda point: (point[1], point[0]))
                name = group if measured else f"{group}, predicted"
                style = style_of(group, place)
                yield curve(name, style, mine, hollow=not measured, line=measured)


def _hover(point: Encoded, measured: bool) -> str:
    """Text that the mouse shows at an encoding."""
    seconds, count, psnr = (
        (point.seconds, point.bytes, point.psnr)
        if measured
        else (point.predicted_seconds, point.predicted_bytes, point.predicted_psnr)
    )
    parts = [
        point.name if measured else f"{point.name}, predicted",
        "" if seconds is None else seconds_text(seconds),
        "" if count is None else bytes_text(count),
        "" if psnr is None else f"{psnr:.2f} dB",
        "misses its promise" if measured and point.missed else "",
    ]
    return "<br>".join(part for part in parts if part)


def _trainings(report: CostReport) -> Iterator[Trace]:
    """A curve of accuracy on samples against seconds for each training."""
    for place, training in enumerate(report.curves):
        name = training.name
        points = [
            (
                float(point["seconds"]),
                float(point["psnr"]),
                f"{name}<br>epoch or update {point['epoch']:g}",
            )
            for point in training.points
            if point["seconds"] and point["psnr"] is not None
        ]
        style = style_of(name, place)
        if name.startswith("paper"):
            style = (style_of("paper", place)[0], "cross")
        if points:
            yield curve(f"{name}, in training", style, points)


def _courses(report: CostReport) -> Iterator[Panel]:
    """The trainings, and what the stages and steps of one encoding have."""
    yield Panel(
        key="training",
        section="encode",
        title="Course of the trainings",
        x=Axis(label="seconds of training", log=True),
        y=Axis(label="PSNR on samples, dB"),
        traces=tuple(_trainings(report)),
    )
    stages = [stage for stage in reversed(report.stages) if stage.times]
    yield single(
        Panel(
            key="stages",
            section="encode",
            title="Seconds of each stage",
            x=Axis(label="seconds"),
            y=Axis(label=""),
            traces=(),
            bars=True,
        ),
        [stage.seconds for stage in stages],
        [stage.stage for stage in stages],
    )
    steps = [step for step in report.per_step if step["psnr"] is not None]
    yield single(
        Panel(
            key="per-step",
            section="encode",
            title="Accuracy of each step",
            x=Axis(label="step"),
            y=Axis(label="PSNR, dB"),
            traces=(),
        ),
        [float(step["step"]) for step in steps],
        [step["psnr"] for step in steps],
    )


def _foretold(points: Sequence[Encoded]) -> Panel:
    """Seconds that were predicted beside those measured."""
    traces = []
    for place, group in enumerate(dict.fromkeys(point.group for point in points)):
        mine = sorted(
            (point.predicted_seconds, point.seconds, point.name)
            for point in points
            if point.group == group and point.seconds and point.predicted_seconds
        )
        if mine:
            told = [
                (a, b, f"{name}<br>predicted {a:.3g} s, took {b:.3g} s ({b / a:.2f} x)")
                for a, b, name in mine
            ]
            traces.append(curve(group, style_of(group, place), told, line=False))
    return Panel(
        key="predicted",
        section="encode",
        title="Predicted and measured time",
        x=Axis(label="seconds predicted", log=True),
        y=Axis(label="seconds measured", log=True),
        traces=tuple(traces),
        diagonal=True,
    )


KNOBS = ("step length", "level of detail", "level of detail, first picture", "threshold")
"""Groups of pictures that trade time for likeness."""


def read_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the reads, empty ones included."""
    kinds = dict.fromkeys(read.what for read in report.reads)
    for key, title, x, pick in (
        ("read-ms", "Accuracy of reads against time", Axis(label="milliseconds", log=True), 0),
        (
            "read-bytes",
            "Accuracy of reads against bytes",
            Axis(label="bytes read", unit="B", log=True),
            1,
        ),
    ):
        traces = []
        for place, kind in enumerate(kinds):
            points = sorted(
                (
                    (read.milliseconds, float(read.bytes_read))[pick],
                    read.psnr,
                    f"{read.what}<br>{read.file}<br>{read.milliseconds:.3g} ms,"
                    f" {bytes_text(read.bytes_read)}<br>{read.psnr:.2f} dB",
                )
                for read in report.reads
                if read.what == kind and read.psnr is not None
            )
            style = (CYCLE[place % len(CYCLE)], SYMBOLS[place % len(SYMBOLS)])
            traces.append(curve(kind, style, points, line=False))
        yield Panel(
            key=key,
            section="read",
            title=title,
            x=x,
            y=Axis(label="PSNR of what was read, dB"),
            traces=tuple(trace for trace in traces if trace.x),
        )


def picture_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the pictures, empty ones included."""
    for key, title, y, pick in (
        ("picture-psnr", "Pictures: likeness against time", "PSNR to the finest picture, dB", 0),
        ("picture-ssim", "Pictures: SSIM against time", "SSIM to the finest picture", 1),
    ):
        yield Panel(
            key=key,
            section="picture",
            title=title,
            x=Axis(label="milliseconds", log=True),
            y=Axis(label=y),
            traces=tuple(_knobs(report.pictures, pick)),
        )
    effects = [picture for picture in report.pictures if picture.group == "effect"]
    yield single(
        Panel(
            key="effects",
            section="picture",
            title="Effects, each alone",
            x=Axis(label="milliseconds"),
            y=Axis(label=""),
            traces=(),
            bars=True,
        ),
        [picture.milliseconds for picture in reversed(effects)],
        [picture.setting for picture in reversed(effects)],
    )
    yield _pictures_by_size(report)


def _knobs(pictures: Iterable[Picture], pick: int) -> Iterator[Trace]:
    """A curve of time and likeness for each knob."""
    groups = dict.fromkeys(each.group for each in pictures if each.group in KNOBS)
    for place, group in enumerate(groups):
        points = [  # in the order of the settings: times alone may go up and down
            (each.milliseconds, value, f"{group} {each.setting}<br>{each.milliseconds:.3g} ms")
            for each in pictures
            if each.group == group
            and not each.best
            and (value := (each.psnr, each.ssim)[pick]) is not None
        ]
        if points:
            yield curve(group, (CYCLE[place], SYMBOLS[place]), points)


def _pictures_by_size(report: CostReport) -> Panel:
    """Likeness of the pictures of files to that of the source, against the size of the files."""
    sizes = {point.name: point for point in report.encodings if point.bytes}
    shown = [
        (sizes[each.setting], each)
        for each in report.pictures
        if each.group == "encoding" and each.setting in sizes and each.psnr is not None
    ]
    traces = []
    for place, group in enumerate(dict.fromkeys(point.group for point, _ in shown)):
        mine = sorted(
            (
                float(point.bytes or 0),
                float(each.psnr or 0.0),
                f"{each.setting}<br>{bytes_text(point.bytes or 0)}"
                f"<br>picture {each.psnr:.1f} dB, SSIM {each.ssim:.4f}",
            )
            for point, each in shown
            if point.group == group
        )
        traces.append(curve(group, style_of(group, place), mine))
    return Panel(
        key="picture-bytes",
        section="picture",
        title="Likeness to the source's picture against size",
        x=Axis(label="size of the file, bytes", unit="B", log=True),
        y=Axis(label="PSNR of the picture, dB"),
        traces=tuple(traces),
    )


def panels(report: CostReport) -> list[Panel]:
    """Every plot for which there are points; those that compare encodings need two."""
    made = [*encode_panels(report), *read_panels(report), *picture_panels(report)]
    return [panel for panel in made if any(trace.x for trace in panel.traces)]
