"""Files of a cost report: a page, a PNG and JSON in a folder, all of them or none.

The plots are described once, for the page and for the PNG.
"""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from fhash_codec.cost.results import CostReport, Encoded, Picture, bytes_text, seconds_text, told
from fhash_codec.cost.uses import NOTHING
from fhash_codec.rendering.march_task import COUNTERS
from fhash_formats.errors import InputError, MissingDependencyError, OutputError, OutputExistsError
from fhash_formats.support.files import check_output, explained, replacing_all
from fhash_formats.support.values import plain_json

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


@dataclass(frozen=True)
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


@dataclass(frozen=True)
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
    traces: tuple[Trace, ...] = ()
    bars: bool = False
    diagonal: bool = False


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


SIZE = Axis("size of the file, bytes", unit="B", log=True)
"""Bytes of a file."""
READ = Axis("bytes read", unit="B", log=True)
"""Bytes that a read takes of a file."""
TIME = Axis("milliseconds", log=True)
"""Time of a read or a picture."""
Names = tuple[str, str]
"""Fields of an encoding: a figure as measured and as predicted, empty where none is predicted."""


def encode_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the encodings, empty ones included."""

    seconds, size = ("seconds", "predicted_seconds"), ("bytes", "predicted_bytes")
    psnr, bulk, largest = ("psnr", "predicted_psnr"), ("psnr_bulk", ""), ("max_abs_error", "")
    units = f", {report.units}" if report.units not in ("", "1") else ", in the units of the data"
    second, byte = Axis("seconds of encoding", log=True), SIZE
    decibel, middle = Axis("PSNR of all values, dB"), Axis("PSNR of the middle 98 %, dB")
    error = Axis(f"largest error{units}", log=True, reversed=True)
    for key, title, x, y, x_of, y_of in (
        ("encode-seconds", "Accuracy against time", second, decibel, seconds, psnr),
        ("encode-bytes", "Accuracy against size", byte, decibel, size, psnr),
        ("encode-bulk", "Accuracy of the bulk against size", byte, middle, size, bulk),
        ("encode-error", "Largest error against size", byte, error, size, largest),
    ):
        traces = tuple(_frontier(report.encodings, x_of, y_of))
        if key == "encode-seconds":
            traces += tuple(trace for trace in _trainings(report) if trace.name.startswith("paper"))
        if len(report.encodings) > 1:
            yield Panel(key, "encode", title, x, y, traces)
    yield from _courses(report)
    yield _predictions(report.encodings)


def _frontier(points: Sequence[Encoded], x_of: Names, y_of: Names) -> Iterator[Trace]:
    """A curve of measured points for each group, and one of hollow points for the rest."""
    for place, group in enumerate(dict.fromkeys(point.group for point in points)):
        for measured in (True, False):
            mine = [
                (x, y, _hover(point, measured))
                for point in points
                if point.group == group
                and (point.measured if measured else point.predicted_seconds is not None)
                and (x := getattr(point, x_of[not measured], None)) is not None
                and (y := getattr(point, y_of[not measured], None)) is not None
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
    x, y = Axis("seconds of training", log=True), Axis("PSNR on samples, dB")
    traces = tuple(_trainings(report))
    yield Panel("training", "encode", "Course of the trainings", x, y, traces)
    stages = [stage for stage in reversed(report.stages) if stage.times]
    yield single(
        Panel("stages", "encode", "Seconds of each stage", Axis("seconds"), Axis(""), bars=True),
        [stage.seconds for stage in stages],
        [stage.stage for stage in stages],
    )
    steps = [step for step in report.per_step if step["psnr"] is not None]
    yield single(
        Panel("per-step", "encode", "Accuracy of each step", Axis("step"), Axis("PSNR, dB")),
        [float(step["step"]) for step in steps],
        [step["psnr"] for step in steps],
    )


def _predictions(points: Sequence[Encoded]) -> Panel:
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
    x, y = Axis("seconds predicted", log=True), Axis("seconds measured", log=True)
    title = "Predicted and measured time"
    return Panel("predicted", "encode", title, x, y, tuple(traces), diagonal=True)


KNOBS = ("step length", "level of detail", "level of detail, first picture", "threshold")
"""Groups of pictures that trade time for likeness."""


def read_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the reads, empty ones included."""
    kinds = dict.fromkeys(read.what for read in report.reads)
    y = Axis("PSNR of what was read, dB")
    for key, title, x, field in (
        ("read-ms", "Accuracy of reads against time", TIME, "milliseconds"),
        ("read-bytes", "Accuracy of reads against bytes", READ, "bytes_read"),
    ):
        traces = []
        for place, kind in enumerate(kinds):
            points = sorted(
                (
                    float(getattr(read, field)),
                    read.psnr,
                    f"{read.what}<br>{read.file}<br>{read.milliseconds:.3g} ms,"
                    f" {bytes_text(read.bytes_read)}<br>{read.psnr:.2f} dB",
                )
                for read in report.reads
                if read.what == kind and read.psnr is not None
            )
            style = (CYCLE[place % len(CYCLE)], SYMBOLS[place % len(SYMBOLS)])
            traces.append(curve(kind, style, points, line=False))
        yield Panel(key, "read", title, x, y, tuple(trace for trace in traces if trace.x))


def picture_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the pictures, empty ones included."""
    for key, title, label, field in (
        (
            "picture-psnr",
            "Pictures: likeness against time",
            "PSNR to the finest picture, dB",
            "psnr",
        ),
        ("picture-ssim", "Pictures: SSIM against time", "SSIM to the finest picture", "ssim"),
    ):
        traces = tuple(_knobs(report.pictures, field))
        yield Panel(key, "picture", title, TIME, Axis(label), traces)
    effects = [picture for picture in reversed(report.pictures) if picture.group == "effect"]
    x, y = Axis("milliseconds"), Axis("")
    yield single(
        Panel("effects", "picture", "Effects, each alone", x, y, bars=True),
        [picture.milliseconds for picture in effects],
        [picture.setting for picture in effects],
    )
    yield _pictures_by_size(report)


def _knobs(pictures: Iterable[Picture], field: str) -> Iterator[Trace]:
    """A curve of time and likeness for each knob."""
    groups = dict.fromkeys(each.group for each in pictures if each.group in KNOBS)
    for place, group in enumerate(groups):
        points = [  # in the order of the settings: times alone may go up and down
            (each.milliseconds, value, f"{group} {each.setting}<br>{each.milliseconds:.3g} ms")
            for each in pictures
            if each.group == group and not each.best and (value := getattr(each, field)) is not None
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
    title = "Likeness to the source's picture against size"
    return Panel(
        "picture-bytes", "picture", title, SIZE, Axis("PSNR of the picture, dB"), tuple(traces)
    )


def panels(report: CostReport) -> list[Panel]:
    """Every plot for which there are points; those that compare encodings need two."""
    made = [*encode_panels(report), *read_panels(report), *picture_panels(report)]
    return [panel for panel in made if any(trace.x for trace in panel.traces)]


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of texts; the first column names the row.

    Attributes:
        section: "encode", "read", "picture" or "about".
    """

    section: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(report: CostReport) -> list[Table]:
    """Every table that has rows."""
    units = f" {report.units}" if report.units not in ("", "1") else ""
    made = (
        (
            "encode",
            "Recommendation: the best of what was measured",
            ("for dB", "aim", "encoding", "options", "seconds", "bytes", "reached dB"),
            [
                (f"{advice.psnr:g}", advice.aim, advice.name, advice.options,
                 f"{advice.seconds:.3g}", f"{advice.bytes}",
                 _number(advice.reached, ".2f", "exact"))
                for advice in report.advice
            ],
        ),
        (
            "encode",
            "Encodings",
            ("encoding", "seconds", "predicted s", "bytes", "predicted bytes", "ratio", "PSNR dB",
             "predicted dB", "PSNR bulk dB", f"largest error{units}", "options"),
            [_encoding(point) for point in report.encodings],
        ),
        (
            "encode",
            "Stages of the encoding",
            ("stage", "seconds", "times", "why"),
            [(stage.stage, f"{stage.seconds:.3g}", f"{stage.times}", stage.why)
             for stage in report.stages],
        ),
        (
            "encode",
            "Size of the file in the course of the search, estimated but for the last",
            ("after", "bytes", "seconds since the search began"),
            [(gain.what, f"{gain.bytes}", _number(gain.seconds, ".3g")) for gain in report.gains],
        ),
        (
            "read",
            "Reads",
            ("read", "from", "milliseconds", "bytes read", "values", "PSNR dB", "largest error"),
            [
                (read.what, read.file, f"{read.milliseconds:.3g}", f"{read.bytes_read}",
                 f"{read.values}", _number(read.psnr, ".2f"), _number(read.max_abs_error, ".4g"))
                for read in report.reads
            ],
        ),
        (
            "picture",
            "Pictures, with everything that was counted",
            ("varied", "setting", "milliseconds", "PSNR dB", "SSIM",
             *(name.replace("_", " ") for name in COUNTERS)),
            [_picture(picture) for picture in report.pictures],
        ),
        (
            "about",
            "Left out",
            ("what", "why"),
            [(entry.what, entry.why) for entry in report.left_out],
        ),
    )  # fmt: skip
    return [
        Table(section=section, title=title, header=header, rows=tuple(rows))
        for section, title, header, rows in made
        if rows
    ]


def _encoding(point: Encoded) -> tuple[str, ...]:
    return (
        point.name + (" (misses its promise)" if point.missed else ""),
        _number(point.seconds, ".3g"),
        _number(point.predicted_seconds, ".3g"),
        _number(point.bytes, "d"),
        _number(point.predicted_bytes, "d"),
        _number(point.ratio, ".4g"),
        "exact" if point.exact else _number(point.psnr, ".2f"),
        _number(point.predicted_psnr, ".2f"),
        _number(point.psnr_bulk, ".2f"),
        _number(point.max_abs_error, ".4g"),
        point.options,
    )


def _picture(picture: Picture) -> tuple[str, ...]:
    equal = picture.psnr is None and picture.ssim is not None and not picture.best
    return (
        picture.group,
        picture.setting + (" (the best)" if picture.best else ""),
        f"{picture.milliseconds:.3g}" if picture.milliseconds else "-",
        "equal" if equal else _number(picture.psnr, ".1f"),
        _number(picture.ssim, ".5f"),
        *(f"{picture.counters[name]}" for name in COUNTERS),
    )


def _number(value: float | None, form: str, none: str = "-") -> str:
    return none if value is None else format(value, form)


COLUMNS = 3
"""Plots beside each other."""
SHOWN = (
    "encode-seconds",
    "encode-bytes",
    "encode-bulk",
    "training",
    "stages",
    "per-step",
    "predicted",
    "read-ms",
    "read-bytes",
    "picture-psnr",
    "effects",
    "picture-bytes",
)
"""Plots of the PNG; the page has all."""
FEW_DECADES = 300
"""Ratio of the ends of a logarithmic axis up to which 2 and 5 have marks, too."""
MARKERS = {
    "circle": "o",
    "square": "s",
    "diamond": "D",
    "triangle-up": "^",
    "x": "X",
    "star": "*",
    "cross": "P",
}
"""Names of symbols in matplotlib."""


def plot(report: CostReport, path: Path) -> None:
    """Draw a report as a PNG; raises MissingDependencyError without matplotlib."""
    module = require_matplotlib()
    shown = [panel for panel in panels(report) if panel.key in SHOWN]
    columns = min(COLUMNS, max(len(shown), 1))
    rows = max(-(-len(shown) // columns), 1)
    figure = module.Figure(figsize=(5.6 * columns, 4.2 * rows + 0.4), layout="constrained", dpi=110)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid[len(shown) :]:
        axes.set_axis_off()
    for axes, panel in zip(grid, shown, strict=False):
        _draw(axes, panel)
    figure.suptitle(f"What accuracy costs: {Path(report.series).name}, {report.measured}")
    figure.savefig(path, format="png")


def _draw(axes: Any, panel: Panel) -> None:
    for trace in panel.traces:
        if panel.bars:
            axes.barh(trace.y, trace.x, color=trace.colour)
            continue
        axes.plot(
            trace.x,
            trace.y,
            marker=MARKERS[trace.symbol],
            markersize=7 if trace.symbol == "star" else 5,
            markerfacecolor="none" if trace.hollow else trace.colour,
            color=trace.colour,
            linestyle="-" if trace.line else "none",
            linewidth=1.4,
            label=trace.name,
        )
    if panel.diagonal:
        ends = [end for trace in panel.traces for end in (*trace.x, *trace.y)]
        axes.plot(*[[min(ends), max(ends)]] * 2, color="#3b3f46", linestyle=":", linewidth=1)
    _scale(axes, panel.x, "x")
    _scale(axes, panel.y, "y")
    axes.set_title(panel.title, fontsize=10)
    axes.grid(True, which="major", color="#e3e4e8", linewidth=0.8)
    axes.set_axisbelow(True)
    if len(panel.traces) > 1:
        axes.legend(frameon=False, fontsize=6.5)


def _scale(axes: Any, axis: Axis, name: str) -> None:
    """Label and scale of one axis."""
    getattr(axes, f"set_{name}label")(axis.label)
    if axis.log:
        getattr(axes, f"set_{name}scale")("log")
        side = getattr(axes, f"{name}axis")
        shown = bytes_text if axis.unit else "{:g}".format
        side.set_major_formatter(lambda value, _: shown(value))
        side.set_minor_formatter(lambda *_: "")
        low, high = sorted(getattr(axes, f"get_{name}lim")())
        marks = (1, 2, 5) if high < FEW_DECADES * low else (1,)
        ticker = importlib.import_module("matplotlib.ticker")
        side.set_major_locator(ticker.LogLocator(subs=marks, numticks=20))
    if axis.reversed:
        getattr(axes, f"invert_{name}axis")()


def require_matplotlib() -> Any:
    """The module that draws; raises MissingDependencyError."""
    return _required("matplotlib.figure", "a plot needs matplotlib")


def require_plotly() -> Any:
    """The module that holds plotly's JavaScript; raises MissingDependencyError."""
    return _required("plotly.offline", "a page of costs needs plotly")


def _required(module: str, need: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(f"{need}; pip install 'fhash[bench]'") from error


EFFECT_COUNTERS = ("gradients", "secondary_rays", "evaluations")
"""Counters of work that effects alone ask for, where a decoded frame is marched."""
SECTIONS = {"encode": "Encode", "read": "Read", "picture": "Picture", "about": "About"}
"""Headings of the page by the sections of panels and tables."""


def json_text(report: CostReport) -> str:
    """The report as JSON, as the file beside the page has it; figures without a value are null."""
    return json.dumps(plain_json(report.to_dict()), indent=1, allow_nan=False)


def page(report: CostReport) -> str:
    """The page; raises MissingDependencyError without plotly."""
    filled = {
        "title": escape(f"What accuracy costs: {report.series}"),
        "summary": _summary(report),
        "sections": "".join(_section(name, report) for name in SECTIONS),
        # JSON that may stand in a script element: no tag can end it early.
        "data": json_text(report).replace("<", "\\u003c"),
        "panels": json.dumps([*map(asdict, panels(report))]).replace("<", "\\u003c"),
        "plotly": require_plotly().get_plotlyjs(),
    }
    template = files("fhash_codec.cost").joinpath("page.html").read_text(encoding="utf-8")
    return Template(template).substitute(filled)


def _summary(report: CostReport) -> str:
    """Lines on the measurement, and the recommendation."""
    shape = " x ".join(map(str, report.measured_shape))
    facts = [
        f"{report.measured}: {shape} (t, z, y, x), {report.dtype}, {report.raw_bytes / 1e6:.3g} MB",
        f"{report.seconds:.0f} s of a budget of {report.budget_seconds:g} s"
        + (", interrupted: what was measured by then" if report.interrupted else ""),
        ", ".join(f"{name} {value}" for name, value in report.machine.items()),
    ]
    advice = "".join(f"<li>{escape(told(entry))}</li>" for entry in report.advice)
    return "".join(f"<p>{escape(fact)}</p>" for fact in facts) + (
        f"<h2>Recommendation</h2><ul class='advice'>{advice}</ul>" if advice else ""
    )


def _section(name: str, report: CostReport) -> str:
    """A heading, the places of its plots, and its tables."""
    plots = "".join(
        f'<figure class="plot" id="{panel.key}"></figure>'
        for panel in panels(report)
        if panel.section == name
    )
    lists = "".join(_table(table) for table in tables(report) if table.section == name)
    notes = ""
    if name == "about":
        notes = "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in report.notes) + "</ul>"
    if not (plots or lists or notes):
        return ""
    zeros = _zeros(report) if name == "picture" else ""
    return f'<h2>{SECTIONS[name]}</h2>{zeros}<div class="plots">{plots}</div>{lists}{notes}'


def _cell(text: str) -> str:
    """A cell of a table; numbers stand to the right."""
    try:
        float(text)
    except ValueError:
        return f"<td>{escape(text)}</td>"
    return f'<td class="number">{escape(text)}</td>'


def _zeros(report: CostReport) -> str:
    """A line on the picture without effects: all that they would take is 0."""
    plain = [each for each in report.pictures if each.setting == NOTHING]
    if not plain:
        return ""
    counts = ", ".join(
        f"{name.replace('_', ' ')} {plain[0].counters[name]}" for name in EFFECT_COUNTERS
    )
    return f"<p>An effect that is not named costs nothing. With {NOTHING}: {counts}.</p>"


def _table(table: Table) -> str:
    """A table with a button that copies it as tab-separated text."""
    header = "".join(f"<th>{escape(name)}</th>" for name in table.header)
    rows = "".join("<tr>" + "".join(_cell(text) for text in row) + "</tr>" for row in table.rows)
    return (
        f"<details open><summary>{escape(table.title)} ({len(table.rows)})</summary>"
        '<button type="button" class="copy">copy as TSV</button>'
        f'<div class="scroll"><table><thead><tr>{header}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div></details>"
    )


NAMES = ("cost.json", "cost.png", "cost.html")
"""Files of a report."""


def check_folder(folder: Path, force: bool, sources: tuple[Path, ...] = ()) -> None:
    """Check a folder before any work, and that plotly and matplotlib are there.

    The folder need not exist, but the one above it must.

    Raises InputError for a folder that is one of the sources or lies in one, OutputExistsError for
    one that holds anything while `force` is not given, OutputError for a file or where nothing can
    be written, and MissingDependencyError.
    """
    require_plotly()
    require_matplotlib()
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; name a folder for the report")
    if not folder.exists():
        check_output(folder, force, sources=sources)
        return
    if not force and any(folder.iterdir()):
        raise OutputExistsError(
            f"{folder} holds files; use --force (force=True) to write a report beside them,"
            " or name another folder"
        )
    for name in NAMES:
        check_output(folder / name, True, sources=sources)
    if any(Path(os.path.realpath(source)) == Path(os.path.realpath(folder)) for source in sources):
        raise InputError(f"{folder} is the input itself; choose another name")


def write_report(report: CostReport, folder: Path, *, force: bool = False) -> list[Path]:
    """Write a report; the paths of its page, PNG and JSON.

    force: whether files of an older report may be replaced. Other files in the folder stay. Raises
    what `check_folder` raises.
    """
    check_folder(folder, force)
    texts = {"cost.json": json_text(report) + "\n", "cost.html": page(report)}
    made = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise explained(folder, error) from error
    paths = [folder / name for name in NAMES]
    try:
        with replacing_all(paths, force=force) as temporaries:
            for name, temporary in zip(NAMES, temporaries, strict=True):
                if name in texts:
                    temporary.write_text(texts[name], encoding="utf-8")
                else:
                    plot(report, temporary)
    except BaseException:
        if made:
            with suppress(OSError):
                folder.rmdir()
        raise
    return paths[::-1]
