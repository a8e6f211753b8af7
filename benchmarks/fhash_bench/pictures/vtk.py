"""Peer VTK: its volume mappers, a picture by its rules in float64, and comparisons in turns."""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_bench.pictures.results import Against, Exactness, Playback
from fhash_codec.cost.uses import black, picture_psnr, picture_ssim
from fhash_codec.progress import Progress
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Lighting, Table, Task, Units, warped
from fhash_codec.rendering.plan import Plan
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import GRADIENTS, Scene, Shading, TransferFunctionSpec
from fhash_codec.volume import Volume
from fhash_formats.errors import MissingDependencyError
from fhash_formats.support.threads import usable_threads
from fhash_formats.support.values import Double, Single

Pixels = npt.NDArray[np.uint8]

MAPPERS = ("cpu", "gpu")
"""vtkFixedPointVolumeRayCastMapper, and the mapper for graphics cards, which software OpenGL also
runs."""
POINTS = 2048
"""Points of the transfer functions that VTK is given."""
MODULES = {
    "vtkCommonCore": ("vtkLogger", "vtkUnsignedCharArray", "vtkVersion"),
    "vtkCommonDataModel": ("vtkImageData", "vtkPiecewiseFunction"),
    "vtkRenderingCore": (
        "vtkColorTransferFunction",
        "vtkRenderer",
        "vtkRenderWindow",
        "vtkVolume",
        "vtkVolumeProperty",
    ),
    "vtkRenderingOpenGL2": (),
    "vtkRenderingVolume": ("vtkFixedPointVolumeRayCastMapper",),
    "vtkRenderingVolumeOpenGL2": ("vtkOpenGLGPUVolumeRayCastMapper",),
    "util.numpy_support": ("numpy_to_vtk", "vtk_to_numpy"),
}


def require_vtk() -> SimpleNamespace:
    """Import the names of VTK that are used here; raises MissingDependencyError."""
    loaded_names = {}
    try:
        for module, names in MODULES.items():
            loaded = importlib.import_module(f"vtkmodules.{module}")
            loaded_names.update({name: getattr(loaded, name) for name in names})
    except ImportError as error:
        raise MissingDependencyError(
            "comparing with VTK needs it: pip install 'fhash[bench]'"
        ) from error
    return SimpleNamespace(**loaded_names)


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """Bytes (H, W, 3) over black, the first row the top, and the seconds of `Render`."""

    pixels: Pixels
    seconds: float


class VtkPeer:
    """A window of VTK with one volume; what it shows is set by `look`, `load` and `shade`."""

    def __init__(
        self,
        values: Single,
        task: Task,
        *,
        unit: float,
        mapper: str = "cpu",
        threads: int | None = None,
        empty: bool = False,
    ) -> None:
        """Open a window.

        Args:
            values: (z, y, x) of the whole domain, all finite.
            task: what is drawn: the grid, transfer function, pixels, ray step and lighting.
            unit: length that VTK's opacities refer to, in units of the coordinates.
            mapper: one of MAPPERS.
            threads: threads of the `cpu` mapper.
            empty: the window shows nothing.
        """
        assert task.table is not None
        self.vtk = vtk = require_vtk()
        self.grid = grid = task.rays.grid
        self.image = vtk.vtkImageData()
        nx, ny, nz = grid.counts
        self.image.SetDimensions(nx, ny, nz)
        self.image.SetSpacing(*(abs(float(part)) for part in grid.spacing))
        self.image.SetOrigin(*(float(min(part)) for part in grid.corners))
        self.load(values)
        self.mapper = self._mapper(mapper, task.step, threads)
        self.property = vtk.vtkVolumeProperty()
        self.property.SetInterpolationTypeToLinear()
        self.property.SetScalarOpacityUnitDistance(unit)
        self._give(task.table, unit)
        self.shade(task.lighting)
        volume = vtk.vtkVolume()
        volume.SetMapper(self.mapper)
        volume.SetProperty(self.property)
        self.renderer = vtk.vtkRenderer()
        if not empty:
            self.renderer.AddVolume(volume)
        self.renderer.SetBackground(0, 0, 0)
        # VTK warns of every display that it tries in vain.
        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_ERROR)
        self.window = vtk.vtkRenderWindow()
        if not self.window.SupportsOpenGL():
            raise MissingDependencyError(
                "VTK finds no OpenGL;"
                " install a software one such as Mesa's EGL (libegl1, libgl1-mesa-dri)"
            )
        self.window.SetOffScreenRendering(1)
        self.window.SetMultiSamples(0)
        self.window.SetSize(*task.rays.size)
        self.window.AddRenderer(self.renderer)

    def _mapper(self, name: str, step: float, threads: int | None) -> Any:
        """One of MAPPERS with a fixed ray step, for the image."""
        mapper = (
            self.vtk.vtkFixedPointVolumeRayCastMapper()
            if name == "cpu"
            else self.vtk.vtkOpenGLGPUVolumeRayCastMapper()
        )
        mapper.SetInputData(self.image)
        mapper.AutoAdjustSampleDistancesOff()
        mapper.SetSampleDistance(step)
        if name == "cpu":
            mapper.SetInteractiveSampleDistance(step)
            mapper.LockSampleDistanceToInputSpacingOff()
            mapper.SetNumberOfThreads(threads or os.cpu_count() or 1)
        else:
            mapper.SetUseJittering(False)
        return mapper

    def load(self, values: Single) -> None:
        """Another frame; the mapper takes it up when it draws."""
        turned = np.ascontiguousarray(
            values[
                tuple(slice(None, None, -1 if part < 0 else 1) for part in self.grid.spacing[::-1])
            ]
        )
        scalars = self.vtk.numpy_to_vtk(turned.ravel(), deep=1)
        self.image.GetPointData().SetScalars(scalars)
        self.image.Modified()

    def shade(self, lighting: Lighting | None) -> None:
        """Light from the camera, or none."""
        self.property.SetShade(lighting is not None)
        if lighting is not None:
            self.property.SetAmbient(lighting.ambient)
            self.property.SetDiffuse(lighting.diffuse)
            self.property.SetSpecular(lighting.specular)
            self.property.SetSpecularPower(lighting.specular_power)

    def look(self, rays: Rays) -> None:
        """Take the camera of rays."""
        spacing = rays.grid.spacing
        eye = rays.eye * spacing + rays.grid.origin
        forward, up = rays.forward * spacing, rays.up * spacing
        half = float(np.linalg.norm(up))
        distance = float(np.linalg.norm(rays.grid.corners.mean(axis=1) - eye))
        camera = self.renderer.GetActiveCamera()
        camera.SetPosition(*eye)
        camera.SetFocalPoint(*(eye + forward * distance))
        camera.SetViewUp(*(up / half))
        camera.SetParallelProjection(rays.parallel)
        if rays.parallel:
            camera.SetParallelScale(half)
        else:
            camera.SetViewAngle(2 * float(np.degrees(np.arctan(half))))
        self.renderer.ResetCameraClippingRange()

    def draw(self) -> Drawn:
        """Render once."""
        self.window.Modified()
        begun = time.perf_counter()
        self.window.Render()
        seconds = time.perf_counter() - begun
        width, height = self.window.GetSize()
        data = self.vtk.vtkUnsignedCharArray()
        self.window.GetPixelData(0, 0, width - 1, height - 1, 0, data, 0)
        pixels = self.vtk.vtk_to_numpy(data).reshape(height, width, 3)[::-1]
        return Drawn(pixels=np.ascontiguousarray(pixels), seconds=seconds)

    @property
    def version(self) -> str:
        """Versions of VTK and of the OpenGL that it uses."""
        lines = str(self.window.ReportCapabilities()).splitlines()
        graphics = next(
            (
                line.partition(":")[2].strip()
                for line in lines
                if line.startswith("OpenGL renderer string")
            ),
            "no OpenGL",
        )
        return f"VTK {self.vtk.vtkVersion.GetVTKVersion()}, {graphics}"

    def _give(self, table: Table, unit: float) -> None:
        """The transfer function as VTK has them: colours, and opacities after the unit distance."""
        values = np.linspace(table.low, table.high, POINTS)
        entries = np.linspace(table.low, table.high, len(table.extinctions))
        opacities = -np.expm1(-np.interp(values, entries, table.extinctions) * unit)
        shades = np.stack(
            [np.interp(values, entries, channel) for channel in table.colours.T], axis=-1
        )
        colour, opacity = self.vtk.vtkColorTransferFunction(), self.vtk.vtkPiecewiseFunction()
        for value, shade, share in zip(values, shades, opacities, strict=True):
            colour.AddRGBPoint(float(value), *(float(channel) for channel in shade))
            opacity.AddPoint(float(value), float(share))
        self.property.SetColor(colour)
        self.property.SetScalarOpacity(opacity)

    def close(self) -> None:
        """Release the window."""
        self.window.Finalize()


DARK = 1e-5
"""Share of the light at which a ray ends."""


def vtk_picture(values: Single, task: Task) -> Single:
    """Draw a task without surfaces over a whole frame (z, y, x) of finite values; picture (H, W,
    4).

    A lit task is lit from the camera.
    """
    assert task.table is not None
    rays = task.rays
    origin, along = (
        np.array(np.broadcast_to(part.reshape(-1, 3), (rays.size[0] * rays.size[1], 3)))
        for part in rays.pixels()
    )
    along = along / np.linalg.norm(along * rays.grid.spacing, axis=1, keepdims=True)
    bounds = rays.grid.bounds
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (bounds[None] - origin[..., None]) / along[..., None]
    enter = np.maximum(np.nanmax(ends.min(axis=-1), axis=1), 0.0)
    leave = np.nanmin(ends.max(axis=-1), axis=1)
    colour, clear = np.zeros((len(along), 3)), np.ones(len(along))
    entries = np.linspace(task.table.low, task.table.high, len(task.table.extinctions))
    number = 0
    while True:
        alive = np.flatnonzero((enter + number * task.step < leave) & (clear > DARK))
        if not alive.size:
            break
        places = origin[alive] + (enter[alive] + (number + 1) * task.step)[:, None] * along[alive]
        places = np.clip(places, bounds[:, 0], bounds[:, 1])
        found = _trilinear(values, places)
        shade = np.stack(
            [np.interp(found, entries, channel) for channel in task.table.colours.T], axis=-1
        )
        length = np.minimum(task.step, leave[alive] - enter[alive] - number * task.step)
        opacity = -np.expm1(-np.interp(found, entries, task.table.extinctions) * length)
        if task.shaded and task.lighting is not None:
            shade = _lit(
                shade,
                _central(values, places) / rays.grid.spacing,
                along[alive] * rays.grid.spacing,
                task.lighting,
            )
        colour[alive] += (clear[alive] * opacity)[:, None] * shade
        clear[alive] *= 1 - opacity
        number += 1
    rgba = np.concatenate([colour, 1 - clear[:, None]], axis=1)
    return rgba.reshape(rays.size[1], rays.size[0], 4).astype(np.float32)


def _trilinear(values: Single, places: Double) -> Double:
    """Values at places (n, 3), x, y, z in vertices, clamped to the frame."""
    last = np.array(values.shape[::-1]) - 1
    at = np.clip(places, 0, last)
    low = np.minimum(at.astype(np.int64), np.maximum(last - 1, 0))
    share, high = at - low, np.minimum(low + 1, last)
    total = np.zeros(len(places))
    for corner in np.ndindex(2, 2, 2):
        index = np.where(corner, high, low)
        weight = np.prod(np.where(corner, share, 1 - share), axis=1)
        total += weight * values[index[:, 2], index[:, 1], index[:, 0]]
    return total


def _central(values: Single, places: Double) -> Double:
    """Differences (n, 3) over the vertex before and the vertex behind, per vertex."""
    return np.stack(
        [
            (_trilinear(values, places + one) - _trilinear(values, places - one)) / 2
            for one in np.eye(3)
        ],
        axis=-1,
    )


def _lit(shade: Double, gradient: Double, along: Double, lighting: Lighting) -> Double:
    """Phong's model with the light at the eye.

    The mirrored ray and the way back to the eye enclose twice the angle to the normal.
    """
    length = np.linalg.norm(gradient, axis=1)
    known = length > 0
    cosine = np.where(
        known, np.abs(np.sum(gradient * along, axis=1)) / np.where(known, length, 1.0), 0.0
    )
    mirrored = (
        np.where(known, np.maximum(2 * cosine * cosine - 1, 0.0), 0.0) ** lighting.specular_power
    )
    lit = (
        shade * (lighting.ambient + lighting.diffuse * cosine)[:, None]
        + (lighting.specular * mirrored)[:, None]
    )
    return np.minimum(lit, 1.0)


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
                peer.look(plans[0].task.rays)
                peer.draw()
                window.draw()
                march(frame, plans[0].task, bricks=bricks)
                self.renderer.render(plan=plans[0])
                ours, whole, theirs, nothing, psnrs, ssims = [], [], [], [], [], []
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
                    psnrs.append(picture_psnr(pixels, drawn.pixels, 255.0))
                    ssims.append(picture_ssim(pixels, drawn.pixels))
                    samples = max(samples, int(marched.counters["samples"]))
            results.append(
                Against(
                    scene=name,
                    shaded=shaded,
                    size=side,
                    ours_ms=1e3 * median(ours),
                    whole_ms=1e3 * median(whole),
                    vtk_ms=1e3 * max(median(theirs) - median(nothing), 0.0),
                    window_ms=1e3 * median(nothing),
                    psnr=median_psnr(psnrs),
                    ssim=median(ssims),
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
                plan, theirs = self._fine(scene, FINE)
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

    def _fine(self, scene: Scene, step: float) -> tuple[Plan, Pixels]:
        """Plan of a scene with rays of fine steps that do not end early; VTK's picture of it."""
        plan = self.renderer.plan(
            replace(scene, march=replace(scene.march, step=step, threshold=0.0))
        )
        with self._peer(plan, "gpu") as peer:
            peer.look(plan.task.rays)
            peer.draw()  # the first picture is of a frame that is not all there yet
            return plan, peer.draw().pixels

    def _explained(self, name: str, shaded: bool) -> float | None:
        """PSNR of VTK's picture to a slow one with VTK's own samples, gradients and highlights."""
        plan, theirs = self._fine(self._scene(name, shaded, EXPLAINED_SIZE), EXPLAINED)
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
        peer = VtkPeer(
            self.values,
            plan.task,
            unit=plan.function.unit_distance,
            mapper=mapper,
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


def median_psnr(psnrs: Sequence[float | None]) -> float | None:
    """Median in dB of the pictures that differ; None where none does."""
    known = [psnr for psnr in psnrs if psnr is not None]
    return median(known) if known else None


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """Result of a call, and the seconds it took."""
    begun = time.perf_counter()
    result = run()
    return result, time.perf_counter() - begun
