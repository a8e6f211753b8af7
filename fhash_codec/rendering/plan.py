"""Plan of a picture: what a scene asks of a volume, decided and explained before any ray."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import MAX_LOD, Box
from fhash_codec.cuda.device import has_device
from fhash_codec.devices import check_cuda, choose_device, may_have_cuda
from fhash_codec.rendering.bricks import SIDE
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.colours import parse_colour
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.layout import Layout, lay_out, quantity_of
from fhash_codec.rendering.light import (
    coding_noise,
    grading_of,
    lamp_of,
    lighting_of,
    secondary_light,
    shading_of,
)
from fhash_codec.rendering.march_task import (
    MAX_VALUES,
    NUMPY,
    Arrays,
    Surface,
    Table,
    Task,
    Units,
    extinctions_in,
)
from fhash_codec.rendering.scenes import DEVICES, AmbientOcclusion, Effects, Scene, Shadows
from fhash_codec.rendering.tiled_frame import block_sizes
from fhash_codec.rendering.transfer_function import Histogram, TransferFunction, about
from fhash_codec.rendering.view import Body, pixel_vertices, region_in_view, region_of_body
from fhash_codec.volume import Volume, feature_names
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.support.threads import usable_threads
from fhash_formats.support.values import Double


def arrays_on(device: str) -> Arrays:
    """The arrays of a device.

    device: 'cpu' for numpy, 'cuda' for torch on CUDA, 'auto' for CUDA where there is one and else
    numpy. torch is imported only where the driver of CUDA and torch itself are installed.
    Raises InputError for another name, and for 'cuda' where there is none; MissingDependencyError
    for 'cuda' without torch.
    """
    if device not in DEVICES:
        raise InputError(f"device is '{device}'; allowed: {', '.join(DEVICES)}")
    if device == "cpu" or (device == "auto" and not may_have_cuda()):
        return NUMPY
    chosen = choose_device(device)
    if chosen.type == "cpu":
        return NUMPY
    from fhash_codec.rendering.torch_arrays import TorchArrays

    return TorchArrays(chosen)


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """Every decision that is made before the first ray; `planning.plan_picture` makes it.

    Attributes:
        scene: as given.
        layout: places of everything in the picture, and the part that shows the volume.
        task: what is marched, in that part. Its `light` is still missing: where `shadows` or
            `occlusion` ask for light, it is computed from the decoded frame.
        step: of the series; fractional between two steps.
        time: physical time.
        mode: 'cache', 'arm' or 'stream'.
        network: whether rays march through the published network.
        device: 'cpu' or 'cuda', which draws.
        why_device: reason for the device, for people.
        why_mode: reason why 'auto' took the mode, for people; empty where the scene names it.
        lod: level of detail, 0 for the finest.
        why_lod: reason for the level, for people.
        region: part of the domain (z, y, x) that is decoded.
        function: the transfer function.
        units: of the marched values.
        shadows: settings of the shadows, or None without shadows.
        occlusion: settings of the ambient occlusion, or None without it.
        lamp: unit vector (x, y, z) towards the light; None for the camera's light.
        reasons: (topic, what is done and why), for people.
    """

    scene: Scene
    layout: Layout
    task: Task
    step: float
    time: float
    mode: str
    network: bool
    device: str
    why_device: str
    why_mode: str
    lod: int
    why_lod: str
    region: Box
    function: TransferFunction
    units: Units
    shadows: Shadows | None
    occlusion: AmbientOcclusion | None
    lamp: npt.NDArray[np.float64] | None
    reasons: tuple[tuple[str, str], ...] = ()

    @property
    def streams(self) -> bool:
        """Whether samples are streamed, not marched in packets of rays."""
        return self.mode == "stream"

    @property
    def lights(self) -> bool:
        """Whether light is computed before the rays are marched."""
        return self.shadows is not None or self.occlusion is not None

    @property
    def decodes_all(self) -> bool:
        """Whether a frame of all that is in view is decoded before the rays are marched."""
        return self.lights or (not self.network and (self.mode == "cache" or self.streams))

    def to_dict(self) -> dict[str, str]:
        """JSON values: the reasons by topic."""
        return dict(self.reasons)


PROJECTIONS = {
    "maximum": "the largest along each ray",
    "minimum": "the smallest along each ray",
    "average": "the mean along each ray, where it meets values",
    "attenuated": "the largest along each ray, after what lies before it",
}
"""The values that rays show, by name of the projection."""
HOLDS = {
    "maximum": "can hold a larger value than was met",
    "minimum": "can hold a smaller value than was met",
    "average": "hold values",
    "attenuated": "hold values above the first colour's",
}
"""The bricks that a projection looks at."""


def reasons(plan: Plan, volume: Volume) -> list[tuple[str, str]]:
    """Explain a plan: (topic, what is done and why)."""
    task, scene = plan.task, plan.scene
    width, height = scene.size
    z, y, x = plan.region
    lines = [
        (
            "picture",
            f"{width} x {height}, {scene.camera.projection}, "
            f"{task.antialiasing**2} ray(s) for each pixel",
        ),
        ("proportions", _scale_text(plan)),
        ("time", _time_text(plan)),
        ("march", _mode_text(plan, volume)),
        ("device", f"{plan.device}: {plan.why_device}"),
        ("value", _value_text(plan)),
        ("gradient", _gradient_text(plan)),
        ("secondary rays", _secondary_text(plan)),
        ("level of detail", f"{plan.lod}: {plan.why_lod}"),
        (
            "region",
            f"z {z[0]}:{z[1]}, y {y[0]}:{y[1]}, x {x[0]}:{x[1]}{_region_text(plan, volume)}",
        ),
        ("bricks", _brick_text(plan)),
        ("rays end", _end_text(plan)),
        ("step", f"{task.step:.6g}, {scene.march.step:g} of the distance between vertices"),
    ]
    return lines + _extras(plan)


def _extras(plan: Plan) -> list[tuple[str, str]]:
    """The lines about buffers and about what is drawn around the volume, if there are any."""
    task, effects = plan.task, plan.scene.effects
    buffers = [name for name, on in (("depth", task.depth), ("normal", task.normal)) if on]
    around = [
        name
        for name in ("box", "axes", "colour_bar", "time_label", "legend")
        if getattr(effects, name)
    ]
    lines = []
    if task.body is not None:
        lines.append(("clip", _clip_text(plan)))
    if buffers:
        lines.append(("buffers", ", ".join(buffers)))
    if around:
        wide, tall = plan.layout.view[2:]
        lines.append(
            ("around", ", ".join(around) + f": drawn afterwards; the volume has {wide} x {tall}")
        )
    return lines


def _clip_text(plan: Plan) -> str:
    """The part of the volume that is left, in the coordinates of the series."""
    task, grid = plan.task, plan.task.rays.grid
    ends = (grid.origin[:, None] + task.bounds * grid.spacing[:, None]) / np.array(grid.scale)[
        :, None
    ]
    box = ", ".join(
        f"{name} {min(pair):g} to {max(pair):g}" for name, pair in zip("xyz", ends, strict=True)
    )
    planes = f", cut by {len(task.planes)} plane(s)" if len(task.planes) else ""
    return f"{box}{planes}: nothing outside is decoded or marched"


def _scale_text(plan: Plan) -> str:
    """Lengths of the axes, and how uneven and downward ones are drawn."""
    grid = plan.task.rays.grid
    factors = [abs(factor) for factor in grid.scale]
    if all(factor == 1 for factor in factors):
        text = "those of the coordinates"
    else:
        why = (
            "as the scene says"
            if plan.scene.scale is not None
            else "an axis in other units than the rest has its vertices as far apart"
        )
        stretched = ", ".join(f"{factor:.4g}" for factor in factors)
        text = f"x, y, z are stretched by {stretched}: {why}"
    places = (None, None, None) if grid.warp is None else grid.warp.places
    for axis, factor, uneven in zip("xyz", grid.scale, places, strict=True):
        if uneven is not None:
            text += f"; {axis} is uneven and resampled to {len(uneven)} even vertices"
        if factor < 0:
            text += f"; {axis} ascends downwards"
    return text


def _time_text(plan: Plan) -> str:
    between = "" if float(plan.step).is_integer() else ", between two: both are decoded"
    return f"step {plan.step:g}{between}"


def _mode_text(plan: Plan, volume: Volume) -> str:
    why = f", {plan.why_mode}" if plan.why_mode else ""
    if plan.mode == "cache":
        lattice = (
            "; linear between vertices, where the network (arm) has other values"
            if volume.profile == "paper"
            else ""
        )
        return f"cache: decode once, then march what was decoded{why}{lattice}"
    if not plan.network and not plan.streams:
        tiles = "all tiles, which light needs" if plan.lights else "a tile when a ray comes to it"
        return f"arm: decode {tiles}{why}"
    through = (
        "straight through the network, which has values of its own between vertices (cache is "
        "linear there)"
        if plan.network
        else "through a decoded frame"
    )
    budget = plan.scene.march.samples_per_pass
    if plan.mode == "stream":
        samples = "one sample of each ray in a pass"
    elif plan.device == "cuda":
        samples = "up to 16 samples of each ray, the more the fewer rays of a warp are left"
    elif not plan.streams:
        samples = "up to 16 samples of each ray at a time"
    else:
        samples = f"{'as many' if budget is None else f'{budget:,}'} samples in a pass"
        samples += " as rays" if budget is None else ""
    return f"{plan.mode}: {samples}, {through}{why}"


def _value_text(plan: Plan) -> str:
    task = plan.task
    if task.projection:
        return PROJECTIONS[task.projection]
    if task.table is None:
        return f"at each sample, for {len(task.surfaces)} surface(s) alone"
    low, high = plan.function.span
    surfaces = f", and {len(task.surfaces)} surface(s)" if task.surfaces else ""
    return f"at each sample; values from {low:.6g} to {high:.6g} can be seen{surfaces}"


def _gradient_text(plan: Plan) -> str:
    task = plan.task
    uses = [
        text
        for text, on in (
            ("where a sample has opacity, for shading", task.shaded),
            ("where a sample has opacity, for opacity by gradient", task.grading is not None),
            ("on surfaces, for shading", bool(task.surfaces)),
            ("where half of the light is left, for normals", task.normal),
        )
        if on
    ]
    if not uses and plan.scene.effects.shading is not None and task.rays.grid.flat:
        return "none: a plane is drawn in its colours, without light"
    return "; ".join(uses) if uses else "none: no effect asks for it"


def _secondary_text(plan: Plan) -> str:
    uses = []
    if plan.shadows is not None:
        uses.append(f"shadows on a grid of {plan.shadows.resolution:g} vertices")
    if plan.occlusion is not None:
        uses.append(f"ambient occlusion within {plan.occlusion.radius:g} vertices")
    return "; ".join(uses) if uses else "none: no effect asks for them"


def _region_text(plan: Plan, volume: Volume) -> str:
    if plan.task.body is not None:
        return " (what the clip leaves, in whole tiles)"
    if plan.lights:
        return " (all: light comes from everywhere)"
    is_domain = all(
        high - low == length
        for (low, high), length in zip(plan.region, volume.shape[1:], strict=True)
    )
    return " (all)" if is_domain else " (what is in the picture)"


def _brick_text(plan: Plan) -> str:
    task = plan.task
    if not task.skipping:
        return "all are marched: skipping is off"
    tests = [
        text
        for text, on in (
            ("hold visible values", task.table is not None),
            ("cross a surface", bool(task.surfaces)),
        )
        if on
    ]
    if task.projection:
        tests = [HOLDS[task.projection], *tests[1:]]
    few = (
        ""
        if task.projection in ("maximum", "minimum") or plan.mode != "cache"
        else "; all, where few could be passed over"
    )
    return f"only those that {' or '.join(tests)}{few}"


def _end_text(plan: Plan) -> str:
    threshold, projection = plan.task.threshold, plan.task.projection
    if projection == "attenuated":
        return "where no later value can be larger"
    if projection:
        return "behind the volume"
    if threshold > 0:
        return f"where less than {threshold:.3g} of the light is left"
    return "behind the volume"


LONG_RAY = 10**5
"""Samples of a ray above which a warning is given: a picture of usual size then takes minutes."""
MAX_RAY_SAMPLES = 10**8
"""Most samples of a ray: more would take days, and Ctrl-C cannot stop a ray being marched."""
VERTICES_A_SAMPLE = 4
"""Vertices of a frame for each sample that a picture may take, from which on the samples are taken
through the network.

A sample takes 0.4 to 0.6 times as long as a vertex is decoded; but a second picture of the same
step is faster from the kept frame.
"""
CUDA_START = 0.5
"""Seconds that a CUDA device takes to start, about: its context and kernels from the cache.

An estimate, until `make device` has measured the start without torch.
"""
SAMPLES = 4e7
"""Samples that a thread of a CPU marches in a second through decoded values, about."""
NETWORK_SAMPLES = 8e6
"""The same through a network."""
MAX_RAYS = 2**26
"""Most rays of a picture: more would not fit in the memory of most machines."""


def plan_picture(
    volume: Volume,
    scene: Scene,
    *,
    histogram: Callable[[], Histogram] | None = None,
    pictures: int = 1,
) -> Plan:
    """Plan the picture of a scene.

    Args:
        volume: an open container.
        scene: what to show; not an evolution.
        histogram: counts the values of the series; called only if the opacity depends on them.
        pictures: that will be drawn alike, about: the start of a device is for all of them.

    Raises InputError for what cannot be drawn, RegionError for a time outside the series.
    """
    _check(scene)
    step = _step_of(volume, scene)
    units = Units.of(volume)
    grid = Grid.of_volume(volume, scene.scale)
    function = _function(volume, scene, grid, histogram)
    _warn_of_unseen_surfaces(volume, scene)
    quantity = quantity_of(volume.name, volume.units)
    reach = (volume.value_range.low, volume.value_range.high)
    layout, rays = lay_out(scene, grid, volume.coords, function.colours, quantity, reach)
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
    margin = _margin(task, lod)
    # Light comes from all of the volume, whether it is in view or not.
    domain = region_of_body(volume, task.body, grid.warp, margin)
    lit = shadows is not None or occlusion is not None
    region = domain if lit else region_in_view(rays, volume, task.body, margin)
    ends = not lit and _ends_rays(task) and _many_blocks(volume, region, lod)
    device, why_device = _device(volume, scene, task, pictures)
    mode, why_mode = _mode(volume, scene, ends, device)
    network = volume.profile == "paper" and mode != "cache"
    if lit or not network:
        _check_frame(region, lod)
    plan = Plan(
        scene=scene,
        layout=layout,
        task=task,
        step=step,
        time=_time_of(volume, step),
        mode=mode,
        network=network,
        device=device,
        why_device=why_device,
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
    if scene.background != "transparent":
        parse_colour(scene.background)
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
    if histogram is None or (spec.range is not None and (spec.opacity != "auto" or spec.nothing)):
        return without
    (low, high), scale = value_range, volume.value_range.scale
    if not low < high:
        return without
    # Whether anything depends on a histogram is tried with a made-up one.
    edges = np.linspace(low * scale, high * scale, 97) / scale
    probe = function_of((edges, np.repeat(np.array([0, 1, 0], dtype=np.int64), 32)))
    if all(
        np.array_equal(one, other)
        for one, other in (
            (without.points, probe.points),
            (without.colours.positions, probe.colours.positions),
        )
    ):
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
                f"{volume.path}: the published network has no levels of detail; leave 'lod' out"
            )
        return lod, "as the scene says"
    if volume.profile != "compact":
        return 0, "the published network has but one"
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
    lamp: Double | None,
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
        first, last = (float(end) for end in function.colours.positions[[0, -1]])
        function = replace(function, span=(first, last) if first < last else about(first))
    low, high, colours, extinctions = function.table()
    ends = units.to([low, high])
    return Table(low=float(ends[0]), high=float(ends[1]), colours=colours, extinctions=extinctions)


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


def _longest_ray(task: Task) -> float:
    """Samples of a ray along the diagonal of the domain."""
    grid = task.rays.grid
    return float(np.linalg.norm(np.diff(grid.bounds, axis=1)[:, 0] * grid.spacing)) / task.step


def _check_ray_length(task: Task) -> None:
    """Warn of rays of more than LONG_RAY samples; raise InputError above MAX_RAY_SAMPLES."""
    samples = _longest_ray(task)
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


def _ends_rays(task: Task) -> bool:
    """Whether rays end early: at an opaque surface, or where most colours are opaque in a brick."""
    if task.projection:
        return False
    if any(surface.opacity >= 1 - task.threshold for surface in task.surfaces):
        return True
    if task.table is None:
        return False
    left = np.exp(-extinctions_in(task.table.extinctions, SIDE * task.rays.grid.vertex_spacing))
    return bool(np.median(left) <= task.threshold)


def _many_blocks(volume: Volume, region: Box, lod: int) -> bool:
    """Whether a frame has as many blocks as two along each axis: fewer are seldom left out."""
    sizes = block_sizes(volume, lod)
    return math.prod(-(-n // size) for n, size in zip(region.shape, sizes, strict=True)) >= 8


def _mode(volume: Volume, scene: Scene, ends: bool, device: str) -> tuple[str, str]:
    """The way to march, and why 'auto' took it.

    ends: whether rays end before they have seen most of a decoded frame. device: that draws.
    """
    march, network = scene.march, volume.profile == "paper"
    if march.mode != "auto":
        return march.mode, ""
    if network and device == "cuda":
        return "arm", "chosen for the GPU, which evaluates the network where the rays are"
    if _few_samples(volume, scene):
        return "arm", "chosen since so few samples cost less than decoding the frame"
    if ends and not network:
        return "arm", "chosen since rays end at what is opaque and need no tile behind it"
    fastest = "as is fastest" + ("" if device == "cuda" else " on a CPU")
    return "cache", fastest + ("" if network else " where rays need most tiles")


def _device(volume: Volume, scene: Scene, task: Task, pictures: int) -> tuple[str, str]:
    """The device that draws, and why; InputError for one that is not here."""
    asked = scene.march.device
    if asked not in DEVICES:
        raise InputError(f"device is '{asked}'; allowed: {', '.join(DEVICES)}")
    if asked == "cpu":
        return "cpu", "as the scene says"
    check_cuda(asked, torch=False)
    if asked == "cuda":
        return "cuda", "as the scene says"
    width, height = task.rays.size
    samples = width * height * task.antialiasing**2 * _longest_ray(task) / 2 * pictures
    rate = (NETWORK_SAMPLES if volume.profile == "paper" else SAMPLES) * usable_threads()
    seconds = samples / rate
    many = "" if pictures == 1 else f" for {pictures} pictures"
    cost = f"the CPU needs about {seconds:.2g} s{many}, and CUDA takes {CUDA_START:g} s to start"
    if seconds <= CUDA_START:
        return "cpu", cost
    # To ask the driver takes time, too, and keeps CUDA from processes that are forked later.
    return ("cuda", cost) if has_device() else ("cpu", "there is no CUDA device")


def arrays_of(scene: Scene) -> Arrays:
    """The arrays that samples are streamed in: on a GPU where that is named."""
    return arrays_on("cuda" if scene.march.device == "cuda" else "cpu")


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
