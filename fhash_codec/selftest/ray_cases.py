"""Cases of rays, their checks, and pictures in float64, ray by ray."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Task, warped
from fhash_codec.rendering.plan import Plan, plan_picture
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import Scene
from fhash_codec.rendering.tiled_frame import decoded_frame
from fhash_codec.selftest.case import Case, Check, Finding, Run
from fhash_codec.selftest.field_cases import Settings, Shape, series, single, waves
from fhash_formats.series import ArraySeries
from fhash_formats.support.values import Double

SNAP = 1e-9
"""Distance from a vertex, in vertex spacings, below which a coordinate is that of the vertex."""
HALVINGS = 60
"""Bisections of the search for the position of a surface."""


def reference_picture(frame: Frame, task: Task) -> Double:
    """The picture (H, W, 4) of an unshaded volume and surfaces of one colour each, with
    premultiplied opacity.

    Rays do not end at a threshold of opacity.
    """
    width, height = task.rays.size
    eyes, directions = task.rays.pixels()
    picture = np.zeros((height, width, 4))
    for pixel in np.ndindex(height, width):
        picture[pixel] = _ray(frame, task, eyes[pixel], directions[pixel])
    return picture


def _ray(frame: Frame, task: Task, eye: Double, direction: Double) -> Double:
    grid = task.rays.grid
    direction = direction / np.linalg.norm(direction * grid.spacing)
    enter, leave = _within(eye, direction, grid.bounds)
    if not enter < leave:
        return np.zeros(4)
    steps = (leave - enter) / task.step
    count = int(np.ceil(steps))
    at = enter + (np.arange(count) + 0.5) * task.step
    lengths = np.full(count, task.step)
    lengths[-1] = (steps - (count - 1)) * task.step
    # Surfaces exist within the frame only, which may be smaller than the drawn box.
    counts = np.array(frame.values.shape[::-1])
    first = np.array(frame.first[::-1], dtype=np.float64)
    seen = np.where(
        (counts == 1)[:, None],
        grid.bounds,
        np.stack([first, first + (counts - 1) * frame.stride], axis=-1),
    )
    entered, left_at = _within(eye, direction, seen)

    def value(distances: npt.NDArray[np.floating[Any]]) -> Double:
        return _trilinear(
            frame,
            np.clip(eye + distances[:, None] * direction, grid.bounds[:, 0], grid.bounds[:, 1]),
        )

    colour, left = np.zeros(3), 1.0
    values = value(at)
    # A sample beyond the box is seen only where the ray leaves the box within the frame.
    reached = np.minimum(at, leave)
    values[(reached < entered - SNAP) | (reached > left_at + SNAP)] = np.nan
    ends = np.concatenate(
        [[entered], np.clip(at, entered, max(entered, left_at)), [max(entered, left_at)]]
    )
    crossings = [_crossings(value, ends, value(ends), surface.value) for surface in task.surfaces]
    for sample in range(count + 1):
        # The surfaces between the previous sample and this one, nearest first, then the sample.
        between = sorted(
            (places[sample], number)
            for number, places in enumerate(crossings)
            if np.isfinite(places[sample])
        )
        for _, number in between:
            surface = task.surfaces[number]
            colour, left = (
                colour + left * surface.opacity * surface.colour,
                left * (1 - surface.opacity),
            )
        if sample < count and task.table is not None and not np.isnan(values[sample]):
            table = task.table
            entry = np.clip((values[sample] - table.low) / (table.high - table.low), 0, 1) * (
                len(table.extinctions) - 1
            )
            numbers = np.arange(len(table.extinctions))
            opacity = -np.expm1(-np.interp(entry, numbers, table.extinctions) * lengths[sample])
            emitted = np.array(
                [np.interp(entry, numbers, table.colours[:, channel]) for channel in range(3)]
            )
            colour, left = colour + left * opacity * emitted, left * (1 - opacity)
    return np.array([*colour, 1 - left])


def _within(eye: Double, direction: Double, bounds: Double) -> tuple[float, float]:
    """The distances at which a ray enters a box (3, 2) in front of the eye and leaves it; both 0 if
    it misses the box."""
    enter, leave = 0.0, np.inf
    for axis, (low, high) in enumerate(bounds):
        if direction[axis] == 0:
            if not low <= eye[axis] <= high:
                return 0.0, 0.0
            continue
        one, two = sorted(
            ((low - eye[axis]) / direction[axis], (high - eye[axis]) / direction[axis])
        )
        enter, leave = max(enter, float(one)), min(leave, float(two))
    return (enter, leave) if enter < leave else (0.0, 0.0)


def _crossings(
    value: Callable[[Double], Double], ends: Double, values: Double, level: float
) -> Double:
    """The position of an isosurface in each interval of a ray, (n - 1,); infinite where there is
    none or values are missing.

    Args:
        value: returns the values at distances along the ray.
        ends: distances (n,) of the ends of the intervals.
        values: values (n,) at these ends.
        level: value of the isosurface.
    """
    places = np.full(len(ends) - 1, np.inf)
    below = values < level
    finite = ~np.isnan(values)
    for number in np.flatnonzero((below[1:] != below[:-1]) & finite[1:] & finite[:-1]):
        near, far = ends[number], ends[number + 1]
        for _ in range(HALVINGS):
            middle = (near + far) / 2
            if (value(np.array([middle]))[0] < level) == below[number]:
                near = middle
            else:
                far = middle
        if not np.isnan(value(np.array([near, far]))).any():
            places[number] = far
    return places


def _trilinear(frame: Frame, places: Double) -> Double:
    """Values (n,) at places (n, 3), which are x, y, z in vertices of the domain.

    A value is NaN outside the frame, and where a vertex with a weight above 0 is NaN.
    """
    counts = np.array(frame.values.shape[::-1])
    local = (places - np.array(frame.first[::-1])) / frame.stride
    # A place on a face of the frame counts as on it, whatever its rounding.
    local = np.where(np.abs(local - np.rint(local)) < SNAP, np.rint(local), local)
    outside = np.any(((local < 0) | (local > counts - 1)) & (counts > 1), axis=1)
    local = np.clip(local, 0, counts - 1.0)
    before = np.minimum(local.astype(np.int64), np.maximum(counts - 2, 0))
    share = local - before
    after = np.minimum(before + 1, counts - 1)
    xs, ys, zs = (np.stack([before[:, axis], after[:, axis]]) for axis in range(3))
    corners = frame.values[zs[:, None, None], ys[None, :, None], xs[None, None, :]].astype(
        np.float64
    )
    # One axis after the other as a + s (b - a), which is exact between two equal values.
    for axis in (2, 1, 0):
        corners = _between(corners[0], corners[1], share[:, axis])
    return np.where(outside, np.nan, corners)


def _between(one: Double, other: Double, share: Double) -> Double:
    """Linear interpolation from one value to another; a NaN with the weight 0 does not matter."""
    return np.where(share == 0, one, np.where(share == 1, other, one + share * (other - one)))


Picture = npt.NDArray[Any]

NEAR = 1e-3
"""Allowed difference of a colour channel from the float64 picture."""


def scene(**parts: Any) -> Scene:
    """A scene from its JSON values: 16 x 16 pixels, a transparent background, ambient light alone.

    Ambient light leaves the colours unchanged, and a threshold of 0 keeps rays from ending early.
    The decoded frame is marched, as in float64. A network, through which `auto` marches on a GPU,
    has values of its own between vertices.
    """
    march_ = {"mode": "cache", "threshold": 0.0, "lod": 0, **parts.pop("march", {})}
    effects = {
        "shading": {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0},
        **parts.pop("effects", {}),
    }
    return Scene.from_dict(
        {
            "size": [16, 16],
            "background": "transparent",
            **parts,
            "march": march_,
            "effects": effects,
        }
    )


def scenes(scenes_by_name: Mapping[str, Scene]) -> Check:
    """A check that draws each scene: finite, within 0..1, and as in float64."""

    def check(run: Run) -> Iterator[Finding]:
        renderer = Renderer(run.volume)
        for name, scene_ in scenes_by_name.items():
            picture = renderer.render(scene_).rgba
            bad = float(np.count_nonzero(~np.isfinite(picture)))
            yield Finding("finite pixels", bad, 0.0, "channels", name)
            beyond = max(-float(picture.min()), float(picture.max()) - 1.0, 0.0)
            yield Finding("pixels in 0..1", beyond, 1e-6, "of a channel", name)
            expected = _expected(run, renderer.plan(scene_))
            yield _off(picture, expected, name)
            if not name.startswith("nothing"):
                yield _not_empty(float(expected[..., 3].max()), name)

    return check


def closed_form(scenes_by_name: Mapping[str, Scene], value: float) -> Check:
    """A check for a series that is `value` everywhere: each ray has the opacity 1 - exp(-extinction
    * path), for steps of any length."""

    def check(run: Run) -> Iterator[Finding]:
        renderer = Renderer(run.volume)
        for name, scene_ in scenes_by_name.items():
            plan = renderer.plan(scene_)
            table, picture = plan.task.table, renderer.render(scene_).rgba
            assert table is not None
            extinction = np.interp(
                value, np.linspace(table.low, table.high, len(table.extinctions)), table.extinctions
            )
            path = _path(plan)
            exact = -np.expm1(-extinction * path)
            worst = float(np.abs(picture[..., 3] - exact).max())
            yield Finding("closed form", worst, NEAR, "of a channel", name)
            yield _not_empty(float(path.max()), name)

    return check


def blocks(run: Run) -> Iterator[Finding]:
    """The front part of a volume, drawn over its back part, gives the picture of the volume.

    Compositing is associative, so this holds wherever the volume is cut between two samples.
    """
    cut_scene = scene(camera={"view": "xy", "projection": "parallel"}, transfer_function=THIN_FOG)
    plan = plan_picture(run.volume, cut_scene)
    frame = decoded_frame(run.volume, plan.step, 0, _everything(run), plan.units)
    uncut = march(frame, plan.task).rgba
    for cut in range(1, frame.values.shape[0] - 1):
        # Seen from above, so the front has the larger z. Samples lie at quarters of a vertex
        # spacing, never on the layer that both parts share.
        front = march(Frame(values=frame.values[cut:], first=(cut, 0, 0)), plan.task).rgba
        back = march(Frame(values=frame.values[: cut + 1], first=(0, 0, 0)), plan.task).rgba
        worst = float(np.abs(front + (1 - front[..., 3:]) * back - uncut).max())
        yield Finding("blocks = whole", worst, 2e-6, "of a channel", f"cut at {cut}")
        yield _not_empty(float(min(front[..., 3].max(), back[..., 3].max())), f"cut at {cut}")


def key_times(run: Run) -> Iterator[Finding]:
    """A picture at a key time equals that of its step bit for bit, given by step or by time; a
    picture close to a key time is close to it."""
    renderer = Renderer(run.volume)
    times = run.volume.coords["t"].values
    for step in range(run.volume.shape[0]):
        at_step = renderer.render(scene(step=step, transfer_function=THIN_FOG)).rgba
        at_time = renderer.render(scene(time=float(times[step]), transfer_function=THIN_FOG)).rgba
        unlike = float(np.count_nonzero(at_step != at_time))
        yield Finding("picture at a key time", unlike, 0.0, "channels", f"step {step}")
        beside = [place for place in (step - 1e-9, step + 1e-9) if 0 <= place <= len(times) - 1]
        for place in beside:
            off = float(
                np.abs(
                    renderer.render(scene(step=place, transfer_function=THIN_FOG)).rgba - at_step
                ).max()
            )
            yield Finding("picture beside a key time", off, 1e-5, "of a channel", f"step {step}")


THIN_FOG = {"opacity": [[0.0, 0.0], [1.0, 0.3]]}
"""A transfer function through which all of the volume is seen."""


def float64_picture(run: Run, picture_scene: Scene) -> Finding:
    """A picture of ambient light alone equals that of float64."""
    renderer = Renderer(run.volume)
    plan = renderer.plan(picture_scene)
    return _off(renderer.render(picture_scene).rgba, _expected(run, plan))


def _expected(run: Run, plan: Plan) -> Picture:
    """The float64 picture of a plan."""
    frame = decoded_frame(run.volume, plan.step, 0, _everything(run), plan.units)
    return reference_picture(warped(frame, plan.task.rays.grid.warp), plan.task)


def _off(picture: Picture, expected: Picture, name: str = "") -> Finding:
    """The largest difference of a picture from the one that is expected."""
    worst = float(np.abs(picture.astype(np.float64) - expected).max())
    return Finding("float64 picture", worst, NEAR, "of a channel", name)


def _not_empty(max_opacity: float, name: str) -> Finding:
    """A finding that fails for an empty picture, since comparing empty pictures proves nothing."""
    return Finding("empty pictures", not max_opacity > 0, 0.0, "pictures", name)


def _path(plan: Plan) -> npt.NDArray[np.float64]:
    """The length (H, W) of each ray within the drawn box, in units of the coordinates."""
    rays = plan.task.rays
    eyes, directions = rays.pixels()
    directions = directions / np.linalg.norm(directions * rays.grid.spacing, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (rays.grid.bounds - eyes[..., None]) / directions[..., None]
    path = np.nanmin(ends.max(axis=-1), axis=-1) - np.maximum(
        np.nanmax(ends.min(axis=-1), axis=-1), 0.0
    )
    return np.asarray(np.maximum(path, 0.0), dtype=np.float64)


def _everything(run: Run) -> Any:
    return tuple((0, length) for length in run.volume.shape[1:])


SHAPE: Shape = (2, 7, 6, 5)
BOUND: Settings = {"bound": EncodeConfig(max_error_rel=1e-3, effort=1)}
EXACT: Settings = {"exact": EncodeConfig(max_error=0.0, effort=1)}
NETWORK: Settings = {
    "published": EncodeConfig(preset="published", tables="float16", width=8, epochs=30)
}
FOG: Any = {"opacity": [[0.0, 0.02], [1.0, 0.5]]}
AXES = ("xy", "yx", "xz", "zx", "yz", "zy")
FRONT = {"view": "xy", "projection": "parallel"}


_waves = partial(waves, SHAPE)
_series = single(_waves)
_constant = single(partial(np.ones, (1, 2, 3, 3)))
"""Makes a volume that is 1 everywhere."""


def _scaled(factor: float, offset: float, dtype: str) -> Callable[[], ArraySeries]:
    return single(lambda: _waves() * factor + offset, dtype=dtype)


def _even(origin: float, spacing: float, length: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return origin + spacing * np.arange(length, dtype=np.float64)


def _stairs() -> ArraySeries:
    """Integer values: every isosurface of an integer passes through vertices and coincides with
    faces of cells."""
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    return series((np.maximum(np.maximum(z, y), x) + t).astype(np.float32))


def _holes() -> ArraySeries:
    values = waves(SHAPE).astype(np.float32)
    values[:, 2:4, 1:4, 1:3] = np.nan
    values[0, 0, 0, 0] = values[1, -1, -1, -1] = np.inf
    values[:, :, 5, :] = np.nan
    return series(values)


def _case(
    name: str,
    about: str,
    *checks: Check,
    make: Callable[[], ArraySeries] = _series,
    settings: Settings = BOUND,
    **rest: Any,
) -> Case:
    return Case("rays", name, about, make, settings, checks=checks, **rest)


def _grid_camera(view: str) -> dict[str, Any]:
    """A parallel camera along an axis with 9 x 9 pixels, one vertex apart: rays hit vertices, edges
    and faces."""
    across = {"x": 5, "y": 6, "z": 7}
    return {
        "view": view,
        "projection": "parallel",
        "parallel_scale": 4.5,
        "focal_point": [(across[axis] - 1) // 2 for axis in "xyz"],
    }


def _towards(
    position: tuple[float, float, float], focal: tuple[float, float, float], **more: Any
) -> dict[str, Any]:
    return {
        "position": list(position),
        "focal_point": list(focal),
        "view_up": [0.3, 0.1, 1.0],
        **more,
    }


FAR = 1e6 * 10.0
"""A distance of a million times the size of the volume."""
CAMERAS = {
    "inside": _towards((2.1, 2.7, 3.2), (4.0, 1.0, 6.0)),
    "on-a-vertex": _towards((2.0, 3.0, 3.0), (4.0, 1.0, 6.0)),
    "on-a-face": _towards((0.0, 2.5, 3.2), (4.0, 2.0, 3.0)),
    "on-a-face-looking-along": _towards((0.0, 2.5, -4.0), (0.0, 2.5, 3.0)),
    "on-an-edge": _towards((0.0, 0.0, 3.0), (4.0, 5.0, 3.0)),
    "on-a-corner": _towards((4.0, 5.0, 6.0), (0.0, 0.0, 0.0)),
    "far": _towards((FAR, FAR, FAR), (2.0, 2.5, 3.0), zoom=1e6),
    "far-parallel": _towards(
        (FAR, -FAR, FAR), (2.0, 2.5, 3.0), projection="parallel", parallel_scale=5.0
    ),
    "wide": _towards((2.1, 2.7, 3.2), (4.0, 1.0, 6.0), view_angle=170.0),
}
CORNERS = {
    "corner-to-corner": _towards((-4.0, -5.0, -6.0), (4.0, 5.0, 6.0)),
    "through-a-corner": _towards((8.0, -4.0, 2.0), (4.0, 0.0, 6.0)),
    "through-an-edge": _towards((8.0, -4.0, 3.0), (4.0, 0.0, 3.0)),
    "along-a-diagonal-of-a-face": _towards((-4.0, -5.0, 0.0), (4.0, 5.0, 0.0)),
    "along-an-edge": _towards((0.0, 0.0, -5.0), (0.0, 0.0, 3.0), view_up=[1.0, 0.3, 0.0]),
}


def _fog(**parts: Any) -> Scene:
    """A scene whose volume is a fog."""
    return scene(transfer_function=FOG, **parts)


def _points(*points: list[float], density: float = 1.0, **parts: Any) -> Scene:
    """A scene of points [value, opacity]."""
    return scene(transfer_function={"opacity": points, "density": density}, **parts)


def _surface(value: float, **fields: Any) -> Scene:
    """A scene of an isosurface alone."""
    surface = {"value": value, "colour": "#ff8000", **fields}
    return scene(transfer_function={"nothing": True}, effects={"isosurfaces": [surface]})


SURFACES = {
    "nothing-below-the-least": _surface(0.0),
    "2": _surface(2.0),
    "3-half": _surface(3.0, opacity=0.5),
    "nothing-above": _surface(7.0),
}
RANGE = {
    "iso": scene(),
    "front": scene(camera=FRONT),
    "opaque": scene(transfer_function={"opacity": "opaque"}),
    "linear": scene(transfer_function={"opacity": "linear"}),
}

RAY_CASES = (
    _case(
        "opacity-1",
        "opaque values, alone and beside transparent ones",
        scenes(
            {
                "everywhere": _points([0.0, 1.0]),
                "a-step": _points([0.0, 0.0], [0.5, 0.0], [0.6, 1.0], [1.0, 1.0]),
                "dense": _points([0.0, 0.9], [1.0, 1.0], density=1e6),
            }
        ),
    ),
    _case(
        "opacity-0",
        "volumes that are hardly visible, and a fully transparent surface",
        scenes(
            {
                "thin": _points([0.0, 0.0], [1.0, 1e-9]),
                "rare": _points([0.0, 0.0], [1.0, 1.0], density=1e-6),
                "clear-surface": _fog(effects={"isosurfaces": [{"value": 0.5, "opacity": 0.0}]}),
            }
        ),
    ),
    _case(
        "tiny-steps",
        "a million samples of each ray add up to the closed form",
        closed_form(
            {
                "step-1e-6": _points([0.0, 0.5], size=[2, 2], camera=FRONT, march={"step": 1e-6}),
                "step-1e-6-thin": _points(
                    [0.0, 1e-3], size=[2, 2], camera=FRONT, march={"step": 1e-6}
                ),
                "step-64": _points([0.0, 0.5], size=[4, 4], march={"step": 64.0}),
            },
            1.0,
        ),
        make=_constant,
    ),
    _case(
        "rays-along-faces",
        "rays parallel to an axis, through vertices, along edges and faces",
        scenes({view: _fog(size=[9, 9], camera=_grid_camera(view)) for view in AXES}),
    ),
    _case(
        "rays-through-corners",
        "rays through corners and edges, and along diagonals",
        scenes({name: _fog(size=[9, 9], camera=camera) for name, camera in CORNERS.items()}),
    ),
    _case(
        "cameras",
        "a camera inside the volume, on a face, edge or corner, and a million sizes away",
        scenes({name: _fog(camera=camera) for name, camera in CAMERAS.items()}),
    ),
    *(
        _case(
            f"spacing-{name}",
            "cells of extreme shape",
            # An odd number of pixels, so that a ray through the middle hits the thinnest side. Long
            # steps, since a needle takes 10^7 of the usual ones.
            scenes(
                {
                    view: _fog(
                        size=[15, 15],
                        camera={"view": view, "projection": "parallel"},
                        march={"step": step},
                    )
                    for view in ("xy", "xz", "yz", "iso")
                }
            ),
            make=single(_waves, z=_even(0, dz, 7), y=_even(0, dy, 6), x=_even(0, dx, 5)),
            quick=name != "needles",
        )
        for name, dz, dy, dx, step in (
            ("needles", 1e6, 1.0, 1e-6, 64.0),
            ("small", 1e-6, 1e-6, 1e-6, 0.5),
            ("large", 1e6, -1e6, 1e6, 0.5),
            ("plates", 1e-3, 1e3, 1e3, 0.5),
        )
    ),
    _case(
        "far-origin",
        "positions far from the origin compared with the size of the volume",
        scenes({"iso": _fog()}),
        make=single(_waves, z=_even(1e8, 1.0, 7), y=_even(-1e8, 0.5, 6), x=_even(1e8, -1.0, 5)),
    ),
    *(
        _case(
            f"drawn-range-{name}",
            "a range of values at the ends of float32, or small compared with its offset",
            scenes(RANGE),
            make=_scaled(factor, offset, dtype),
        )
        for name, factor, offset, dtype in (
            ("tiny", 1e-38, 0.0, "float32"),
            ("huge", 3e38, -1e38, "float32"),
            ("offset-float64", 1e-3, 1e8, "float64"),
            ("offset-float32", 64.0, 1e8, "float32"),
            ("float64-tiny", 1e-300, 0.0, "float64"),
            ("float64-huge", 1e300, 0.0, "float64"),
        )
    ),
    _case(
        "surfaces-on-vertices",
        "isosurfaces at exactly the values of vertices, from the smallest to above the largest",
        scenes(SURFACES),
        make=_stairs,
        settings=EXACT,
    ),
    _case(
        "surface-on-a-face",
        "an isosurface that coincides with a face of the volume",
        scenes({"6": _surface(6.0)}),
        make=_stairs,
        settings=EXACT,
    ),
    _case(
        "holes",
        "regions, a slab and single vertices without values",
        scenes(
            {
                "iso": _fog(),
                "other-side": _fog(camera={"azimuth": 190.0, "elevation": -20.0}),
                "surface": _surface(0.5, colour=None),
            }
        ),
        make=_holes,
    ),
    *(
        _case(
            f"thin-{axis}",
            "a volume of one vertex along an axis",
            scenes({"iso": _fog(), "side": _fog(camera={"view": "xz"})}),
            make=single(partial(waves, shape)),
        )
        for axis, shape in {
            "z": (2, 1, 6, 5),
            "y": (2, 7, 1, 5),
            "x": (2, 7, 6, 1),
            "all": (2, 1, 1, 1),
        }.items()
    ),
    _case("blocks", "a volume cut in two at every layer, and put together again", blocks),
    _case(
        "pictures-at-key-times",
        "pictures at key times, given by step and by time",
        key_times,
        settings={**BOUND, **NETWORK},
    ),
)
