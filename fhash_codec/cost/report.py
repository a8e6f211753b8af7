"""Files of a cost report: a page, a PNG and JSON in a folder, all of them or none.

matplotlib draws each plot once, as SVG for the page and in the PNG.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from fhash_codec.cost.results import (
    ADVICE,
    DEFAULT,
    NETWORK,
    TRAINING,
    CostReport,
    Encoded,
    Picture,
    Read,
    advice_rows,
    by_training,
    bytes_text,
    conclusion,
    feature_options,
    seconds_text,
    told,
)
from fhash_formats.errors import InputError, MissingDependencyError, OutputError, OutputExistsError
from fhash_formats.support.files import check_output, explained, replacing_all
from fhash_formats.support.values import plain_json

GREY = "#868d97"
"""Colour of the peers, which shows on light and dark paper."""
STYLES: dict[str, tuple[str, str]] = {
    "effort 1": ("#56B4E9", "o"),
    "effort 2": ("#56B4E9", "D"),
    "effort 3": ("#2583C4", "o"),
    "effort 5": ("#D55E00", "o"),
    "effort 7": ("#D55E00", "D"),
    "effort 9": ("#D55E00", "*"),
    NETWORK: ("#CC79A7", "*"),
    TRAINING: ("#009E73", "o"),
    "SZ3": (GREY, "s"),
    "SPERR": (GREY, "^"),
    "ZFP": (GREY, "X"),
}
"""Colour, after Okabe and Ito (told apart by colour-blind people), and marker of each curve."""
CYCLE = ("#2583C4", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8A8F98")
"""Colours of curves that have none of their own."""
SYMBOLS = ("o", "s", "D", "^", "X", "*", "P")
"""Markers of curves that have none of their own."""


class Point(NamedTuple):
    """A point of a curve, or a bar of length x at the name y.

    Attributes:
        curve: name of its curve.
        text: what the mouse shows.
        ends: lower and upper estimate of x; None where it was measured.
    """

    curve: str
    x: Any
    y: Any
    text: str
    ends: tuple[float, float] | None = None


@dataclass(frozen=True)
class Panel:
    """A plot.

    Attributes:
        section: one of SECTIONS; empty for that beside the advice.
        x, y: labels of the axes, with units.
        curves: the points of each curve, by its name.
        log: names of the logarithmic axes, such as "xy".
        line: whether the points of a curve are joined.
        best: whether only those are joined than which none is better in x and y: the others are
            noise of times, or not worth their bytes.
        bars: whether the points are horizontal bars.
    """

    key: str
    section: str
    title: str
    x: str
    y: str
    curves: dict[str, list[Point]]
    log: str = ""
    line: bool = True
    best: bool = False
    bars: bool = False


def curves(points: Iterable[Point]) -> dict[str, list[Point]]:
    """The curves of some points; those that lack x or y are left out."""
    made: dict[str, list[Point]] = {}
    for point in points:
        if point.x is not None and point.y is not None:
            made.setdefault(point.curve, []).append(point)
    return made


def style_of(name: str, place: int) -> tuple[str, str]:
    """Colour and marker of a curve, by its name or its place."""
    name = name.removesuffix(BOUND)
    return STYLES.get(name, (CYCLE[place % len(CYCLE)], SYMBOLS[place % len(SYMBOLS)]))


BOUND = ", error bound"
"""End of the name of a curve of strict bounds, whose points are not joined: their dB follow."""
SIZE = "size of the file, bytes"
"""Label of the size."""
TOOK = "seconds of encoding"
"""Label of the time of an encoding."""
TIME = "milliseconds"
"""Label of the time of a read or a picture."""
ERROR = "largest error"
"""Beginning of the label of an axis on which small values lie above."""


def encode_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the encodings, their trainings, stages and steps, empty ones included."""
    units = report.units if report.units not in ("", "1") else "in the units of the data"
    decibel = "PSNR of all values, dB"
    points = report.encodings
    if len(points) > 1:
        for key, section, title, x, y, fields, log in (
            ("answer", "", "Quality against time", TOOK, decibel, ("seconds", "psnr"), "x"),
            ("encode-bytes", "", "Quality against size", SIZE, decibel, ("bytes", "psnr"), "x"),
            (
                "encode-bulk", "encode", "Quality of the bulk against size", SIZE,
                "PSNR of the middle 98 %, dB", ("bytes", "psnr_bulk"), "x",
            ),
            (
                "encode-error", "encode", "Largest error against size", SIZE,
                f"{ERROR}, {units}", ("bytes", "max_abs_error"), "xy",
            ),
        ):  # fmt: skip
            made = _frontier(points, *fields)
            yield Panel(key, section, title, x, y, made, log=log, best=True)
        made = curves(
            Point(TRAINING, each.seconds, each.bytes, _hover(each)) for each in by_training(report)
        )
        yield Panel("saved", "", "Size against training, at one promise", TOOK, SIZE, made)
    made = curves(
        Point(one.name, at["seconds"], at["psnr"], f"{one.name}\nepoch or update {at['epoch']:g}")
        for one in report.curves
        for at in one.points
    )
    title, x, y = "Course of the trainings", "seconds of training", "PSNR on samples, dB"
    yield Panel("training", "training", title, x, y, made, log="x")
    made = curves(
        Point("", stage.seconds, stage.stage, f"{stage.stage}\n{seconds_text(stage.seconds)}")
        for stage in reversed(report.stages)
        if stage.times
    )
    yield Panel("stages", "encode", "Seconds of each stage", "seconds", "", made, bars=True)
    made = curves(
        Point("", at["step"], at["psnr"], f"step {at['step']}: {at['psnr'] or 0:.4g} dB")
        for at in report.per_step
    )
    yield Panel("per-step", "encode", "Accuracy of each step", "step", "PSNR, dB", made)


def _frontier(points: Sequence[Encoded], x: str, y: str) -> dict[str, list[Point]]:
    """A curve of points for each group, by quality; strict bounds are curves of their own."""
    made = curves(
        Point(
            point.group + (BOUND if "--max-error" in point.options else ""),
            getattr(point, x),
            getattr(point, y),
            _hover(point),
            getattr(point, f"{x}_range"),
        )
        for point in points
        if point.group != TRAINING
    )
    return {name: sorted(each, key=lambda point: (point.y, point.x)) for name, each in made.items()}


def _hover(point: Encoded) -> str:
    """Text that the mouse shows at an encoding."""
    return "\n".join([point.name, told(point)] + ["misses its promise"] * point.missed)


def read_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the reads, empty ones included."""
    y = "PSNR of what was read, dB"
    for key, x, field in (("ms", TIME, "milliseconds"), ("bytes", "bytes read", "bytes_read")):
        made = curves(
            Point(read.what, getattr(read, field), read.psnr, _read(read)) for read in report.reads
        )
        title = f"Accuracy of reads against {x}"
        yield Panel(f"read-{key}", "read", title, x, y, made, log="x", line=False)


def _read(read: Read) -> str:
    """Text that the mouse shows at a read."""
    figures = f"{read.milliseconds:.3g} ms, {bytes_text(read.bytes_read)}"
    return f"{read.what}\n{read.file}\n{figures}"


KNOBS = ("step length", "level of detail", "level of detail, first picture", "threshold")
"""Groups of pictures that trade time for likeness."""


def picture_panels(report: CostReport) -> Iterator[Panel]:
    """Plots of the pictures, empty ones included."""
    for title, y, field in (
        ("Pictures: likeness against time", "PSNR to the finest picture, dB", "psnr"),
        ("Pictures: SSIM against time", "SSIM to the finest picture", "ssim"),
    ):
        made = curves(  # in the order of the settings: times alone may go up and down
            Point(each.group, each.milliseconds, getattr(each, field), _seen(each))
            for each in report.pictures
            if each.group in KNOBS and not each.best
        )
        yield Panel(f"picture-{field}", "picture", title, TIME, y, made, log="x")
    made = curves(
        Point("", each.milliseconds, each.setting, _seen(each))
        for each in reversed(report.pictures)
        if each.group == "effect"
    )
    yield Panel("effects", "picture", "Effects, each alone", TIME, "", made, bars=True)
    files = {point.name: point for point in report.encodings if point.bytes}
    made = curves(
        sorted(
            Point(files[each.setting].group, files[each.setting].bytes, each.psnr, _seen(each))
            for each in report.pictures
            if each.group == "encoding" and each.setting in files and each.psnr is not None
        )
    )
    title, y = "Likeness to the source's picture against size", "PSNR of the picture, dB"
    yield Panel("picture-bytes", "picture", title, SIZE, y, made, log="x")


def _seen(picture: Picture) -> str:
    """Text that the mouse shows at a picture."""
    return f"{picture.group}: {picture.setting}\n{picture.milliseconds:.3g} ms"


def panels(report: CostReport) -> list[Panel]:
    """Every plot for which there are points; those that compare encodings need two."""
    made = [*encode_panels(report), *read_panels(report), *picture_panels(report)]
    return [panel for panel in made if panel.curves]


class Table(NamedTuple):
    """A table of texts; `section` is one of SECTIONS."""

    section: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(report: CostReport) -> list[Table]:
    """A table of each kind of record, with the columns of `cost.json` in which anything stands."""
    kinds: tuple[tuple[str, str, Sequence[Any]], ...] = (
        ("encode", "Encodings", report.encodings),
        ("encode", "Stages of the encoding", report.stages),
        ("encode", "Size of the file in the course of the search", report.gains),
        ("read", "Reads", report.reads),
        ("picture", "Pictures, with everything that was counted", report.pictures),
        ("left", "Left out", report.left_out),
    )
    made = []
    for section, title, entries in kinds:
        records = [{**vars(entry), **vars(entry).get("counters", {})} for entry in entries]
        texts = {
            name.replace("_", " "): [_text(record[name]) for record in records]
            for name in (records[0] if records else ())
            if name != "counters"
        }
        told = {name: each for name, each in texts.items() if set(each) - {"-", ""}}
        if told:
            rows = tuple(zip(*told.values(), strict=True))
            made.append(Table(section, title, tuple(told), rows))
    return made


def _text(value: Any) -> str:
    """The text of a value in a table."""
    if value is None or isinstance(value, bool):
        return "yes" if value else "-"
    return f"{value:.4g}" if isinstance(value, float) else f"{value}"


INK = "#1c2026"
"""Colour of texts and axes, which the page changes with its theme."""
LINE = "#d9dde3"
"""Colour of grids, likewise."""
RC = {
    "font.size": 8.5, "text.color": INK, "axes.edgecolor": LINE, "axes.labelcolor": INK,
    "xtick.color": INK, "ytick.color": INK, "svg.fonttype": "none", "svg.hashsalt": "fhash",
    "text.parse_math": False,  # names and units of the data are none
}  # fmt: skip
"""Settings of matplotlib for all plots."""
TITLE = "What accuracy costs: "
"""Beginning of the title, before the series."""
FEW_DECADES = 300
"""Ratio of the ends of a logarithmic axis up to which 2 and 5 have marks, too."""


def plot(report: CostReport, path: Path) -> None:
    """Draw the first screen as a PNG: its plots, and the advice beside them.

    Without advice it has the first two plots of all.

    Raises MissingDependencyError without matplotlib.
    """
    module = require_matplotlib()
    made = panels(report)
    shown = [panel for panel in made if not panel.section] if report.advice else made[:2]
    rows = [ADVICE, *advice_rows(report)] if report.advice else []
    told_lines = [*textwrap.wrap(conclusion(report), 170), *textwrap.wrap(_facts(report), 170)]
    with importlib.import_module("matplotlib").rc_context(RC):
        height = max(ROW * len(rows), 2.9 * len(shown)) + 1.3 if rows else 5.0
        figure = module.Figure(figsize=(14.0, height), layout="constrained", dpi=100)
        figure.suptitle("\n".join([TITLE + report.series, *told_lines]), fontsize=9)
        if rows:
            left, right = figure.add_gridspec(1, 2, width_ratios=(8, 5))
            _draw_advice(figure.add_subplot(left, frame_on=False, xticks=[], yticks=[]), report)
            places = right.subgridspec(max(len(shown), 1), 1)
        else:
            places = figure.add_gridspec(1, 2)
        for place, panel in zip(places, shown, strict=False):
            _draw(figure.add_subplot(place), panel)
        figure.savefig(path, format="png")


ROW = 0.29
"""Inches of a row of the table."""


def _draw_advice(axes: Any, report: CostReport) -> None:
    rows = [ADVICE, *advice_rows(report)]
    lengths = [max(map(len, column)) + 2 for column in zip(*rows, strict=True)]
    widths = [length / sum(lengths) for length in lengths]
    cells = axes.table(rows, colWidths=widths, bbox=(0, 0, 1, 1), edges="B", cellLoc="left")
    cells.auto_set_font_size(False)
    for (row, column), cell in cells.get_celld().items():
        cell.set_edgecolor(LINE)
        bold = row == 0 or column == 0
        cell.set_text_props(fontsize=8, fontweight="bold" if bold else "normal")
        cell.PAD = 0.02
    axes.set_title(_command(report), fontsize=9)


def svg(panel: Panel) -> str:
    """A plot as an element of the page: colours by its theme, and texts for the mouse."""
    module = require_matplotlib()
    with importlib.import_module("matplotlib").rc_context(RC):
        figure = module.Figure(figsize=(5.0, 4.1), layout="constrained")
        texts = _draw(figure.subplots(), panel)
        written, unsaid = io.StringIO(), dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(written, format="svg", transparent=True, metadata=unsaid)
    _, start, rest = written.getvalue().partition("<svg")
    element = (start + rest).replace(INK, "var(--ink)").replace(LINE, "var(--line)")
    # matplotlib has links for its points, and no titles.
    return re.sub(
        r'<a xlink:href="(\d+)"[^>]*>',
        lambda found: f"<g><title>{escape(texts[int(found[1])])}</title>",
        element.replace("</a>", "</g>"),
    )


def _draw(axes: Any, panel: Panel) -> list[str]:
    """Draw a plot; the texts of its points, whose numbers are their links."""
    texts: list[str] = []
    for place, (name, points) in enumerate(panel.curves.items()):
        colour, marker = style_of(name, place)
        _, x, y, shown, ends = zip(*points, strict=True)
        links = [f"{len(texts) + number}" for number in range(len(points))]
        texts += shown
        if panel.bars:
            for bar, link in zip(axes.barh(y, x, color=colour), links, strict=True):
                bar.set_url(link)
            continue
        if panel.line and not name.endswith(BOUND):
            joined = _best(points, panel) if panel.best else points
            axes.plot(*[[each[at] for each in joined] for at in (1, 2)], color=colour, lw=1.2)
        spans = [(y, *span) for y, span in zip(y, ends, strict=True) if span is not None]
        axes.hlines(
            *zip(*spans, strict=True) if spans else ([], [], []), color=colour, lw=3, alpha=0.3
        )
        made = axes.scatter(x, y, s=24, marker=marker, zorder=3, color=colour,
                            label=("_" if name.endswith(BOUND) else "") + name)  # fmt: skip
        made.set_urls(links)
        for at in (point[1:3] for point in points if point.text.startswith(DEFAULT)):
            axes.scatter(*at, s=260, facecolors="none", edgecolors=INK, linewidths=1.3, zorder=4)
            axes.annotate("default", at, (11, 9), textcoords="offset points", fontweight="bold")
    for name, label in (("x", panel.x), ("y", panel.y)):
        getattr(axes, f"set_{name}label")(label)
        text = bytes_text if "bytes" in label else "{:g}".format
        if name in panel.log:
            _set_logarithmic(axes, name, text)
        elif not panel.bars:
            getattr(axes, f"{name}axis").set_major_formatter(
                lambda value, _, text=text: text(value)
            )
    if panel.y.startswith(ERROR):
        axes.invert_yaxis()
    axes.set_title(panel.title, fontsize=9.5)
    axes.grid(True, which="major", color=LINE, linewidth=0.8)
    axes.set_axisbelow(True)
    if len(panel.curves) > 1:
        legend = axes.legend(frameon=False, fontsize=6.5)
        for handle in legend.legend_handles:
            handle.set_sizes([24])
    return texts


def _best(points: Sequence[Point], panel: Panel) -> list[Point]:
    """The points than which no other is at least as good in both x and y."""
    sign = -1 if panel.y.startswith(ERROR) else 1
    return [
        point
        for point in points
        if not any(
            other is not point and other.x <= point.x and sign * other.y >= sign * point.y
            for other in points
        )
    ]


def _set_logarithmic(axes: Any, name: str, shown: Callable[[float], str]) -> None:
    """Make one axis logarithmic, with texts for its marks."""
    getattr(axes, f"set_{name}scale")("log")
    side = getattr(axes, f"{name}axis")
    side.set_major_formatter(lambda value, _: shown(value))
    side.set_minor_formatter(lambda *_: "")
    low, high = sorted(getattr(axes, f"get_{name}lim")())
    marks = (1, 2, 5) if high < FEW_DECADES * low else (1,)
    ticker = importlib.import_module("matplotlib.ticker")
    side.set_major_locator(ticker.LogLocator(subs=marks, numticks=20))


def require_matplotlib() -> Any:
    """The module that draws; raises MissingDependencyError."""
    try:
        return importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise MissingDependencyError(
            "a report of costs needs matplotlib; pip install 'fhash[bench]'"
        ) from error


SECTIONS = {
    "encode": "Encode",
    "training": "Training",
    "read": "Read",
    "picture": "Picture",
    "left": "Left out",
    "about": "How it was measured",
}
"""Tabs of the page by the sections of panels and tables."""


def json_text(report: CostReport) -> str:
    """The report as JSON; figures without a value are null."""
    return json.dumps(plain_json(report.to_dict()), indent=1, allow_nan=False)


def page(report: CostReport) -> str:
    """The page; raises MissingDependencyError without matplotlib."""
    made = panels(report)
    answer = "".join(_figure(panel) for panel in made if not panel.section)
    answer = f"<div>{answer}</div>" if answer else ""
    filled = {
        "title": escape(TITLE + report.series),
        "conclusion": re.sub(r"--[\w-]+", r"<code>\g<0></code>", escape(conclusion(report))),
        "facts": escape(_facts(report)),
        "answer": (_advice(report) if report.advice else "") + answer,
        "tabs": "".join(_tab(name, report, made) for name in SECTIONS).replace(
            ' id="tab', ' checked id="tab', 1
        ),
    }
    template = files("fhash_codec.cost").joinpath("page.html").read_text(encoding="utf-8")
    return Template(template).substitute(filled)


def _command(report: CostReport) -> str:
    """The command that the options of the advice belong to."""
    return " ".join(["fhash encode DATA -o RUN.fhz", *feature_options(report), "and the options"])


def _facts(report: CostReport) -> str:
    """A line on the measurement."""
    whole, part = (" x ".join(map(str, n)) for n in (report.shape, report.measured_shape))
    return (
        f"Figures are those of the whole file, {whole} (t, z, y, x), {report.dtype},"
        f" {bytes_text(report.raw_bytes)}. Measured: {report.measured}"
        + (f", {part}" if part != whole else "")
        + f"; {report.seconds:.0f} s of a budget of {report.budget_seconds:.0f} s,"
        f" {report.machine.get('threads', '?')} threads"
        + (", interrupted" if report.interrupted else "")
    )


def _advice(report: CostReport) -> str:
    """The table of advice."""
    header = "".join(f"<th>{name}</th>" for name in ADVICE)
    rows = ""
    for *cells, options in advice_rows(report):
        first = ' class="first"' if cells[0] else ""
        rows += (
            f"<tr{first}>{''.join(map(_cell, cells))}<td><code>{escape(options)}</code></td></tr>"
        )
    return (
        f"<div><p>Type <code>{escape(_command(report))}</code>:</p>"
        f'<table class="advice"><thead><tr>{header}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _figure(panel: Panel) -> str:
    return f'<figure class="plot" id="{panel.key}">{svg(panel)}</figure>'


def _tab(name: str, report: CostReport, made: Sequence[Panel]) -> str:
    """A tab: its button, and its plots and tables; empty where it has none."""
    plots = "".join(_figure(panel) for panel in made if panel.section == name)
    lists = "".join(_table(table) for table in tables(report) if table.section == name)
    notes = ""
    if name == "about":
        machine = ", ".join(f"{key} {value}" for key, value in report.machine.items())
        notes = "".join(f"<li>{escape(note)}</li>" for note in (machine, *report.notes))
        notes = f"<ul>{notes}</ul>"
    if not (plots or lists or notes):
        return ""
    return (
        f'<input type="radio" name="tab" id="tab-{name}"><label for="tab-{name}">'
        f'{SECTIONS[name]}</label><section>{notes}<div class="plots">{plots}</div>{lists}</section>'
    )


def _cell(text: str) -> str:
    """A cell of a table; numbers stand to the right."""
    try:
        float(text)
    except ValueError:
        return f"<td>{escape(text)}</td>"
    return f'<td class="number">{escape(text)}</td>'


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
    """Check a folder before any work, and that matplotlib is there.

    The folder need not exist, but the one above it must.

    Raises InputError for a folder that is one of the sources or lies in one, OutputExistsError for
    one that holds anything while `force` is not given, OutputError for a file or where nothing can
    be written, and MissingDependencyError.
    """
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
