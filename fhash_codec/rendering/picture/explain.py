"""A plan in words: what is done for a picture and why, a line for each topic."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fhash_codec.volume import Volume

if TYPE_CHECKING:
    from fhash_codec.rendering.picture.plan import Plan

__all__ = ["reasons"]


def reasons(plan: Plan, volume: Volume) -> list[tuple[str, str]]:
    """What is done and why, a line for each topic."""
    task, scene, effects = plan.task, plan.scene, plan.scene.effects
    width, height = scene.size
    found = [
        (
            "picture",
            f"{width} x {height}, {scene.camera.projection}, {task.antialiasing**2} ray(s) for each pixel",
        ),
        ("proportions", _scale_text(plan)),
        (
            "time",
            f"step {plan.step:g}"
            + ("" if float(plan.step).is_integer() else ", between two: both are decoded"),
        ),
        ("march", _mode_text(plan, volume)),
        ("value", _value_text(plan)),
        ("gradient", _gradient_text(plan)),
        ("secondary rays", _secondary_text(plan)),
        ("level of detail", f"{plan.lod}: {plan.why_lod}"),
        (
            "region",
            "z {}:{}, y {}:{}, x {}:{}".format(*(end for part in plan.region for end in part))
            + _region_text(plan, volume),
        ),
        ("bricks", _brick_text(plan)),
        (
            "rays end",
            f"where less than {task.threshold:.3g} of the light is left"
            if task.threshold > 0
            else "behind the volume",
        ),
        ("step", f"{task.step:.6g}, {scene.march.step:g} of the distance between vertices"),
    ]
    buffers = [name for name, on in (("depth", task.depth), ("normal", task.normal)) if on]
    around = [
        name for name in ("box", "axes", "colour_bar", "time_label") if getattr(effects, name)
    ]
    if buffers:
        found.append(("buffers", ", ".join(buffers)))
    if around:
        found.append(("around", ", ".join(around) + ": drawn afterwards"))
    return found


def _scale_text(plan: Plan) -> str:
    scale = plan.task.rays.grid.scale
    if scale == (1.0, 1.0, 1.0):
        return "those of the coordinates"
    why = (
        "as the scene says"
        if plan.scene.scale is not None
        else "an axis in other units than the rest has its vertices as far apart"
    )
    return f"x, y, z are stretched by {', '.join(f'{factor:.4g}' for factor in scale)}: {why}"


def _mode_text(plan: Plan, volume: Volume) -> str:
    if plan.mode == "cache":
        return "cache: decode once, then march what was decoded"
    through = (
        "the network, which has values of its own between vertices"
        if volume.profile == "paper"
        else "the lattice"
    )
    if plan.mode == "stream":
        return f"stream: one sample of each ray in a pass, straight through {through}"
    budget = plan.scene.march.samples_per_pass
    return f"arm: {'as many samples as rays' if budget is None else f'{budget:,} samples'} in a pass, straight through {through}"


def _value_text(plan: Plan) -> str:
    task = plan.task
    if task.maximum:
        return "the largest along each ray"
    if task.table is None:
        return f"at each sample, for {len(task.surfaces)} surface(s) alone"
    low, high = plan.function.span
    return f"at each sample; values from {low:.6g} to {high:.6g} can be seen" + (
        f", and {len(task.surfaces)} surface(s)" * bool(task.surfaces)
    )


def _gradient_text(plan: Plan) -> str:
    task = plan.task
    wanted = [
        text
        for text, on in (
            ("where a sample has opacity, for shading", task.shaded),
            ("on surfaces, for shading", bool(task.surfaces)),
            ("where half of the light is left, for normals", task.normal),
        )
        if on
    ]
    return "; ".join(wanted) if wanted else "none: no effect asks for it"


def _secondary_text(plan: Plan) -> str:
    wanted = []
    if plan.shadows is not None:
        wanted.append(f"shadows on a grid of {plan.shadows.resolution:g} vertices")
    if plan.occlusion is not None:
        wanted.append(f"ambient occlusion within {plan.occlusion.radius:g} vertices")
    return "; ".join(wanted) if wanted else "none: no effect asks for them"


def _region_text(plan: Plan, volume: Volume) -> str:
    if plan.lights:
        return " (all: light comes from everywhere)"
    whole = all(
        high - low == length
        for (low, high), length in zip(plan.region, volume.shape[1:], strict=True)
    )
    return " (all)" if whole else " (what is in the picture)"


def _brick_text(plan: Plan) -> str:
    if not plan.task.skipping:
        return "all are marched: skipping is off"
    wanted = [
        text
        for text, on in (
            ("hold visible values", plan.task.table is not None),
            ("cross a surface", bool(plan.task.surfaces)),
        )
        if on
    ]
    if plan.task.maximum:
        wanted = ["can hold a larger value than was met", *wanted[1:]]
    rare = (
        "" if plan.task.maximum or plan.mode != "cache" else "; all, where few could be passed over"
    )
    return f"only those that {' or '.join(wanted)}{rare}"
