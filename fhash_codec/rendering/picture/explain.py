"""A plan in words: what is done for a picture and why, one line for each topic."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.picture.plan import Plan
from fhash_codec.volume import Volume

__all__ = ["reasons"]


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
    if plan.mode == "cache":
        why = f", {plan.why_mode}" if plan.why_mode else ""
        lattice = (
            "; linear between vertices, where the network (arm) has other values"
            if volume.profile == "paper"
            else ""
        )
        return f"cache: decode once, then march what was decoded{why}{lattice}"
    through = "the network, which has values of its own between vertices (cache is linear there)"
    if plan.why_mode:
        through += f"; {plan.why_mode}"
    if plan.mode == "stream":
        return f"stream: one sample of each ray in a pass, straight through {through}"
    budget = plan.scene.march.samples_per_pass
    samples = "as many samples as rays" if budget is None else f"{budget:,} samples"
    return f"arm: {samples} in a pass, straight through {through}"


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
