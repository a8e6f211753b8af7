"""Planning a picture: what a scene asks of a volume, decided before the first ray."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.feature_volume import feature_names
from fhash_codec.indexing import MAX_LOD
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.camera.clip import Body
from fhash_codec.rendering.camera.view import part_in_view, part_of_body, pixel_vertices
from fhash_codec.rendering.colour.colours import parse_colour
from fhash_codec.rendering.colour.opacity import Histogram, about
from fhash_codec.rendering.colour.transfer_function import TransferFunction
from fhash_codec.rendering.picture.explain import reasons
from fhash_codec.rendering.picture.layout import lay_out, quantity_of
from fhash_codec.rendering.picture.lighting import (
    coding_noise,
    lamp_of,
    lighting_of,
    secondary_light,
    shading_of,
)
from fhash_codec.rendering.picture.plan import Plan
from fhash_codec.rendering.scene.scene import (
    Effects,
    Scene,
)
from fhash_codec.rendering.task.arrays import NUMPY
from fhash_codec.rendering.task.devices import arrays_on
from fhash_codec.rendering.task.slopes import grading_of
from fhash_codec.rendering.task.task import MAX_VALUES, Surface, Table, Task
from fhash_codec.rendering.task.units import Units
from fhash_codec.volume import Volume
from fhash_formats.errors import FhashWarning, InputError

__all__ = ["parse_background", "plan_at", "plan_picture"]

Floats = npt.NDArray[np.float64]

LONG_RAY = 10**5
"""Samples of a ray above which a warning is given: a picture of usual size then takes minutes."""
MAX_RAY_SAMPLES = 10**8
"""Most samples of a ray: more would take days, and Ctrl-C cannot stop a ray being marched."""
VERTICES_A_SAMPLE = 64
"""Vertices that a CPU decodes in the time of a sample through the network, rounded up.

`bench render --part break-even` shows 43 where a first picture takes equally long either way. A
second picture of the same step is faster from the kept frame.
"""
MAX_RAYS = 2**26
"""Most rays of a picture: more would not fit in the memory of most machines."""


def plan_picture(
    volume: Volume, scene: Scene, *, histogram: Callable[[], Histogram] | None = None
) -> Plan:
    """Plan the picture of a scene.

    Args:
        volume: an open container.
        scene: what to show; not an evolution.
        histogram: counts the values of the series; called only if the opacity depends on them.

    Raises InputError for what cannot be drawn, RegionError for a time outside the series.
    """
    _check(scene)
    step = _step_of(volume, scene)
    units = Units.of(volume)
    grid = Grid.of(volume.coords, scene.scale)
    function = _function(volume, scene, grid, histogram)
    _warn_of_unseen_surfaces(volume, scene)
    layout, rays = lay_out(
        scene, grid, volume.coords, function.colours, quantity_of(volume.name, volume.units)
    )
    lod, why_lod = _level(volume, scene, rays)
    shadows, occlusion = secondary_light(scene, grid)
    lamp = lamp_of(rays, scene.effects.shading, shadows)
    error = coding_noise(volume) / 2 * units.factor
    noise = 2 * error * grid.vertex_spacing / grid.series_spacing
    task = _task(scene, rays, function, units, lamp, lod, noise)
    task = replace(
        task, error=error, grading=grading_of(scene.transfer_function, volume, units, grid)
    )
    _check_ray_length(task)
    mode, why_mode = _mode(volume, scene)
    margin = _margin(task, lod)
    # Light comes from all of the volume, whether it is in view or not.
    domain = part_of_body(volume, task.body, grid.warp, margin)
    lit = shadows is not None or occlusion is not None
    region = domain if lit else part_in_view(rays, volume, task.body, margin)
    if mode == "cache" or lit:
        _check_frame(region, lod)
    plan = Plan(
        scene=scene,
        layout=layout,
        task=task,
        step=step,
        time=_time_of(volume, step),
        mode=mode,
        why_mode=why_mode,
        lod=lod,
        why_lod=why_lod,
        region=region,
        function=function,
        units=units,
        shadows=shadows,
        occlusion=occlusion,
        lamp=lamp,
    )
    return replace(plan, reasons=tuple(reasons(plan, volume)))


def plan_at(plan: Plan, volume: Volume, scene: Scene) -> Plan:
    """Move a plan to the time of a scene that differs from the plan's scene only in its time."""
    step = _step_of(volume, scene)
    moved = replace(plan, scene=scene, step=step, time=_time_of(volume, step))
    return replace(moved, reasons=tuple(reasons(moved, volume)))


def parse_background(name: str) -> None:
    """Raise InputError for a background that is neither a colour nor 'transparent'."""
    if name != "transparent":
        parse_colour(name)


def _check(scene: Scene) -> None:
    """Raise InputError for a scene that asks for too much, for nothing or for a contradiction."""
    effects, nothing = scene.effects, scene.transfer_function.nothing
    width, height = scene.size
    if width * height * effects.antialiasing**2 > MAX_RAYS:
        raise InputError(
            f"size {width} x {height} with {effects.antialiasing**2} rays for each pixel are more "
            f"than {MAX_RAYS:,} rays; take a smaller picture"
        )
    if scene.evolution is not None:
        raise InputError(
            "the scene is an evolution, of several pictures; leave 'evolution' out for one of them"
        )
    parse_background(scene.background)
    if nothing and not effects.isosurfaces:
        raise InputError(
            "the scene shows nothing: 'nothing' leaves the volume out and there is no isosurface"
        )
    if len(effects.projections) > 1:
        raise InputError(
            f"a picture shows one value along each ray, and the scene names "
            f"{' and '.join(effects.projections)} intensity; leave one of them"
        )
    for projection in effects.projections:
        if nothing:
            raise InputError(
                f"{projection}_intensity shows the volume, which 'nothing' leaves out; "
                "take one of them"
            )
        if scene.transfer_function.gradient_opacity:
            raise InputError(
                f"{projection}_intensity has no opacity that 'gradient_opacity' could change; "
                "take one of them"
            )


def _step_of(volume: Volume, scene: Scene) -> float:
    """The step of a scene, fractional between two; InputError or RegionError outside the series."""
    if scene.time is not None:
        return volume.step_of_time(scene.time)
    step = 0.0 if scene.step is None else scene.step
    last = volume.shape[0] - 1
    if not 0 <= step <= last:
        raise InputError(f"step {step:g} is outside the series, which has steps 0 to {last}")
    return step


def _time_of(volume: Volume, step: float) -> float:
    """The physical time of a step, linear between two steps."""
    times = volume.coords["t"].values
    return float(np.interp(step, np.arange(len(times)), times))


def _function(
    volume: Volume, scene: Scene, grid: Grid, histogram: Callable[[], Histogram] | None
) -> TransferFunction:
    """The transfer function of a scene; the series is counted only if the function needs it."""
    spec = scene.transfer_function
    features = tuple(feature_names(volume))
    value_range = (volume.value_range.low, volume.value_range.high)

    def function_of(counted: Histogram | None) -> TransferFunction:
        """The function with a histogram, or without one."""
        return TransferFunction.of(
            spec,
            value_range=value_range,
            spacing=grid.series_spacing,
            features=features,
            histogram=counted,
            thinnest=grid.thinnest,
        )

    without = function_of(None)
    if histogram is None or spec.opacity != "auto" or spec.nothing:
        return without
    (low, high), scale = value_range, volume.value_range.scale
    if not low < high:
        return without
    # Whether the opacity depends on a histogram at all is tried with a made-up one of one bin.
    edges = np.linspace(low * scale, high * scale, 9) / scale
    probe = function_of((edges, np.array([0, 0, 0, 0, 1, 0, 0, 0], dtype=np.int64)))
    if np.array_equal(without.points, probe.points):
        return without
    return function_of(histogram())


def _level(volume: Volume, scene: Scene, rays: Rays) -> tuple[int, str]:
    """The level of detail, and why it is that one."""
    lod = scene.march.lod
    if lod is not None:
        if lod > 0:
            volume.lod_vertices(lod)  # raises for a level that the volume does not have
        if lod > 0 and volume.profile != "compact":
            raise InputError(
                f"{volume.path}: a file of the profile {volume.profile} has no levels of detail; "
                "leave 'lod' out"
            )
        return lod, "as the scene says"
    if volume.profile != "compact":
        return 0, f"files of the profile {volume.profile} have but one"
    across = pixel_vertices(rays)
    by_pixel = math.floor(math.log2(across)) if across >= 2 else 0
    by_box = min(
        (int(high - low - 1).bit_length() - 1 for low, high in volume.box if high - low > 1),
        default=0,
    )
    return (
        max(0, min(by_pixel, by_box, MAX_LOD)),
        f"the nearest pixel is {across:.3g} vertices wide",
    )


def _task(
    scene: Scene,
    rays: Rays,
    function: TransferFunction,
    units: Units,
    lamp: Floats | None,
    lod: int,
    noise: float,
) -> Task:
    """The task of a marcher, without the light that is computed from a frame."""
    effects, march = scene.effects, scene.march
    projection = next(iter(effects.projections), "")
    attenuated = effects.attenuated_maximum_intensity
    table = None if scene.transfer_function.nothing else _table(function, units, bool(projection))
    shading = shading_of(effects)
    return Task(
        rays=rays,
        step=march.step * (1 << lod) * rays.grid.vertex_spacing,
        threshold=march.threshold,
        table=table,
        lighting=None if shading is None else lighting_of(shading, lamp),
        # The gradients of a plane lie in it: no light that falls on it would be scattered back.
        shaded=effects.shading is not None
        and table is not None
        and not projection
        and not rays.grid.flat,
        surfaces=_surfaces(effects, function, units),
        projection=projection,
        attenuation=0.0
        if attenuated is None
        else attenuated.attenuation / rays.grid.vertex_spacing,
        body=None if effects.clip is None else Body.of(effects.clip, rays.grid),
        depth="depth" in effects.buffers,
        normal="normal" in effects.buffers,
        antialiasing=effects.antialiasing,
        jitter=effects.jitter,
        skipping=march.skipping,
        noise=noise,
    )


def _table(function: TransferFunction, units: Units, whole: bool) -> Table:
    """The table of a transfer function in marched units.

    whole: whether it covers all colours, not only those of values that have an opacity.
    """
    if whole:
        ends = function.colours.positions[[0, -1]]
        function = replace(function, span=_about((float(ends[0]), float(ends[1]))))
    low, high, colours, extinctions = function.table()
    ends = units.to([low, high])
    return Table(low=float(ends[0]), high=float(ends[1]), colours=colours, extinctions=extinctions)


def _about(ends: tuple[float, float]) -> tuple[float, float]:
    """A range of values, widened where its ends are the same."""
    return ends if ends[0] < ends[1] else about(ends[0])


def _margin(task: Task, lod: int) -> int:
    """Vertices around a clipped part that samples in it need besides those of its cells.

    Vertices of a level of detail lie so far apart, and central differences reach one further.
    """
    central = task.lighting is not None and task.lighting.central
    return (1 << lod) - 1 + (1 << lod) * central


def _surfaces(effects: Effects, function: TransferFunction, units: Units) -> tuple[Surface, ...]:
    """The visible isosurfaces in marched units; without a colour they take the value's."""
    return tuple(
        Surface(
            value=float(units.to(surface.value)),
            colour=np.array(
                parse_colour(surface.colour)
                if surface.colour is not None
                else function.colour(surface.value)
            ),
            opacity=surface.opacity,
        )
        for surface in effects.isosurfaces
        if surface.opacity > 0
    )


def _check_ray_length(task: Task) -> None:
    """Warn of rays of more than LONG_RAY samples; raise InputError above MAX_RAY_SAMPLES."""
    grid = task.rays.grid
    diagonal = float(np.linalg.norm(np.diff(grid.bounds, axis=1)[:, 0] * grid.spacing))
    samples = diagonal / task.step
    if not samples > LONG_RAY:
        return
    line = (
        f"a ray takes up to {samples:.3g} samples, since the axes are of very different lengths or "
        "the step is short; stretch the axes with 'scale', or take a longer 'step'"
    )
    if samples > MAX_RAY_SAMPLES:
        raise InputError(f"{line}; at most {MAX_RAY_SAMPLES:.0e} are taken")
    warnings.warn(line, FhashWarning, stacklevel=3)


def _check_frame(region: Box, lod: int) -> None:
    """Raise InputError for a frame of more vertices than a marcher takes."""
    vertices = math.prod(-(-(stop - first) // (1 << lod)) for first, stop in region)
    if vertices > MAX_VALUES:
        raise InputError(
            f"a frame of {vertices:,} vertices is too large to march; allowed: {MAX_VALUES:,}; "
            "choose a coarser level of detail by 'lod', or clip the volume"
        )


def _warn_of_unseen_surfaces(volume: Volume, scene: Scene) -> None:
    """Warn of isosurfaces whose values the series does not reach: nothing is drawn of them."""
    low, high = volume.value_range.low, volume.value_range.high
    beyond = [s.value for s in scene.effects.isosurfaces if not low <= s.value <= high]
    if beyond:
        units = f" {volume.units}" if volume.units else ""
        warnings.warn(
            f"nothing is drawn of isosurface {', '.join(f'{value:.6g}' for value in beyond)}: "
            f"{volume.name} reaches from {low:.6g} to {high:.6g}{units}",
            FhashWarning,
            stacklevel=3,
        )


def _mode(volume: Volume, scene: Scene) -> tuple[str, str]:
    """The way to march, and why 'auto' took it; InputError for one that cannot be had."""
    march = scene.march
    if volume.profile != "paper":
        if march.mode in ("arm", "stream") or march.device == "cuda":
            what = "device 'cuda'" if march.device == "cuda" else f"march '{march.mode}'"
            raise InputError(
                f"{what} is for a network, and {volume.path}, of the profile {volume.profile}, has "
                "none: its decoded frames are marched on the CPU; leave it out"
            )
        return "cache", "" if march.mode == "cache" else "since the file has no network"
    if march.mode == "auto":
        if march.device == "cuda" or (
            march.device == "auto" and arrays_on(march.device) is not NUMPY
        ):
            return "arm", "chosen for the GPU"
        if _few_samples(volume, scene):
            return "arm", "chosen since so few samples cost less than decoding the frame"
        return "cache", "as is fastest on a CPU"
    if march.mode == "cache" and march.device == "cuda":
        raise InputError(
            "march 'cache' computes on the CPU; take 'arm' or 'stream' for device 'cuda'"
        )
    return march.mode, ""


def _few_samples(volume: Volume, scene: Scene) -> bool:
    """Whether all samples that a picture may take cost less through the network than its frame.

    `fhash bench render --part break-even` measures it. Light needs the frame in any case.
    """
    effects, header = scene.effects, volume.container.header
    if volume.profile != "paper" or effects.shadows or effects.ambient_occlusion:
        return False
    rays = scene.size[0] * scene.size[1] * effects.antialiasing**2
    longest = float(np.linalg.norm(volume.box.shape)) / scene.march.step
    frame = header["coreset_fraction"] * float(np.prod(volume.shape[1:]))
    return bool(rays * longest * VERTICES_A_SAMPLE <= frame)
