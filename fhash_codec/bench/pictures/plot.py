"""The plot of `fhash bench render`: quality against time for each knob, and times beside VTK's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fhash_codec.bench.pictures.results import RenderBench
from fhash_codec.cost.plot import require_matplotlib
from fhash_formats.errors import InputError

KNOBS = {"step": "#d1604b", "threshold": "#4a86c0", "lod": "#2f9e6e"}
"""Colours of the knobs' curves."""
OURS = "#d1604b"
"""Colour of this renderer."""
VTK = "#8a8f98"
"""Colour of VTK."""


def plot(result: RenderBench, path: Path) -> None:
    """Draw a result as a PNG at `path`.

    It has a panel for the curves and one for VTK, where they were measured. Raises InputError where
    neither was.
    """
    figure_module = require_matplotlib()
    panels = [
        panel
        for panel, measured in ((_curves, result.curves), (_against, result.against))
        if measured
    ]
    if not panels:
        raise InputError("nothing to draw: neither 'curves' nor 'vtk' was measured")
    figure = figure_module.Figure(figsize=(1 + 5.5 * len(panels), 5), layout="constrained", dpi=140)
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        panel(axes, result)
    figure.suptitle(
        f"{Path(result.series).name}, step {result.step:g}, {result.size} x {result.size}",
        fontsize=11,
    )
    figure.savefig(path, format="png")


def _curves(axes: Any, result: RenderBench) -> None:
    for knob in dict.fromkeys(each.knob for each in result.curves):
        # What equals the finest picture has no place on the axis of quality.
        points = [each for each in result.curves if each.knob == knob and each.psnr is not None]
        axes.plot(
            [each.milliseconds for each in points],
            [each.psnr for each in points],
            marker="o",
            color=KNOBS[knob],
            label=knob,
            linewidth=1.8,
        )
        for each in points:
            axes.annotate(
                f"{each.value:.3g}",
                (each.milliseconds, each.psnr),
                textcoords="offset points",
                xytext=(4, 4),
                fontsize=7,
            )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(_plain)
    axes.xaxis.set_minor_formatter(_plain)
    axes.set_xlabel("ms")
    axes.set_ylabel("PSNR to the finest, dB")
    axes.grid(True, which="major", color="#e3e4e8", linewidth=0.8)
    axes.legend(frameon=False)


def _against(axes: Any, result: RenderBench) -> None:
    names = [
        f"{each.scene}\n{'lit' if each.shaded else 'unlit'}\n{each.size}" for each in result.against
    ]
    places = range(len(names))
    axes.bar(
        [place - 0.2 for place in places],
        [each.ours_ms for each in result.against],
        0.4,
        color=OURS,
        label="fhash",
    )
    axes.bar(
        [place + 0.2 for place in places],
        [each.vtk_ms for each in result.against],
        0.4,
        color=VTK,
        label="VTK, fixed point",
    )
    for place, each in zip(places, result.against, strict=True):
        axes.annotate(
            f"{each.ratio:.2g}x",
            (place, max(each.vtk_ms, each.ours_ms)),
            ha="center",
            va="bottom",
            fontsize=8,
        )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(_plain)
    axes.set_ylabel("ms")
    axes.set_xticks(list(places), names, fontsize=7)
    axes.legend(frameon=False)


def _plain(value: float, place: int) -> str:
    """A number on a logarithmic axis as people write it."""
    return f"{value:g}"
