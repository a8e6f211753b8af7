"""The picture of `fhash bench ablate`: a panel for each axis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fhash_codec.bench.ablate.ablate import told
from fhash_codec.bench.ablate.results import AblateBench, Row, Run
from fhash_codec.cost.plot import require_matplotlib

COLUMNS = 3
"""Panels side by side."""
COLOURS = ("#4a86c0", "#d1604b", "#2f9e6e", "#e0a030", "#b07aa1", "#3b3f46", "#57b8c4", "#9c8b5a")
"""Colours of the models of a panel, told apart by colour-blind readers with their line styles."""
STYLES = ("-", "--", ":", "-.")
"""Line styles, for more models than colours."""


def plot(result: AblateBench, path: Path) -> None:
    """Draw a result as a PNG at `path`.

    An axis of the profile paper shows PSNR over the epochs of each training; one of the profile
    compact bytes against seconds: its models keep the same promise.
    """
    figure_module = require_matplotlib()
    axes = list(dict.fromkeys(run.axis for run in result.runs))
    lines = -(-len(axes) // COLUMNS)
    columns = min(COLUMNS, len(axes))
    size = (1 + 5.2 * columns, 0.6 + 4.2 * lines)
    figure = figure_module.Figure(figsize=size, layout="constrained", dpi=120)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for panel, name in zip(panels, axes, strict=False):
        runs = [run for run in result.runs if run.axis == name and run.seed == 0]
        if any(run.curve for run in runs):
            _curves(panel, runs)
        else:
            _points(panel, [row for row in result.rows if row.axis == name])
        panel.set_title(name, fontsize=10)
        panel.grid(True, color="#e3e4e8", linewidth=0.8)
        panel.set_axisbelow(True)
        panel.legend(frameon=False, fontsize=6, ncols=2)
    for panel in panels[len(axes) :]:
        panel.set_visible(False)
    figure.suptitle(f"{Path(result.series).name}, {' x '.join(map(str, result.shape))}")
    figure.savefig(path, format="png")


def _curves(panel: Any, runs: list[Run]) -> None:
    """PSNR over epochs, on the bricks that the training watches; a line for each model."""
    for number, run in enumerate(runs):
        points = [point for point in run.curve if point["psnr"] is not None]
        panel.plot(
            [point["epoch"] for point in points],
            [point["psnr"] for point in points],
            color=COLOURS[number % len(COLOURS)],
            linestyle=STYLES[number // len(COLOURS) % len(STYLES)],
            linewidth=2.4 if run.reference else 1.3,
            label=told(run.settings),
        )
    panel.set_xlabel("epochs")
    panel.set_ylabel("PSNR on some bricks of the key frames, dB")


def _points(panel: Any, rows: list[Row]) -> None:
    """Bytes against seconds, a point for each variation, whose legend tells its PSNR."""
    for number, row in enumerate(rows):
        quality = "exact" if row.psnr is None else f"{row.psnr:.1f} dB"
        panel.plot(
            [row.seconds],
            [row.bytes],
            "o",
            color=COLOURS[number % len(COLOURS)],
            label=f"{told(row.settings)}: {quality}",
        )
    panel.set_xscale("log")
    panel.set_xlabel("seconds of the encoding")
    panel.set_ylabel("bytes of the file")
