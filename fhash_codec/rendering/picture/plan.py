"""The plan of a picture: what a scene asks of a volume, as one task for any way to march, and why it is that and no more."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.camera.view import part_in_view, pixel_vertices
from fhash_codec.rendering.colour.colours import parse_colour
from fhash_codec.rendering.colour.opacity import Histogram
from fhash_codec.rendering.colour.transfer_function import TransferFunction
from fhash_codec.rendering.picture.explain import reasons
from fhash_codec.rendering.scene.scene import AmbientOcclusion, Scene, Shading, Shadows
from fhash_codec.rendering.task.task import Lighting, Surface, Table, Task
from fhash_codec.rendering.task.units import Units
from fhash_codec.volume import MAX_LOD, Volume
from fhash_formats.errors import FhashWarning, InputError

__all__ = ["Plan"]

Floats = npt.NDArray[np.float64]

LONG_RAY = 10**5
"""Samples: more take minutes for a picture of usual size."""
LONGEST_RAY = 10**8
"""Samples: more would take days, and no Ctrl-C would end one that is marched."""
MAX_RAYS = 2**26
"""Rays of a picture: more would not fit in the memory of most machines."""
SHOULDER = (-0.7, 1.0, 1.0)
"""To the right, upwards and towards the camera: where the light of shadows comes from unless the scene says."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """All that is decided before the first ray.

    Attributes:
        scene: as given. task: what is marched; its `light` is computed from the frame, where `shadows` or `occlusion` ask for it.
        step: of the series, fractional between two. time: physical. mode: cache, arm or stream. lod: level of detail, `why_lod` for
            people.
        region: part of the domain (z, y, x) that is decoded. function: the transfer function. units: of the marched values.
        shadows, occlusion: settings of light that is computed beforehand, or None. lamp: unit vector (x, y, z) of the shadows.
        reasons: (topic, what is done and why), for people.
    """

    scene: Scene
    task: Task
    step: float
    time: float
    mode: str
    lod: int
    why_lod: str
    region: Box
    function: TransferFunction
    units: Units
    shadows: Shadows | None
    occlusion: AmbientOcclusion | None
    lamp: Floats | None
    reasons: tuple[tuple[str, str], ...]

    @classmethod
    def of(
        cls,
        volume: Volume,
        scene: Scene,
        *,
        grid: Grid | None = None,
        histogram: Callable[[], Histogram] | None = None,
    ) -> Plan:
        """The plan of a scene; `histogram` is called where the opacity depends on how frequent values are.

        Raises InputError for what cannot be drawn, RegionError for a step or time outside the series.
        """
        effects, spec, march = scene.effects, scene.transfer_function, scene.march
        width, height = scene.size
        if width * height * effects.antialiasing**2 > MAX_RAYS:
            raise InputError(
                f"size {width} x {height} with {effects.antialiasing**2} rays for each pixel are more than {MAX_RAYS:,} rays; "
                "take a smaller picture"
            )
        if scene.evolution is not None:
            raise InputError(
                "the scene is an evolution, of several pictures; leave 'evolution' out for one of them"
            )
        parse_background(scene.background)
        if spec.nothing and not effects.isosurfaces:
            raise InputError(
                "the scene shows nothing: 'nothing' leaves the volume out and there is no isosurface"
            )
        if effects.maximum_intensity and spec.nothing:
            raise InputError(
                "maximum_intensity shows the volume, which 'nothing' leaves out; take one of them"
            )
        step = _step_of(volume, scene)
        grid = grid or Grid.of(volume.coords, scene.scale)
        rays = Rays.of(scene.camera, grid, scene.size)
        function = _function(volume, scene, grid, histogram)
        lod, why_lod = _level(volume, scene, rays)
        stride = 1 << lod
        lit = effects.shading or (Shading() if effects.isosurfaces else None)
        shadows = effects.shadows if effects.shadows and effects.shadows.strength > 0 else None
        occlusion = (
            effects.ambient_occlusion
            if effects.ambient_occlusion and effects.ambient_occlusion.strength > 0
            else None
        )
        if effects.maximum_intensity or spec.nothing:
            # Only the volume takes light away, and only from what is drawn of it or in it.
            shadows = occlusion = None
        if effects.maximum_intensity:
            lit = lit if effects.isosurfaces else None
        lamp = _lamp(rays, effects.shading, shadows)
        units = Units.of(volume)
        table = None if spec.nothing else _table(function, units)
        task = Task(
            rays=rays,
            step=march.step * stride * grid.vertex_spacing,
            threshold=march.threshold,
            table=table,
            lighting=None if lit is None else _lighting(lit, lamp),
            shaded=effects.shading is not None
            and table is not None
            and not effects.maximum_intensity,
            surfaces=tuple(
                Surface(
                    value=float(units.to(each.value)),
                    colour=np.array(
                        parse_colour(each.colour)
                        if each.colour is not None
                        else function.colour(each.value)
                    ),
                    opacity=each.opacity,
                )
                for each in effects.isosurfaces
                if each.opacity > 0
            ),
            maximum=effects.maximum_intensity,
            depth="depth" in effects.buffers,
            normal="normal" in effects.buffers,
            antialiasing=effects.antialiasing,
            jitter=effects.jitter,
            skipping=march.skipping,
        )
        longest = (
            float(np.linalg.norm(np.diff(grid.bounds, axis=1)[:, 0] * grid.spacing)) / task.step
        )
        if longest > LONG_RAY:
            line = (
                f"a ray takes up to {longest:.3g} samples, since the axes are of very different lengths or the step is short; "
                "stretch the axes with 'scale', or take a longer 'step'"
            )
            if longest > LONGEST_RAY:
                raise InputError(f"{line}; at most {LONGEST_RAY:.0e} are taken")
            warnings.warn(line, FhashWarning, stacklevel=2)
        mode = march.mode
        if mode == "auto":
            mode = "arm" if march.device == "cuda" else "cache"
        if mode == "cache" and march.device == "cuda":
            raise InputError(
                "march 'cache' computes on the CPU; take 'arm' or 'stream' for device 'cuda'"
            )
        # Light comes from all of the volume, seen or not.
        everything = Box.of_shape(volume.shape[1:])
        region = part_in_view(rays, volume) if shadows is None and occlusion is None else everything
        plan = cls(
            scene=scene,
            task=task,
            step=step,
            time=_time_of(volume, step),
            mode=mode,
            lod=lod,
            why_lod=why_lod,
            region=region,
            function=function,
            units=units,
            shadows=shadows,
            occlusion=occlusion,
            lamp=lamp,
            reasons=(),
        )
        return replace(plan, reasons=tuple(reasons(plan, volume)))

    def at(self, volume: Volume, scene: Scene) -> Plan:
        """The plan of a scene that differs in nothing but its time."""
        step = _step_of(volume, scene)
        plan = replace(self, scene=scene, step=step, time=_time_of(volume, step))
        return replace(plan, reasons=tuple(reasons(plan, volume)))

    @property
    def lights(self) -> bool:
        """Whether light is computed before the rays."""
        return self.shadows is not None or self.occlusion is not None

    def to_dict(self) -> dict[str, str]:
        """JSON values: topics and what is done about them."""
        return dict(self.reasons)


def parse_background(name: str) -> None:
    """Raises InputError for a background that is neither a colour nor 'transparent'."""
    if name != "transparent":
        parse_colour(name)


def _step_of(volume: Volume, scene: Scene) -> float:
    if scene.time is not None:
        return volume.step_of_time(scene.time)
    step = 0.0 if scene.step is None else scene.step
    last = volume.shape[0] - 1
    if not 0 <= step <= last:
        raise InputError(f"step {step:g} is outside the series, which has steps 0 to {last}")
    return step


def _time_of(volume: Volume, step: float) -> float:
    times = volume.coords["t"].values
    return float(np.interp(step, np.arange(len(times)), times))


def _function(
    volume: Volume, scene: Scene, grid: Grid, histogram: Callable[[], Histogram] | None
) -> TransferFunction:
    features = tuple(str(text) for text in volume.container.header.get("features", ()))
    value_range = (volume.value_range.low, volume.value_range.high)

    def made(found: Histogram | None) -> TransferFunction:
        return TransferFunction.of(
            scene.transfer_function,
            value_range=value_range,
            spacing=grid.vertex_spacing,
            features=features,
            histogram=found,
        )

    found = made(None)
    if (
        histogram is None
        or scene.transfer_function.opacity != "auto"
        or scene.transfer_function.nothing
    ):
        return found
    # What a histogram of one value would change tells whether the opacity depends on one at all.
    (low, high), scale = value_range, volume.value_range.scale
    edges = np.linspace(low * scale, high * scale, 9) / scale
    probe = (
        made((edges, np.array([0, 0, 0, 0, 1, 0, 0, 0], dtype=np.int64))) if low < high else found
    )
    return found if np.array_equal(found.points, probe.points) else made(histogram())


def _table(function: TransferFunction, units: Units) -> Table:
    low, high, colours, extinctions = function.table()
    ends = units.to([low, high])
    return Table(low=float(ends[0]), high=float(ends[1]), colours=colours, extinctions=extinctions)


def _level(volume: Volume, scene: Scene, rays: Rays) -> tuple[int, str]:
    """The level of detail and why it is that."""
    if scene.march.lod is not None:
        if scene.march.lod > 0:
            volume.lod_vertices(scene.march.lod)
        if scene.march.lod > 0 and volume.profile != "compact":
            raise InputError(
                f"{volume.path}: a file of the profile {volume.profile} has no levels of detail; leave 'lod' out"
            )
        return scene.march.lod, "as the scene says"
    if volume.profile != "compact":
        return 0, f"files of the profile {volume.profile} have but one"
    across = pixel_vertices(rays)
    most = min(
        ((size - 1).bit_length() - 1 for size in volume.box.shape if size > 1),
        default=0,
    )
    lod = max(0, min(math.floor(math.log2(across)) if across >= 2 else 0, most, MAX_LOD))
    return lod, f"the nearest pixel is {across:.3g} vertices wide"


def _lamp(rays: Rays, shading: Shading | None, shadows: Shadows | None) -> Floats | None:
    """Where the light comes from, unit vector (x, y, z) of the coordinates; None for the camera's, which casts no shadow that it sees."""
    chosen = shading.light if shading is not None and shading.light is not None else None
    if shadows is not None and shadows.light is not None:
        if chosen is not None and chosen != shadows.light:
            raise InputError(
                "shading and shadows name different lights; there is one lamp: leave 'light' out of one of them"
            )
        chosen = shadows.light
    if chosen is not None:
        direction = np.array(chosen)
        largest = float(np.abs(direction).max())
        if not largest > 0:
            raise InputError("light has no length; give a direction such as 1, 1, 2")
        direction = (
            direction / largest
        )  # first, since the squares of the largest numbers go beyond float64
        return np.asarray(direction / np.linalg.norm(direction), dtype=np.float64)
    if shadows is None:
        return None
    spacing = rays.grid.spacing
    right, up, away = (
        part / np.linalg.norm(part)
        for part in (rays.right * spacing, rays.up * spacing, -rays.forward * spacing)
    )
    lamp = SHOULDER[0] * right + SHOULDER[1] * up + SHOULDER[2] * away
    return np.asarray(lamp / np.linalg.norm(lamp), dtype=np.float64)


def _lighting(shading: Shading, lamp: Floats | None) -> Lighting:
    return Lighting(
        ambient=shading.ambient,
        diffuse=shading.diffuse,
        specular=shading.specular,
        specular_power=shading.specular_power,
        lamp=lamp,
        central=shading.gradient == "central",
    )
