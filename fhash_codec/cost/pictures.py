"""Pictures of `fhash cost`: what step length, threshold, level of detail, ARM and effects cost."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.pictures.likeness import black, picture_psnr, picture_ssim
from fhash_codec.cost.allowance import Allowance
from fhash_codec.cost.own import KeptFile
from fhash_codec.cost.reads import LEVELS
from fhash_codec.cost.results import Picture
from fhash_codec.progress import Progress
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Units, complete, warped
from fhash_codec.rendering.plan import Plan
from fhash_codec.rendering.renderer import Renderer, decoded_frame
from fhash_codec.rendering.scenes import (
    AmbientOcclusion,
    AttenuatedMaximum,
    Effects,
    Isosurface,
    Marching,
    Scene,
    Shading,
    Shadows,
)
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.series import Series

__all__ = ["NOTHING", "PictureCosts"]

STEPS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
"""Ray steps, in vertex spacings."""
THRESHOLDS = (0.3, 0.1, 0.03, 0.01, 1 / 256, 1 / 1024)
"""Shares of light at which a ray ends."""
FINEST = {"step": 1 / 32, "threshold": 0.0, "lod": 0.0}
"""Finest setting of each knob; pictures of other settings are compared with its picture."""


SIZE = 384
"""Pixels along both sides."""
MARCH_SIZE = 128
"""Pixels along both sides where ways to march are compared."""
NETWORK_SIZE = 48
"""Pixels along both sides where rays march through a network."""
TURNS = 3
"""Runs of each median."""
NOTHING = "nothing named"
"""Name of the picture without any effect."""

Single = npt.NDArray[np.float32]


class PictureCosts:
    """Pictures of one file, and of others beside it."""

    def __init__(
        self,
        volume: Volume,
        allowance: Allowance,
        progress: Progress,
        pictures: list[Picture],
    ) -> None:
        """Prepare pictures of the middle step of a volume; what is measured goes to `pictures`."""
        self._volume, self._allowance, self._progress = volume, allowance, progress
        self._renderer = Renderer(volume)
        self._scene = Scene(
            size=(SIZE, SIZE),
            step=float(volume.shape[0] // 2),
            background="black",
            march=Marching(mode="cache", lod=0),
        )
        self._pictures = pictures
        self._seconds = 0.0

    def measure(self, series: Series, files: Sequence[KeptFile]) -> None:
        """Measure everything, the most telling first, until the time of the part is over."""
        with self._allowance.work("pictures"):
            self._renderer.render(self._scene)
            begun = time.perf_counter()
            self._renderer.render(self._scene)
            self._seconds = time.perf_counter() - begun
        self._group("effect", self._effects(), best=None)
        self._knob("step length", "step", STEPS)
        if self._volume.profile == "compact":
            side = max(self._volume.box.shape)
            self._knob("level of detail", "lod", [n for n in LEVELS if side > 1 << n])
        self._encodings(series, files)
        if self._volume.profile == "paper":
            self._marches(self._renderer, MARCH_SIZE)
        self._knob("threshold", "threshold", THRESHOLDS)
        self._first_pictures()
        for file in files:
            if not self._allowance.interrupted and file.name.startswith("paper"):
                with open_volume(file.path) as volume:
                    self._marches(Renderer(volume), NETWORK_SIZE)

    def _group(
        self,
        group: str,
        scenes: Mapping[str, Scene],
        *,
        best: str | None,
        renderer: Renderer | None = None,
        turns: int = TURNS,
    ) -> None:
        """Measure scenes in turns; with `best` each is compared with that one."""
        renderer = renderer or self._renderer
        expected = self._seconds * len(scenes)
        if turns > 1 and expected * (turns + 1) > self._allowance.left:
            turns = 1
        if not self._allowance.has(f"pictures by {group}", expected * (turns + 1)):
            return
        begun = time.perf_counter()
        with self._allowance.work(f"pictures by {group}"):
            guarded = self._allowance.guard(self._progress)
            runs = {
                name: partial(renderer.render, scene, progress=guarded)
                for name, scene in scenes.items()
            }
            measured = in_turns(runs, turns)
            self._seconds = (time.perf_counter() - begun) / len(scenes) / (turns + 1)
            for name, (milliseconds, image) in measured.items():
                reference = None if best is None else measured[best][1].rgba
                self._add(group, name, milliseconds, image, reference, best=name == best)
        self._progress("drawing", 1, 1, group)

    def _add(
        self,
        group: str,
        setting: str,
        milliseconds: float,
        image: Image,
        reference: Single | None,
        *,
        best: bool = False,
    ) -> None:
        psnr, ssim = _likeness(image.rgba, reference)
        self._pictures.append(
            Picture(
                group=group,
                setting=setting,
                milliseconds=milliseconds,
                counters=complete(image.counters),
                psnr=psnr,
                ssim=ssim,
                best=best,
            )
        )

    def _effects(self) -> dict[str, Scene]:
        """Each effect alone, after the scene that names none."""
        middle = float(np.mean(self._renderer.plan(self._scene).function.span))
        effects = {
            NOTHING: Effects(),
            "shading": Effects(shading=Shading()),
            "shadows": Effects(shadows=Shadows()),
            "ambient occlusion": Effects(ambient_occlusion=AmbientOcclusion()),
            "isosurface": Effects(isosurfaces=(Isosurface(value=middle),)),
            "maximum intensity": Effects(maximum_intensity=True),
            "minimum intensity": Effects(minimum_intensity=True),
            "average intensity": Effects(average_intensity=True),
            "attenuated maximum": Effects(attenuated_maximum_intensity=AttenuatedMaximum()),
            "depth and normals": Effects(buffers=("depth", "normal")),
            "antialiasing 2": Effects(antialiasing=2),
            "jitter": Effects(jitter=True),
            "box, axes, colour bar": Effects(box=True, axes=True, colour_bar=True),
        }
        return {name: replace(self._scene, effects=chosen) for name, chosen in effects.items()}

    def _knob(self, group: str, knob: str, values: Sequence[float]) -> None:
        """Vary one setting of the march against its finest value."""
        finest = FINEST[knob]
        scenes = {f"{value:.4g}": self._with(knob, value) for value in (*values, finest)}
        self._group(group, scenes, best=f"{finest:.4g}")

    def _with(self, knob: str, value: float) -> Scene:
        changed: dict[str, Any] = {knob: int(value) if knob == "lod" else value}
        return replace(self._scene, march=replace(self._scene.march, **changed))

    def _marches(self, renderer: Renderer, side: int) -> None:
        """Compare the cache with rays through a network: sample by sample, and adaptive (ARM)."""
        scenes = {
            name: replace(
                self._scene,
                size=(side, side),
                march=replace(self._scene.march, mode=mode),
            )
            for name, mode in (
                ("cache", "cache"),
                ("stream, ARM off", "stream"),
                ("ARM on", "arm"),
            )
        }
        self._group(f"march, paper, {side} px", scenes, best="cache", renderer=renderer, turns=1)

    def _first_pictures(self) -> None:
        """Compare first pictures of a step by level of detail: nothing is decoded yet."""
        if self._volume.profile == "compact":
            levels = [0, *(n for n in LEVELS if max(self._volume.box.shape) > 1 << n)]
            scenes = {f"{level}": self._with("lod", level) for level in levels}
            fresh = Renderer(self._volume, memory=0)
            self._group("level of detail, first picture", scenes, best="0", renderer=fresh)

    def _encodings(self, series: Series, files: Sequence[KeptFile]) -> None:
        """Compare the picture of each file with that of the source, all by one plan."""
        group = "encoding"
        if not self._allowance.has(f"pictures by {group}", 2 * self._seconds * (len(files) + 1)):
            return
        plan = self._renderer.plan(self._scene)
        with self._allowance.work(f"pictures by {group}"):
            reference = _marched(source_frame(series, plan), plan)
            for file in files:
                with open_volume(file.path) as volume:
                    begun = time.perf_counter()
                    frame = decoded_frame(volume, plan.step, 0, plan.region, plan.units)
                    image = _marched(frame, plan)
                    seconds = time.perf_counter() - begun
                counters = {**image.counters, "decoded_vertices": frame.values.size}
                image = replace(image, counters=counters)
                self._add(group, file.name, 1e3 * seconds, image, reference.rgba)
            self._add(group, "the source", 0.0, reference, None, best=True)


def source_frame(series: Series, plan: Plan) -> Frame:
    """The frame of the source that a plan decodes from a file, in the units of its march."""
    values = series.read(int(plan.step))[tuple(slice(*span) for span in plan.region)]
    converted = values if plan.units == Units() else plan.units.to(values)
    z, y, x = (low for low, _ in plan.region)
    return Frame(values=np.ascontiguousarray(converted, dtype=np.float32), first=(z, y, x))


def _marched(frame: Frame, plan: Plan) -> Image:
    """A picture of a frame by the task of a plan, without what is drawn around it."""
    result = march(warped(frame, plan.task.rays.grid.warp), plan.task)
    return Image(
        rgba=result.rgba,
        depth=None,
        normal=None,
        counters=complete(result.counters),
        scene={},
        source="",
        digest="",
    )


def _likeness(rgba: Single, reference: Single | None) -> tuple[float | None, float | None]:
    """PSNR in dB and SSIM of a picture against another; None without one."""
    if reference is None:
        return None, None
    if reference is rgba:
        return None, 1.0
    return picture_psnr(rgba, reference, 1.0), picture_ssim(black(rgba), black(reference))


def in_turns(runs: Mapping[str, Callable[[], Image]], turns: int) -> dict[str, tuple[float, Image]]:
    """Run every variant once without timing, then in turns.

    Returns the median milliseconds and the last picture of each variant.
    """
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    images = {name: run() for name, run in runs.items()}
    for _ in range(turns):
        for name, run in runs.items():
            begun = time.perf_counter()
            images[name] = run()
            seconds[name].append(time.perf_counter() - begun)
    return {name: (1e3 * median(seconds[name]), images[name]) for name in runs}
