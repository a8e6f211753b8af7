"""Curves of convergence: PSNR of volume and pictures over seconds, epochs and Adam steps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from fhash_codec.bench.paper.cell import Cell
from fhash_codec.bench.paper.groups import Group, by_data, groups
from fhash_codec.bench.paper.printed import DECIBELS, ENCODINGS, SETS
from fhash_codec.cost.plot import require_matplotlib
from fhash_formats.support.files import replacing

__all__ = ["plot_convergence"]

COLOURS = {
    "hash": "#b07aa1",
    "tcnn": "#9c8b5a",
    "dense": "#8a8f98",
    "dense-multi": "#4a86c0",
    "fhash": "#d1604b",
}
"""Colour of each encoding."""
CLOCKS = {
    "seconds": "seconds of training",
    "epoch": "epochs",
    "step": "Adam steps of each model",
}
"""Fields of a point along the horizontal axes, and their labels."""
LOGARITHMIC = ("seconds", "step")
"""Clocks whose axis is logarithmic: encodings differ by factors in them."""
QUALITIES = {"coreset_psnr": "volume, coreset", "picture_psnr": "picture"}
"""Fields of a point along the vertical axes, and their labels."""


def plot_convergence(cells: Sequence[Cell], folder: Path) -> list[Path]:
    """Draw the curves of each data set, feature and protocol as PNG in a folder; old ones go.

    A line is the median over seeds, the band around it reaches from the smallest to the largest.
    Returns the files. Raises MissingDependencyError without matplotlib.
    """
    require_matplotlib()
    written = []
    grouped = groups(cells)
    for protocol in dict.fromkeys(group.protocol for group in grouped):
        mine = [group for group in grouped if group.protocol == protocol]
        for (name, feature), encodings in by_data(mine):
            words = "-".join((name, feature, protocol))
            path = folder / f"convergence-{re.sub(r'[^A-Za-z0-9.-]+', '_', words)}.png"
            _draw(f"{SETS.get(name, name)} ({name}), {feature}, protocol {protocol}",
                  encodings, path)  # fmt: skip
            written.append(path)
    return written


def _draw(title: str, encodings: dict[str, Group], path: Path) -> None:
    """Draw the panels of one data set, feature and protocol."""
    figure = require_matplotlib().Figure(figsize=(15, 8), layout="constrained", dpi=110)
    qualities = [
        quality
        for quality in QUALITIES
        if any(
            getattr(point, quality) is not None
            for group in encodings.values()
            for cell in group.cells
            for point in cell.curve
        )
    ]
    panels = figure.subplots(max(len(qualities), 1), len(CLOCKS), squeeze=False, sharey="row")
    for row, quality in zip(panels, qualities, strict=False):
        for axes, clock in zip(row, CLOCKS, strict=True):
            _panel(axes, encodings, clock, quality)
        row[0].set_ylabel(f"PSNR, {QUALITIES[quality]}, dB")
    for axes, label in zip(panels[-1], CLOCKS.values(), strict=True):
        axes.set_xlabel(label)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle(title, fontsize=12)
    with replacing(path, force=True) as temporary:
        figure.savefig(temporary, format="png")


def _panel(axes: Any, encodings: dict[str, Group], clock: str, quality: str) -> None:
    """Draw one quality over one clock."""
    for decibels in DECIBELS:
        axes.axhline(decibels, color="#c9cbd2", linestyle=":", linewidth=1)
    for name, group in encodings.items():
        curves = [_curve(cell, clock, quality) for cell in group.cells]
        # Points of one number are of one epoch: seeds differ in their seconds alone.
        points = [column for column in zip(*curves, strict=False) if None not in column]
        if clock in LOGARITHMIC:
            points = [column for column in points if min(at for at, _ in column) > 0]
        if not points:
            continue
        at = [median(x for x, _ in column) for column in points]
        middle = [median(y for _, y in column) for column in points]
        low, high = ([end(y for _, y in column) for column in points] for end in (min, max))
        axes.plot(
            at,
            middle,
            color=COLOURS.get(name, "#3b3f46"),
            label=ENCODINGS.get(name, name),
            linewidth=2.4 if name == "fhash" else 1.5,
            marker="o",
            markersize=3,
        )
        if len(group.cells) > 1:
            axes.fill_between(at, low, high, color=COLOURS.get(name, "#3b3f46"), alpha=0.18)
    if clock in LOGARITHMIC:
        axes.set_xscale("log", subs=(2, 5))
        for formatted in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            formatted(lambda value, _: f"{value:g}")
    axes.grid(True, which="major", color="#e9eaee", linewidth=0.8)
    axes.set_axisbelow(True)


def _curve(cell: Cell, clock: str, quality: str) -> list[tuple[float, float] | None]:
    """Points (clock, quality) of a curve, None where the quality was not measured."""
    return [
        None
        if getattr(point, quality) is None
        else (float(getattr(point, clock)), float(getattr(point, quality)))
        for point in cell.curve
    ]
