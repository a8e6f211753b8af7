"""VTK beside this renderer on one machine, in turns.

Both get the same decoded frames, transfer functions, cameras and steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.pictures.likeness import black, picture_psnr, picture_ssim
from fhash_codec.bench.pictures.reference import vtk_picture
from fhash_codec.bench.pictures.results import Against, Exactness, Playback
from fhash_codec.bench.pictures.vtk_peer import VtkPeer, require_vtk
from fhash_codec.progress import Progress
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Units, warped
from fhash_codec.rendering.plan import Plan
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import GRADIENTS, Scene, Shading, TransferFunctionSpec
from fhash_codec.volume import Volume
from fhash_formats.support.threads import usable_threads

__all__ = ["Comparison", "transfer_functions"]

Single = npt.NDArray[np.float32]

PLAYED = 12
"""Steps that are played back at most."""
FINE = 0.05
"""Ray step, in vertex spacings, of compared pictures: so fine that sample places hardly matter."""
FINE_SIZE = 256
"""Pixels along both sides of pictures with fine steps."""
EXPLAINED = 0.2
"""Ray step, in vertex spacings, of pictures by VTK's own conventions, which are slow."""
EXPLAINED_SIZE = 128
"""Pixels along both sides of those pictures."""
SHADING = Shading()


class Comparison:
    """Scenes of one volume, here and in VTK."""

    def __init__(self, volume: Volume, scene: Scene, turns: int, progress: Progress) -> None:
        require_vtk()
        self.volume, self.scene, self.turns, self.progress = volume, scene, turns, progress
        self.renderer = Renderer(volume)
        plan = self.renderer.plan(scene)
        self.step, self.units = plan.step, plan.units
        self.values = whole_frame(volume, self.step, self.units)
        self.functions = transfer_functions(self.values, self.units)
        self.version = ""

    def against(self) -> tuple[Against, ...]:
        """Time marching beside VTK's fixed-point ray caster.

        Each transfer function is drawn unlit and lit, at the size and at twice the size.
        """
        results = []
        frame = Frame(values=self.values, first=(0, 0, 0))
        bricks = Bricks.of(frame)
        variants = [
            (scale, name, shaded)
            for scale in (1, 2)
            for name in self.functions
            for shaded in (False, True)
        ]
        for number, (scale, name, shaded) in enumerate(variants):
            side = scale * self.scene.size[0]
            scene = self._scene(name, shaded, side)
            plans = [
                self.renderer.plan(turned(scene, turn, self.turns)) for turn in range(self.turns)
            ]
            with (
                self._peer(plans[0], "cpu") as peer,
                self._peer(plans[0], "cpu", empty=True) as window,
            ):
                for plan in plans[:1]:
                    peer.look(plan.task.rays)
                    peer.draw()
                    window.draw()
                    march(frame, plan.task, bricks=bricks)
                    self.renderer.render(plan=plan)
                ours, whole, theirs, nothing, likeness = [], [], [], [], []
                samples = 0
                for plan in plans:
                    marched, seconds = timed(partial(march, frame, plan.task, bricks=bricks))
                    ours.append(seconds)
                    peer.look(plan.task.rays)
                    drawn = peer.draw()
                    theirs.append(drawn.seconds)
                    nothing.append(window.draw().seconds)
                    whole.append(timed(partial(self.renderer.render, plan=plan))[1])
                    pixels = black(marched.rgba)
                    likeness.append(
                        (
                            picture_psnr(pixels, drawn.pixels, 255.0),
                            picture_ssim(pixels, drawn.pixels),
                        )
                    )
                    samples = max(samples, int(marched.counters["samples"]))
            different = [psnr for psnr, _ in likeness if psnr is not None]
            results.append(
                Against(
                    scene=name,
                    shaded=shaded,
                    size=side,
                    ours_ms=1e3 * median(ours),
                    whole_ms=1e3 * median(whole),
                    vtk_ms=1e3 * max(median(theirs) - median(nothing), 0.0),
                    window_ms=1e3 * median(nothing),
                    psnr=median(different) if different else None,
                    ssim=median(similarity for _, similarity in likeness),
                    samples=samples,
                )
            )
            self.progress("beside VTK", number + 1, len(variants), name)
        return tuple(results)

    def exactness(self) -> tuple[Exactness, ...]:
        """Pictures of VTK's mapper for graphics cards, at fine steps."""
        results = []
        frame = Frame(values=self.values, first=(0, 0, 0))
        for name in self.functions:
            explained = {shaded: self._explained(name, shaded) for shaded in (False, True)}
            for gradient in ("", *GRADIENTS):
                scene = self._scene(name, bool(gradient), FINE_SIZE)
                if gradient:
                    scene = replace(
                        scene, effects=replace(scene.effects, shading=Shading(gradient=gradient))
                    )
                plan = self.renderer.plan(
                    replace(scene, march=replace(scene.march, step=FINE, threshold=0.0))
                )
                with self._peer(plan, "gpu") as peer:
                    peer.look(plan.task.rays)
                    peer.draw()  # the first picture is of a frame that is not all there yet
                    theirs = peer.draw().pixels
                ours = black(march(frame, plan.task).rgba)
                results.append(
                    Exactness(
                        scene=name,
                        gradient=gradient,
                        size=FINE_SIZE,
                        step=FINE,
                        psnr=picture_psnr(ours, theirs, 255.0),
                        ssim=picture_ssim(ours, theirs),
                        largest=int(np.max(np.abs(ours.astype(np.int16) - theirs))),
                        explained=explained[bool(gradient)],
                    )
                )
            self.progress("exactness", len(results), 3 * len(self.functions), name)
        return tuple(results)

    def _explained(self, name: str, shaded: bool) -> float | None:
        """PSNR of VTK's picture to a slow one with VTK's own samples, gradients and highlights."""
        scene = self._scene(name, shaded, EXPLAINED_SIZE)
        plan = self.renderer.plan(
            replace(scene, march=replace(scene.march, step=EXPLAINED, threshold=0.0))
        )
        with self._peer(plan, "gpu") as peer:
            peer.look(plan.task.rays)
            peer.draw()
            theirs = peer.draw().pixels
        return picture_psnr(black(vtk_picture(self.values, plan.task)), theirs, 255.0)

    def playback(self) -> tuple[Playback, ...]:
        """Time playing the steps from the first on, each drawn for the first time.

        This renderer starts empty and decodes each frame; VTK's frames are decoded in memory.
        """
        results = []
        steps = [float(step) for step in range(min(self.volume.shape[0], PLAYED + 1))]
        frames = [whole_frame(self.volume, step, self.units) for step in steps]
        for name in self.functions:
            for shaded in (False, True):
                scene = self._scene(name, shaded, self.scene.size[0])
                renderer = Renderer(self.volume)
                plan = renderer.plan(replace(scene, step=steps[0], time=None))
                ours, theirs = [], []
                with self._peer(plan, "cpu") as peer:
                    peer.look(plan.task.rays)
                    shown = [replace(scene, step=step, time=None) for step in steps]
                    for current, following, values in zip(
                        shown, [*shown[1:], None], frames, strict=True
                    ):
                        draw = partial(renderer.render, current, upcoming=following)
                        ours.append(timed(draw)[1])
                        begun = time.perf_counter()
                        peer.load(values)
                        peer.draw()
                        theirs.append(time.perf_counter() - begun)
                # The first step pays for what happens once.
                rest = slice(1 if len(steps) > 1 else 0, None)
                results.append(
                    Playback(
                        scene=name,
                        shaded=shaded,
                        size=self.scene.size[0],
                        steps=len(ours[rest]),
                        ours_ms=1e3 * median(ours[rest]),
                        vtk_ms=1e3 * median(theirs[rest]),
                    )
                )
            self.progress("playback", len(results), 2 * len(self.functions), name)
        return tuple(results)

    def _scene(self, name: str, shaded: bool, side: int) -> Scene:
        effects = replace(self.scene.effects, shading=SHADING if shaded else None, isosurfaces=())
        spec = replace(self.functions[name], colours=self.scene.transfer_function.colours)
        return replace(
            self.scene,
            size=(side, side),
            transfer_function=spec,
            effects=effects,
            march=replace(self.scene.march, lod=0, mode="cache"),
        )

    @contextmanager
    def _peer(self, plan: Plan, mapper: str, *, empty: bool = False) -> Iterator[VtkPeer]:
        assert plan.task.table is not None
        peer = VtkPeer(
            self.values,
            plan.task.rays.grid,
            plan.task.table,
            unit=plan.function.unit_distance,
            size=plan.task.rays.size,
            step=plan.task.step,
            mapper=mapper,
            lighting=plan.task.lighting,
            threads=usable_threads(),
            empty=empty,
        )
        try:
            yield peer
            self.version = peer.version  # known once it has drawn
        finally:
            peer.close()


def turned(scene: Scene, turn: int, turns: int) -> Scene:
    """The scene from another side."""
    return replace(
        scene, camera=replace(scene.camera, azimuth=scene.camera.azimuth + 360.0 * turn / turns)
    )


def whole_frame(volume: Volume, step: float, units: Units) -> Single:
    """Values (z, y, x) of the whole domain in marched units.

    The background stands for missing values, which VTK does not know. Uneven axes are resampled as
    they are drawn.
    """
    values = volume.read(step, outside="background")
    values[~np.isfinite(values)] = volume.background
    marched = np.ascontiguousarray(
        values if units == Units() else units.to(values), dtype=np.float32
    )
    return warped(Frame(values=marched, first=(0, 0, 0)), Grid.of(volume.coords).warp).values


def transfer_functions(values: Single, units: Units) -> dict[str, TransferFunctionSpec]:
    """Two transfer functions that suit the values: a feature and a fog.

    `feature` is a narrow band of frequent values away from the background; `fog` grows with the
    value.
    """
    low, high = float(values.min()), float(values.max())
    extent = max(high - low, 1e-6 * abs(low), 1e-30)
    above = values[values > low + 0.01 * extent]
    first, last = np.quantile(above, [0.9, 0.985]) if above.size else (low, high)
    last = max(float(last), float(first) + 0.01 * extent)
    edge = 0.1 * (last - first)
    band = np.array([first, first + edge, last - edge, last]) / units.factor + units.shift
    ends = np.array([low, low + extent]) / units.factor + units.shift
    return {
        "feature": TransferFunctionSpec(
            opacity=tuple((float(v), o) for v, o in zip(band, (0.0, 0.3, 0.3, 0.0), strict=True))
        ),
        "fog": TransferFunctionSpec(
            opacity=tuple((float(v), o) for v, o in zip(ends, (0.0, 0.02), strict=True))
        ),
    }


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """Result of a call, and the seconds it took."""
    begun = time.perf_counter()
    result = run()
    return result, time.perf_counter() - begun
