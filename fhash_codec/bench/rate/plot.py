"""The picture of `fhash bench rate`: bytes against PSNR, and against the largest error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fhash_codec.bench.rate.results import OWN, Point, RateBench
from fhash_codec.cost.plot import require_matplotlib

COLOURS = {
    "SZ3": "#4a86c0",
    "SPERR": "#2f9e6e",
    "ZFP": "#b07aa1",
    "BitRound": "#9c8b5a",
    "Blosc": "#8a8f98",
}
OWN_COLOURS = ("#d1604b", "#3b3f46", "#e0a030")


def plot(result: RateBench, path: Path) -> None:
    """Draw a result as a PNG at `path`.

    Each kind of quality has a panel, with bytes on a logarithmic axis; qualities that were not
    reached are left out.
    """
    figure_module = require_matplotlib()
    goals = [
        goal for goal in ("psnr", "bound") if any(point.goal == goal for point in result.points)
    ]
    figure = figure_module.Figure(figsize=(1 + 5.5 * len(goals), 5), layout="constrained", dpi=140)
    for number, (axes, goal) in enumerate(
        zip(figure.subplots(1, len(goals), squeeze=False)[0], goals, strict=True)
    ):
        _panel(
            axes,
            goal,
            [
                point
                for point in result.points
                if point.goal == goal and (point.reached or point.codec.startswith(OWN))
            ],
        )
        if number == 0:
            axes.set_ylabel("bytes")
            axes.legend(frameon=False)
    figure.suptitle(f"{Path(result.series).name}, {result.raw_bytes / 1e6:.1f} MB raw", fontsize=11)
    figure.savefig(path, format="png")


def _panel(axes: Any, goal: str, points: list[Point]) -> None:
    own = sorted({point.codec for point in points if point.codec.startswith(OWN)})
    for codec in dict.fromkeys(point.codec for point in points):
        mine = [point for point in points if point.codec == codec]
        colour = (
            OWN_COLOURS[own.index(codec) % len(OWN_COLOURS)] if codec in own else COLOURS[codec]
        )
        # A lossless codec has no place on the axis of quality, only its bytes.
        places = {
            (point.psnr if goal == "psnr" else 100 * point.max_error, point.bytes)
            for point in mine
            if point.psnr is not None
        }
        style = {"color": colour, "label": codec, "linewidth": 2.4 if codec in own else 1.4}
        if places:
            axes.plot(
                *zip(*sorted(places), strict=True),
                marker="o",
                markersize=5 if codec in own else 3.5,
                **style,
            )
        else:
            axes.axhline(mine[0].bytes, linestyle="--", **style)
    axes.set_yscale("log")
    axes.grid(True, which="major", color="#e3e4e8", linewidth=0.8)
    axes.set_axisbelow(True)
    if goal == "psnr":
        axes.set_xlabel("PSNR over all frames, dB")
    else:
        axes.set_xscale("log")
        axes.invert_xaxis()
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_xlabel("largest error, % of the range")
