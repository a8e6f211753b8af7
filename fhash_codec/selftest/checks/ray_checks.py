"""Checks of pictures of hard scenes: finite pixels, equal to the float64 picture, the same by
blocks, and at key times."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, warped
from fhash_codec.rendering.plan import Plan, plan_picture
from fhash_codec.rendering.renderer import Renderer, decoded_frame
from fhash_codec.rendering.scenes import Scene
from fhash_codec.selftest.case import Check, Finding, Run
from fhash_codec.selftest.checks.ray_oracle import reference_picture

__all__ = ["blocks", "closed_form", "float64_picture", "key_times", "scene", "scenes"]

Picture = npt.NDArray[Any]

NEAR = 1e-3
"""Allowed difference of a colour channel from the float64 picture."""


def scene(**parts: Any) -> Scene:
    """A scene from its JSON values: 16 x 16 pixels on a transparent background, with ambient light
    only.

    Ambient light leaves the colours unchanged, and a threshold of 0 keeps rays from ending early.
    """
    march_ = {"threshold": 0.0, "lod": 0, **parts.pop("march", {})}
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


def scenes(scenes_by_name: Mapping[str, Scene], *, oracle: bool = True) -> Check:
    """A check that draws each scene: finite and within 0..1.

    Args:
        scenes_by_name: the scenes.
        oracle: whether the picture is also compared with the float64 picture.
    """

    def check(run: Run) -> Iterator[Finding]:
        renderer = Renderer(run.volume)
        for name, scene_ in scenes_by_name.items():
            yield from _pictures(run, renderer, name, scene_, oracle)

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
            yield Finding(
                name="closed form", worst=worst, limit=NEAR, unit="of a channel", under=name
            )
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
        yield Finding(
            name="blocks = whole",
            worst=worst,
            limit=2e-6,
            unit="of a channel",
            under=f"cut at {cut}",
        )
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
        yield Finding(
            name="picture at a key time",
            worst=unlike,
            limit=0.0,
            unit="channels",
            under=f"step {step}",
        )
        beside = [place for place in (step - 1e-9, step + 1e-9) if 0 <= place <= len(times) - 1]
        for place in beside:
            off = float(
                np.abs(
                    renderer.render(scene(step=place, transfer_function=THIN_FOG)).rgba - at_step
                ).max()
            )
            yield Finding(
                name="picture beside a key time",
                worst=off,
                limit=1e-5,
                unit="of a channel",
                under=f"step {step}",
            )


THIN_FOG = {"opacity": [[0.0, 0.0], [1.0, 0.3]]}
"""A transfer function through which all of the volume is seen."""


def float64_picture(run: Run, picture_scene: Scene) -> Finding:
    """A picture of ambient light alone equals that of float64."""
    renderer = Renderer(run.volume)
    plan = renderer.plan(picture_scene)
    return _off(renderer.render(picture_scene).rgba, _expected(run, plan))


def _pictures(
    run: Run, renderer: Renderer, name: str, picture_scene: Scene, oracle: bool
) -> Iterator[Finding]:
    picture = renderer.render(picture_scene).rgba
    bad = float(np.count_nonzero(~np.isfinite(picture)))
    yield Finding(name="finite pixels", worst=bad, limit=0.0, unit="channels", under=name)
    beyond = max(-float(picture.min()), float(picture.max()) - 1.0, 0.0)
    yield Finding(name="pixels in 0..1", worst=beyond, limit=1e-6, unit="of a channel", under=name)
    if oracle:
        expected = _expected(run, renderer.plan(picture_scene))
        yield _off(picture, expected, name)
        if not name.startswith("nothing"):
            yield _not_empty(float(expected[..., 3].max()), name)


def _expected(run: Run, plan: Plan) -> Picture:
    """The float64 picture of a plan."""
    frame = decoded_frame(run.volume, plan.step, 0, _everything(run), plan.units)
    return reference_picture(warped(frame, plan.task.rays.grid.warp), plan.task)


def _off(picture: Picture, expected: Picture, name: str = "") -> Finding:
    """The largest difference of a picture from the one that is expected."""
    worst = float(np.abs(picture.astype(np.float64) - expected).max())
    return Finding(name="float64 picture", worst=worst, limit=NEAR, unit="of a channel", under=name)


def _not_empty(max_opacity: float, name: str) -> Finding:
    """A finding that fails for an empty picture, since comparing empty pictures proves nothing."""
    return Finding(
        name="empty pictures",
        worst=float(not max_opacity > 0),
        limit=0.0,
        unit="pictures",
        under=name,
    )


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
