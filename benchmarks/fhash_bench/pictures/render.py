"""Cost of effects and accelerations, ARM, and quality against time: `fhash bench render`."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from ctypes import CDLL
from dataclasses import replace
from functools import cache, partial
from statistics import median
from typing import Any

import numpy as np

from fhash_bench.pictures.results import (
    NETWORK_PARTS,
    PARTS,
    BreakEven,
    Quality,
    RenderBench,
    Stream,
    Switch,
)
from fhash_bench.pictures.shell import beside_shell, find_ospray, load_ospray, orbit
from fhash_bench.pictures.vtk import Comparison
from fhash_codec.cost.uses import FINEST, STEPS, THRESHOLDS, in_turns, picture_psnr
from fhash_codec.devices import machine
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import (
    AmbientOcclusion,
    AttenuatedMaximum,
    Effects,
    Isosurface,
    Scene,
    Shading,
    Shadows,
    TransferFunctionSpec,
)
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.support.threads import usable_threads

SIZES = (4, 8, 16, 32, 64, 128)
"""Pixels along both sides of the pictures."""
LOST = 4.0
"""Times of the cache at which larger pictures are not marched through the model any more."""
MAX_TURNS = 3
"""Largest number of runs of each median: a run may take seconds."""


def break_even(
    volume: Volume, scene: Scene, turns: int, size: int, progress: Progress
) -> tuple[BreakEven, ...]:
    """Measure first and later pictures of one step by the cache and by adaptive ray marching.

    Args:
        volume: an open container.
        scene: what is shown.
        turns: runs of each median.
        size: largest pixels along both sides.
        progress: called after each size.
    """
    kept = Renderer(volume)
    first = Renderer(volume, memory=0)
    results: list[BreakEven] = []
    sizes = [side for side in SIZES if side <= size]
    for number, side in enumerate(sizes, start=1):
        march = replace(scene.march, lod=0)
        cached, marched, auto = (
            replace(scene, size=(side, side), march=replace(march, mode=mode))
            for mode in ("cache", "arm", "auto")
        )
        for renderer in (first, kept):  # a histogram of the series is no part of a picture
            renderer.plan(cached)
        kept.render(cached)
        times: dict[str, list[float]] = {"first": [], "kept": [], "arm": []}
        for _ in range(min(turns, MAX_TURNS)):
            times["first"].append(_seconds(first, cached)[0])
            times["kept"].append(_seconds(kept, cached)[0])
            seconds, image = _seconds(first, marched)
            times["arm"].append(seconds)
        results.append(
            BreakEven(
                size=side,
                first_ms=1e3 * median(times["first"]),
                kept_ms=1e3 * median(times["kept"]),
                arm_ms=1e3 * median(times["arm"]),
                evaluations=int(image.counters["evaluations"]),
                auto=first.plan(auto).mode,
            )
        )
        progress("break-even", number, len(sizes), f"{side} pixels")
        if results[-1].ratio > LOST:
            break
    return tuple(results)


def _seconds(renderer: Renderer, scene: Scene) -> tuple[float, Image]:
    """Time of a picture, and the picture."""
    begun = time.perf_counter()
    image = renderer.render(scene)
    return time.perf_counter() - begun, image


FIELDS = {"shell": "beside", "break-even": "break_even", "vtk": "against"}
"""Fields of the result that have another name than their part."""
TURNS = 5
"""Runs of each median, by default."""
SIZE = 512
"""Pixels along both sides, by default."""
STREAM_SIZE = 128
"""Pixels along both sides where rays march through the model, which is slow on a CPU."""
NEAREST = 1e-2
"""Smallest zoom of the search for one at which a pixel is as wide as several vertices."""
LEVELS = (3, 2, 1)
"""Levels of detail."""
NOTES = (
    "milliseconds are medians of runs in turns: each turn runs every variant once,"
    " from another side in comparisons with VTK",
    "pictures are compared over black; 'ours' against VTK is marching a decoded frame,"
    " 'whole' all of Renderer.render with the frame kept",
    "VTK's time is that of Render less that of a window with nothing in it;"
    " both take as many threads as there are processors",
    "playback: decoding counts here, VTK has its frames decoded and takes them up",
    "VTK takes its samples at whole steps from the entry of a ray, here they lie in the middle of"
    " steps; its gradients are central differences over two vertices, here they are those of the"
    " cell; its highlights follow the mirrored ray: 'by its rules' is the PSNR of VTK's picture to"
    " a slow one that does all three as VTK does",
)


def bench_render(
    volume: Volume,
    scene: Scene | None = None,
    *,
    parts: Sequence[str] = PARTS,
    size: int = SIZE,
    turns: int = TURNS,
    ospray: str | None = None,
    progress: Progress = silent,
) -> RenderBench:
    """Measure pictures of a volume.

    Args:
        volume: an open container.
        scene: shown where effects, accelerations, streams and curves are measured; its own size and
            effects are ignored.
        parts: names of `PARTS` to measure.
        size: pixels along both sides; VTK is compared at twice the size too.
        turns: runs of each median.
        ospray: file, folder or Python module of an OSPRay library, for the part `shell`.

    Raises InputError for unknown parts, for a size or turns that are too small, and for an OSPRay
    that cannot be used. The result lists as refused the parts of VTK without VTK, and those of
    NETWORK_PARTS of a file without a network.
    """
    scene = scene or Scene()
    for part in parts:
        if part not in PARTS:
            raise InputError(f"part is '{part}'; allowed: {', '.join(PARTS)}")
    if not parts or turns < 1 or size < 16:
        raise InputError(
            f"{len(parts)} parts, {turns} turns, {size} pixels;"
            " at least one part, one turn and 16 pixels are needed"
        )
    if ospray is not None and "shell" not in parts:
        raise InputError("OSPRay is a peer of the part 'shell'; name that part too")
    library = (
        None if ospray is None else load_ospray(find_ospray(ospray).resolve(), usable_threads())
    )
    plain = replace(
        scene,
        size=(size, size),
        effects=Effects(isosurfaces=scene.effects.isosurfaces),
        background="black",
    )
    bench = _Bench(volume, plain, turns, progress)
    results, refused, version = _measure(bench, parts, library)
    used = machine()
    if version is not None:
        used["vtk"] = version
    return RenderBench(
        series=f"{volume.path} {volume.name}",
        shape=volume.shape,
        step=bench.step,
        size=size,
        turns=turns,
        **{FIELDS.get(part, part): measured for part, measured in results.items()},
        refused=refused,
        machine=used,
        notes=NOTES,
    )


def _measure(
    bench: _Bench, parts: Sequence[str], ospray: tuple[CDLL, str] | None
) -> tuple[dict[str, tuple[Any, ...]], dict[str, str], str | None]:
    """Measure the parts: results, reasons of parts that were refused, and VTK's version if used."""

    @cache
    def beside() -> Comparison:
        return Comparison(bench.volume, bench.scene, bench.turns, bench.progress)

    measurements: Mapping[str, Callable[[], tuple[Any, ...]]] = {
        "effects": bench.effects,
        "accelerations": bench.accelerations,
        "orbit": partial(orbit, bench.turns, bench.scene.size[0]),
        "shell": partial(beside_shell, bench.turns, bench.scene.size[0], ospray, bench.progress),
        "streams": bench.streams,
        "break-even": lambda: break_even(
            bench.volume, bench.scene, bench.turns, bench.scene.size[0], bench.progress
        ),
        "vtk": lambda: beside().against(),
        "exactness": lambda: beside().exactness(),
        "playback": lambda: beside().playback(),
        "curves": bench.curves,
    }
    results: dict[str, tuple[Any, ...]] = {}
    refused: dict[str, str] = {}
    for part in dict.fromkeys(parts):
        if part in NETWORK_PARTS and bench.volume.profile != "paper":
            refused[part] = "the file has no network to march through"
            continue
        try:
            results[part] = measurements[part]()
        except MissingDependencyError as error:
            refused[part] = str(error)
    return results, refused, beside().version if beside.cache_info().currsize else None


class _Bench:
    """Measurements that need no peer."""

    def __init__(self, volume: Volume, scene: Scene, turns: int, progress: Progress) -> None:
        self.volume, self.scene, self.turns, self.progress = volume, scene, turns, progress
        self.renderer = Renderer(volume)
        self.step = self.renderer.plan(scene).step

    def effects(self) -> tuple[Switch, ...]:
        """Each effect alone beside the scene without any."""
        middle = float(np.mean(self.renderer.plan(self.scene).function.span))
        none = self.scene.effects
        variants = {
            "shading": replace(none, shading=Shading()),
            "shadows": replace(none, shadows=Shadows()),
            "ambient occlusion": replace(none, ambient_occlusion=AmbientOcclusion()),
            "shading, shadows, ambient occlusion": replace(
                none, shading=Shading(), shadows=Shadows(), ambient_occlusion=AmbientOcclusion()
            ),
            "isosurface": replace(none, isosurfaces=(*none.isosurfaces, Isosurface(value=middle))),
            "translucent isosurface": replace(
                none, isosurfaces=(*none.isosurfaces, Isosurface(value=middle, opacity=0.4))
            ),
            "maximum intensity": replace(none, maximum_intensity=True),
            "minimum intensity": replace(none, minimum_intensity=True),
            "average intensity": replace(none, average_intensity=True),
            "attenuated maximum intensity": replace(
                none, attenuated_maximum_intensity=AttenuatedMaximum()
            ),
            "depth buffer": replace(none, buffers=("depth",)),
            "depth and normal buffers": replace(none, buffers=("depth", "normal")),
            "jitter": replace(none, jitter=True),
            "antialiasing 2": replace(none, antialiasing=2),
            "box and axes": replace(none, box=True, axes=True),
            "colour bar and time label": replace(none, colour_bar=True, time_label=True),
        }
        return self._switches(
            {
                name: (self.scene, replace(self.scene, effects=effects))
                for name, effects in variants.items()
            },
            "effects",
        )

    def accelerations(self) -> tuple[Switch, ...]:
        """Measure skipping, early termination and level of detail on and off, and compare their
        pictures."""
        scene, march = self.scene, self.scene.march
        opaque = replace(scene, transfer_function=_dense(scene.transfer_function))
        pairs = {
            "skipping": (
                replace(scene, march=replace(march, skipping=False)),
                replace(scene, march=replace(march, skipping=True)),
            ),
            "early termination": (
                replace(scene, march=replace(march, threshold=0.0)),
                replace(scene, march=replace(march, threshold=1 / 1024)),
            ),
            "early termination, density 50": (
                replace(opaque, march=replace(march, threshold=0.0)),
                replace(opaque, march=replace(march, threshold=1 / 1024)),
            ),
        }
        far = replace(scene, march=replace(march, lod=None))
        while (level := self.renderer.plan(far).lod) == 0 and far.camera.zoom > NEAREST:
            far = replace(far, camera=replace(far.camera, zoom=far.camera.zoom / 2))
        if level > 0:
            pairs[f"level of detail {level}, zoom {far.camera.zoom:g}"] = (
                replace(far, march=replace(march, lod=0)),
                far,
            )
        return self._switches(pairs, "accelerations", compare=True)

    def _switches(
        self, pairs: Mapping[str, tuple[Scene, Scene]], stage: str, *, compare: bool = False
    ) -> tuple[Switch, ...]:
        found = []
        for number, (name, (without, with_)) in enumerate(pairs.items()):
            measured = in_turns(
                {
                    "off": partial(self.renderer.render, without),
                    "on": partial(self.renderer.render, with_),
                },
                self.turns,
            )
            (off_ms, off), (on_ms, on) = measured["off"], measured["on"]
            found.append(
                Switch(
                    name=name,
                    off_ms=off_ms,
                    on_ms=on_ms,
                    counters_off=dict(off.counters),
                    counters_on=dict(on.counters),
                    psnr=picture_psnr(on.rgba, off.rgba, 1.0) if compare else None,
                )
            )
            self.progress(stage, number + 1, len(pairs), name)
        return tuple(found)

    def streams(self) -> tuple[Stream, ...]:
        """Measure the cached march, streaming, and adaptive ray marching on a small picture."""
        small = replace(
            self.scene, size=(STREAM_SIZE, STREAM_SIZE), march=replace(self.scene.march, lod=0)
        )
        variants = {
            mode: replace(small, march=replace(small.march, mode=mode))
            for mode in ("cache", "stream", "arm")
        }
        # A whole turn takes seconds through the model: the fewest that have a median.
        measured = in_turns(
            {mode: partial(self.renderer.render, scene) for mode, scene in variants.items()},
            min(self.turns, 3),
        )
        self.progress("streams", 1, 1, "")
        _, cached = measured["cache"]
        return tuple(
            Stream(
                mode=mode,
                milliseconds=milliseconds,
                samples=int(image.counters["samples"]),
                evaluations=int(image.counters["evaluations"]),
                psnr=picture_psnr(image.rgba, cached.rgba, 1.0),
                largest=float(np.max(np.abs(image.rgba - cached.rgba))),
            )
            for mode, (milliseconds, image) in measured.items()
        )

    def curves(self) -> tuple[Quality, ...]:
        """Each knob swept, the others as the scene has them, against its finest setting."""
        knobs: dict[str, Sequence[float]] = {"step": STEPS, "threshold": THRESHOLDS}
        if self.volume.profile == "compact":
            most = max(int(np.log2(max(min(self.volume.box.shape) - 1, 1))), 0)
            knobs["lod"] = [level for level in LEVELS if level <= most]
        found = []
        for knob, values in knobs.items():
            scenes = {f"{value:g}": self._with(knob, value) for value in (*values, FINEST[knob])}
            measured = in_turns(
                {name: partial(self.renderer.render, scene) for name, scene in scenes.items()},
                self.turns,
            )
            finest = measured[f"{FINEST[knob]:g}"][1]
            found += [
                Quality(
                    knob=knob,
                    value=float(name),
                    milliseconds=milliseconds,
                    samples=int(image.counters["samples"]),
                    psnr=picture_psnr(image.rgba, finest.rgba, 1.0),
                )
                for name, (milliseconds, image) in measured.items()
            ]
            self.progress("curves", len(found), sum(map(len, knobs.values())) + len(knobs), knob)
        return tuple(found)

    def _with(self, knob: str, value: float) -> Scene:
        march = self.scene.march
        changed = {"lod": 0, knob: int(value) if knob == "lod" else value}
        return replace(self.scene, march=replace(march, **changed))  # type: ignore[arg-type]


def _dense(spec: TransferFunctionSpec) -> TransferFunctionSpec:
    return replace(spec, density=50 * spec.density)
