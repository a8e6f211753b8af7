"""Files of a cost report: a page, a PNG and JSON in a folder, all of them or none."""

from __future__ import annotations

import importlib
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from fhash_codec.cost.panels import Axis, Panel, panels
from fhash_codec.cost.results import CostReport, Encoded, Picture, bytes_text, told
from fhash_codec.cost.uses import NOTHING
from fhash_codec.rendering.march_task import COUNTERS
from fhash_formats.errors import InputError, MissingDependencyError, OutputError, OutputExistsError
from fhash_formats.support.files import check_output, explained, replacing_all
from fhash_formats.support.values import plain_json


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
        "panels": json.dumps([panel.to_dict() for panel in panels(report)]).replace("<", "\\u003c"),
        "plotly": require_plotly().get_plotlyjs(),
    }
    template = files("fhash_codec.cost").joinpath("page.html").read_text(encoding="utf-8")
    head, *parts = template.split("{{")
    pieces = [part.split("}}", 1) for part in parts]
    return head + "".join(filled[name] + rest for name, rest in pieces)


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
