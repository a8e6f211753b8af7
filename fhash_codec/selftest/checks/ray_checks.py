"""What pictures of hard scenes have to keep: finite pixels, the float64 picture, one picture by every way to march, blocks, key times."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.rendering.march import march
from fhash_codec.rendering.picture.plan import Plan
from fhash_codec.rendering.picture.planning import plan_picture
from fhash_codec.rendering.renderer import Renderer, decoded_frame
from fhash_codec.rendering.scene.scene import Scene
from fhash_codec.rendering.task.task import Frame
from fhash_codec.selftest.case import Check, Finding, Run
from fhash_codec.selftest.checks.ray_oracle import drawn
from fhash_codec.selftest.environment import environment

__all__ = ["SAME", "blocks", "closed_form", "key_times", "scene", "scenes"]

Picture = npt.NDArray[Any]

NEAR = 1e-3
"""Of a channel, by which two ways to march the same values, and float64, may differ."""
SAME = ("cache", "stream", "arm")


def scene(**parts: Any) -> Scene:
    """A scene from its JSON values, small, over nothing, whose rays do not end early; lit from everywhere, so that colours stay."""
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


def scenes(
    chosen: Mapping[str, Scene], *, modes: tuple[str, ...] = SAME, oracle: bool = True
) -> Check:
    """Every one of these scenes: finite, within 0..1, the float64 picture, and the same by each mode, natively and without."""

    def check(run: Run) -> Iterator[Finding]:
        renderer = Renderer(run.volume)
        for name, one in chosen.items():
            yield from _pictures(run, renderer, name, one, modes, oracle)

    return check


def closed_form(chosen: Mapping[str, Scene], value: float) -> Check:
    """A series that is `value` everywhere has the opacity 1 - exp(-extinction * path) of each ray, at any length of a step."""

    def check(run: Run) -> Iterator[Finding]:
        renderer = Renderer(run.volume)
        for name, one in chosen.items():
            plan = renderer.plan(one)
            table, picture = plan.task.table, renderer.render(one).rgba
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
            yield _shown(float(path.max()), name)

    return check


def blocks(run: Run) -> Iterator[Finding]:
    """The front part of a volume over its back part is the whole: compositing is associative, wherever it is cut between two samples."""
    one = scene(camera={"view": "xy", "projection": "parallel"}, transfer_function=FOG)
    plan = plan_picture(run.volume, one)
    frame = decoded_frame(run.volume, plan.step, 0, _everything(run), plan.units)
    whole = march(frame, plan.task).rgba
    for cut in range(1, frame.values.shape[0] - 1):
        # Seen from above: the front has the larger z. Samples lie at quarters, never on the vertex that both parts have.
        front = march(Frame(values=frame.values[cut:], first=(cut, 0, 0)), plan.task).rgba
        back = march(Frame(values=frame.values[: cut + 1], first=(0, 0, 0)), plan.task).rgba
        worst = float(np.abs(front + (1 - front[..., 3:]) * back - whole).max())
        yield Finding(
            name="blocks = whole",
            worst=worst,
            limit=2e-6,
            unit="of a channel",
            under=f"cut at {cut}",
        )
        yield _shown(float(min(front[..., 3].max(), back[..., 3].max())), f"cut at {cut}")


def key_times(run: Run) -> Iterator[Finding]:
    """A picture at a key time is that of its step, bit for bit, however it is named; close beside it, it is close."""
    renderer = Renderer(run.volume)
    times = run.volume.coords["t"].values
    for step in range(run.volume.shape[0]):
        at_step = renderer.render(scene(step=step, transfer_function=FOG)).rgba
        at_time = renderer.render(scene(time=float(times[step]), transfer_function=FOG)).rgba
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
                    renderer.render(scene(step=place, transfer_function=FOG)).rgba - at_step
                ).max()
            )
            yield Finding(
                name="picture beside a key time",
                worst=off,
                limit=1e-5,
                unit="of a channel",
                under=f"step {step}",
            )


FOG = {"opacity": [[0.0, 0.0], [1.0, 0.3]]}


def _pictures(
    run: Run, renderer: Renderer, name: str, one: Scene, modes: tuple[str, ...], oracle: bool
) -> Iterator[Finding]:
    by_mode = {
        mode: renderer.render(replace(one, march=replace(one.march, mode=mode))).rgba
        for mode in modes
    }
    if native.library() is not None:
        with environment(FHASH_NATIVE="0"):
            by_mode["portable"] = Renderer(run.volume).render(one).rgba
    bad = sum(int(np.count_nonzero(~np.isfinite(picture))) for picture in by_mode.values())
    yield Finding(name="finite pixels", worst=float(bad), limit=0.0, unit="channels", under=name)
    beyond = max(
        max(-float(picture.min()), float(picture.max()) - 1.0, 0.0) for picture in by_mode.values()
    )
    yield Finding(name="pixels in 0..1", worst=beyond, limit=1e-6, unit="of a channel", under=name)
    first = by_mode[modes[0]]
    for mode, picture in by_mode.items():
        if mode != modes[0]:
            yield Finding(
                name=f"{mode} = {modes[0]}",
                worst=_off(picture, first),
                limit=NEAR,
                unit="of a channel",
                under=name,
            )
    if oracle:
        plan = renderer.plan(one)
        frame = decoded_frame(run.volume, plan.step, 0, _everything(run), plan.units)
        expected = drawn(frame, plan.task)
        yield Finding(
            name="float64 picture",
            worst=_off(first, expected),
            limit=NEAR,
            unit="of a channel",
            under=name,
        )
        if not name.startswith("nothing"):
            yield _shown(float(expected[..., 3].max()), name)


def _shown(most: float, name: str) -> Finding:
    """That a comparison is one of something."""
    return Finding(
        name="empty pictures", worst=float(not most > 0), limit=0.0, unit="pictures", under=name
    )


def _off(one: Picture, other: Picture) -> float:
    return float(np.abs(one.astype(np.float64) - other).max())


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
