"""The picture of `fhash bench train`: PSNR over the seconds of each engine's training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fhash_codec.bench.train.curves import GOALS
from fhash_codec.cost.plot import require_matplotlib

__all__ = ["plot"]

COLOURS = {"native": "#d1604b", "slab": "#4a86c0"}
"""Colours by engine."""
STYLES = ("-", "--", ":", "-.")
"""Line styles of an engine's variants."""
CLOCKS = {"cpu_seconds": "seconds of processors", "seconds": "seconds that passed"}
"""Axes of time, by the key of a curve's points."""


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw a result of `bench_train` as a PNG at `path`: a row for each entry, a panel a clock."""
    figure_module = require_matplotlib()
    entries = result["series"]
    size = (11, 0.6 + 4 * len(entries))
    figure = figure_module.Figure(figsize=size, layout="constrained", dpi=120)
    rows = figure.subplots(len(entries), len(CLOCKS), squeeze=False)
    for row, entry in zip(rows, entries, strict=True):
        for panel, (clock, label) in zip(row, CLOCKS.items(), strict=True):
            _curves(panel, entry, clock)
            panel.set_xlabel(label)
        row[0].set_ylabel("PSNR in the coreset, dB")
        row[0].legend(frameon=False, fontsize=7)
        row[0].set_title(
            f"{', '.join(entry['features'])}, {entry['batch_bricks']:.0f} bricks a step,"
            f" {entry['float16_bytes'] / 1e6:.1f} MB as float16",
            fontsize=9,
            loc="left",
        )
    figure.suptitle(entries[0]["series"], fontsize=10)
    figure.savefig(path, format="png")


def _curves(panel: Any, entry: dict[str, Any], clock: str) -> None:
    """Draw a line for each engine that was measured."""
    drawn: dict[str, int] = {}
    for run in entry["engines"]:
        name = run["engine"]
        number = drawn.get(name, 0)
        drawn[name] = number + 1
        points = [point for point in run["curve"] if point["psnr"] is not None]
        panel.plot(
            [point[clock] for point in points],
            [point["psnr"] for point in points],
            color=COLOURS.get(name, "#3b3f46"),
            linestyle=STYLES[number % len(STYLES)],
            marker="o",
            markersize=3,
            label=" ".join(filter(None, [name, run["path"], f"x{run['threads']}"])),
        )
    for goal in GOALS:
        panel.axhline(goal, color="#c9cbd1", linewidth=0.8)
    panel.grid(True, color="#e3e4e8", linewidth=0.8)
    panel.set_axisbelow(True)
