"""The plots of a cost report as one PNG."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from fhash_codec.cost.advice import bytes_text
from fhash_codec.cost.panel import Axis, Panel
from fhash_codec.cost.panels import panels
from fhash_codec.cost.results import CostReport
from fhash_formats.errors import MissingDependencyError

__all__ = ["plot"]

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
        side.set_major_formatter(_size if axis.unit else _plain)
        side.set_minor_formatter(_nothing)
        low, high = sorted(getattr(axes, f"get_{name}lim")())
        marks = (1, 2, 5) if high < FEW_DECADES * low else (1,)
        side.set_major_locator(_ticker().LogLocator(subs=marks, numticks=20))
    if axis.reversed:
        getattr(axes, f"invert_{name}axis")()


def _ticker() -> Any:
    """The module of matplotlib that places the marks of an axis."""
    return importlib.import_module("matplotlib.ticker")


def _size(value: float, _: int) -> str:
    return bytes_text(value)


def _plain(value: float, _: int) -> str:
    return f"{value:g}"


def _nothing(*_: object) -> str:
    return ""


def require_matplotlib() -> Any:
    """The module that draws; raises MissingDependencyError."""
    try:
        return importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise MissingDependencyError(
            "a plot needs matplotlib; pip install 'fhash[bench]'"
        ) from error
