"""What `fhash bench render` finds, as records and JSON values. Times are medians in milliseconds of runs in turns."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

PARTS = ("effects", "accelerations", "streams", "vtk", "exactness", "playback", "curves")
"""What there is to measure."""


@dataclass(frozen=True, kw_only=True)
class Switch:
    """An effect or an acceleration on and off, all else alike.

    counters_on, counters_off: of the last picture. psnr: between the two pictures in dB, None where they are equal or meant to differ.
    """

    name: str
    off_ms: float
    on_ms: float
    counters_off: dict[str, int]
    counters_on: dict[str, int]
    psnr: float | None

    @property
    def ratio(self) -> float:
        """Time with it over time without."""
        return self.on_ms / self.off_ms


@dataclass(frozen=True, kw_only=True)
class Stream:
    """A way to march: `budget` is N_r, None for the number of rays; psnr (dB) and the largest difference (0..1) to the cached march."""

    mode: str
    budget: int | None
    milliseconds: float
    passes: int
    samples: int
    evaluations: int
    psnr: float | None
    largest: float


@dataclass(frozen=True, kw_only=True)
class Against:
    """A scene here and by VTK's fixed-point ray caster: the same decoded frame, transfer function, camera, step and threads.

    ours_ms: of marching. whole_ms: of `Renderer.render`, plan and all. vtk_ms: of `Render` less `window_ms`, that of an empty window.
    psnr (dB), ssim: between the pictures. samples: values that were looked up here.
    """

    scene: str
    shaded: bool
    size: int
    ours_ms: float
    whole_ms: float
    vtk_ms: float
    window_ms: float
    psnr: float | None
    ssim: float
    samples: int

    @property
    def ratio(self) -> float:
        """Times faster than VTK."""
        return self.vtk_ms / self.ours_ms


@dataclass(frozen=True, kw_only=True)
class Exactness:
    """The picture here and by VTK's mapper for graphics cards at a step of `step` vertex spacings: PSNR (dB), SSIM, largest byte apart.

    gradient: that the picture here is lit by, of the cell or by central differences, as VTK's is; empty where it is not lit.
    explained: PSNR of VTK's picture to one computed slowly by VTK's conventions for samples, gradients and highlights, at a coarser step.
    """

    scene: str
    gradient: str
    size: int
    step: float
    psnr: float | None
    ssim: float
    largest: int
    explained: float | None


@dataclass(frozen=True, kw_only=True)
class Playback:
    """A step after another, each for the first time: decoding included here; frames already decoded, taking them up included, in VTK."""

    scene: str
    shaded: bool
    size: int
    steps: int
    ours_ms: float
    vtk_ms: float

    @property
    def ratio(self) -> float:
        """Time here over VTK's."""
        return self.ours_ms / self.vtk_ms


@dataclass(frozen=True, kw_only=True)
class Quality:
    """One setting of a knob: time, samples, and the PSNR (dB) to the picture of its finest setting, None where they are equal."""

    knob: str
    value: float
    milliseconds: float
    samples: int
    psnr: float | None


@dataclass(frozen=True, kw_only=True)
class RenderBench:
    """What `bench_render` measured; `refused`: by part, why it could not be. turns: runs that each median is of."""

    series: str
    shape: tuple[int, ...]
    step: float
    size: int
    turns: int
    effects: tuple[Switch, ...]
    accelerations: tuple[Switch, ...]
    streams: tuple[Stream, ...]
    against: tuple[Against, ...]
    exactness: tuple[Exactness, ...]
    playback: tuple[Playback, ...]
    curves: tuple[Quality, ...]
    refused: dict[str, str]
    machine: dict[str, Any]
    notes: tuple[str, ...]

    def summary(self) -> dict[str, float]:
        """Medians and the least of the ratios to VTK, for unlit and lit scenes apart, where there are any."""
        found: dict[str, float] = {}
        for name, shaded in (("unshaded", False), ("shaded", True)):
            ratios = [each.ratio for each in self.against if each.shaded == shaded]
            if ratios:
                found |= {f"{name}_median": median(ratios), f"{name}_least": min(ratios)}
        if self.playback:
            found["playback_median"] = median(each.ratio for each in self.playback)
        return found

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name, the ratios of each, and "summary"."""
        values = asdict(self)
        for name in ("effects", "accelerations", "against", "playback"):
            for entry, each in zip(values[name], getattr(self, name), strict=True):
                entry["ratio"] = each.ratio
        return {**values, "summary": self.summary()}
