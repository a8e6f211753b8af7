"""Results of `fhash bench render`, as records, JSON values and a plot."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from fhash_codec.cost.report import require_matplotlib
from fhash_formats.errors import InputError

PARTS = (
    "effects",
    "accelerations",
    "orbit",
    "shell",
    "streams",
    "break-even",
    "vtk",
    "exactness",
    "playback",
    "curves",
)
"""Names of the parts that can be measured."""
NETWORK_PARTS = ("streams", "break-even")
"""Names of the parts that march through a network, which the published network alone has."""


@dataclass(frozen=True, kw_only=True)
class Switch:
    """An effect or an acceleration on and off, all else alike."""

    name: Annotated[str, "its name"]
    off_ms: Annotated[float, "milliseconds of a picture"]
    on_ms: Annotated[float, "milliseconds of a picture"]
    counters_off: Annotated[dict[str, int], "counters of the last picture"]
    counters_on: Annotated[dict[str, int], "counters of the last picture"]
    psnr: Annotated[float | None, "dB between the two; null where equal or meant to differ"]

    @property
    def ratio(self) -> float:
        """Time with it over time without."""
        return self.on_ms / self.off_ms


@dataclass(frozen=True, kw_only=True)
class Stream:
    """One march."""

    mode: Annotated[str, "way to march"]
    milliseconds: Annotated[float, "of a picture"]
    samples: Annotated[int, "its counters"]
    evaluations: Annotated[int, "its counters"]
    psnr: Annotated[float | None, "dB to the picture of the cached march; null where equal"]
    largest: Annotated[float, "largest difference to that picture, 0..1"]


@dataclass(frozen=True, kw_only=True)
class BreakEven:
    """Pictures of one size by the cache and by adaptive ray marching through the model."""

    size: Annotated[int, "pixels along both sides"]
    first_ms: Annotated[float, "the cache, decoding included"]
    kept_ms: Annotated[float, "the cache with the frame kept"]
    arm_ms: Annotated[float, "adaptive ray marching, which keeps nothing"]
    evaluations: Annotated[int, "of the model"]
    auto: Annotated[str, "the mode that 'auto' takes"]

    @property
    def ratio(self) -> float:
        """Time of adaptive ray marching over that of a first picture by the cache."""
        return self.arm_ms / self.first_ms

    @property
    def pictures(self) -> int | None:
        """Number of pictures of one step for which marching takes less; None for any number."""
        if self.arm_ms <= self.kept_ms:
            return None
        decoding = max(self.first_ms - self.kept_ms, 0.0)
        return math.floor(decoding / (self.arm_ms - self.kept_ms))


@dataclass(frozen=True, kw_only=True)
class Against:
    """A scene drawn here and by VTK's fixed-point ray caster.

    Both have the same decoded frame, transfer function, camera, step and number of threads."""

    scene: Annotated[str, "its name"]
    shaded: Annotated[bool, "whether it is lit"]
    size: Annotated[int, "pixels along both sides"]
    ours_ms: Annotated[float, "time of marching"]
    whole_ms: Annotated[float, "time of `Renderer.render`, planning included"]
    vtk_ms: Annotated[float, "time of VTK's `Render` less `window_ms`"]
    window_ms: Annotated[float, "time of VTK's `Render` with an empty window"]
    psnr: Annotated[float | None, "likeness in dB"]
    ssim: Annotated[float, "likeness"]
    samples: Annotated[int, "values that were looked up here"]

    @property
    def ratio(self) -> float:
        """Times faster than VTK."""
        return self.vtk_ms / self.ours_ms


@dataclass(frozen=True, kw_only=True)
class Beside:
    """A volume made for the bench, drawn here and by a peer in turns."""

    peer: Annotated[str, "name and version"]
    scene: Annotated[str, "its name"]
    shaded: Annotated[bool, "whether it is lit"]
    size: Annotated[int, "pixels along both sides"]
    threads: Annotated[int, "of both"]
    ours_ms: Annotated[float, "time of marching"]
    peer_ms: Annotated[float, "time of the peer, less that of its empty window"]
    psnr: Annotated[float | None, "likeness in dB; null where equal"]

    @property
    def ratio(self) -> float:
        """Times faster than the peer."""
        return self.peer_ms / self.ours_ms


@dataclass(frozen=True, kw_only=True)
class Exactness:
    """A picture drawn here and by VTK's mapper for graphics cards."""

    scene: Annotated[str, "its name"]
    gradient: Annotated[str, "lighting here, `cell` or `central` (as VTK); empty where unlit"]
    size: Annotated[int, "pixels along both sides"]
    step: Annotated[float, "ray step in vertex spacings"]
    psnr: Annotated[float | None, "likeness in dB"]
    ssim: Annotated[float, "likeness"]
    largest: Annotated[int, "largest difference in bytes"]
    explained: Annotated[float | None, "PSNR of VTK's picture to a slow one with VTK's conventions"]


@dataclass(frozen=True, kw_only=True)
class Playback:
    """Steps drawn one after the other, each for the first time."""

    scene: Annotated[str, "its name"]
    shaded: Annotated[bool, "whether it is lit"]
    size: Annotated[int, "pixels along both sides"]
    steps: Annotated[int, "their number"]
    ours_ms: Annotated[float, "milliseconds of a step, decoding included"]
    vtk_ms: Annotated[float, "those of VTK, whose frames are decoded; loading them included"]

    @property
    def ratio(self) -> float:
        """Time here over VTK's."""
        return self.ours_ms / self.vtk_ms


@dataclass(frozen=True, kw_only=True)
class Quality:
    """One setting of a knob."""

    knob: Annotated[str, "what is set"]
    value: Annotated[float, "what is set"]
    milliseconds: Annotated[float, "of a picture"]
    samples: Annotated[int, "its counter"]
    psnr: Annotated[float | None, "dB to the picture of the finest setting; null where equal"]


@dataclass(frozen=True, kw_only=True)
class RenderBench:
    """Everything that `bench_render` measured.

    Attributes:
        series: source and variable. shape: (t, z, y, x). step: step drawn.
        size: pixels along both sides. turns: runs of each median.
        refused: for each part that could not be measured, the reason.
        machine: date, command line, processor, load, versions. notes: how it was measured.
    """

    series: str
    shape: tuple[int, ...]
    step: float
    size: int
    turns: int
    refused: dict[str, str]
    machine: dict[str, Any]
    notes: tuple[str, ...]
    effects: tuple[Switch, ...] = ()
    accelerations: tuple[Switch, ...] = ()
    streams: tuple[Stream, ...] = ()
    against: tuple[Against, ...] = ()
    exactness: tuple[Exactness, ...] = ()
    playback: tuple[Playback, ...] = ()
    curves: tuple[Quality, ...] = ()
    orbit: tuple[Switch, ...] = ()
    beside: tuple[Beside, ...] = ()
    break_even: tuple[BreakEven, ...] = ()

    def summary(self) -> dict[str, float]:
        """Median and smallest ratio to VTK, for unlit and lit scenes apart; empty without VTK."""
        ratios_to_vtk: dict[str, float] = {}
        for name, shaded in (("unshaded", False), ("shaded", True)):
            ratios = [scene.ratio for scene in self.against if scene.shaded == shaded]
            if ratios:
                ratios_to_vtk |= {f"{name}_median": median(ratios), f"{name}_least": min(ratios)}
        if self.playback:
            ratios_to_vtk["playback_median"] = median(run.ratio for run in self.playback)
        return ratios_to_vtk

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name, the ratios of each, and "summary"."""
        values = asdict(self)
        for name in ("effects", "accelerations", "orbit", "beside", "against", "playback"):
            for entry, record in zip(values[name], getattr(self, name), strict=True):
                entry["ratio"] = record.ratio
        for entry, pair in zip(values["break_even"], self.break_even, strict=True):
            entry |= {"ratio": pair.ratio, "pictures": pair.pictures}
        return {**values, "summary": self.summary()}


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
