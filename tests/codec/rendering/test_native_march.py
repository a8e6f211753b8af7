"""The native marcher: its structure, its task and its pictures."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_codec import native
from fhash_codec.rendering.bricks import SIDE, Bricks
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.light import light_grid
from fhash_codec.rendering.march import (
    MAX_MAGNITUDE,
    MAX_SURFACES,
    POWERS,
    TILE,
    March,
    MarchInput,
    march_native,
    numbers,
)
from fhash_codec.rendering.march_task import Frame, Grading, Lighting, Surface, Table, Task
from fhash_codec.rendering.scenes import Camera, Shadows
from fhash_codec.rendering.view import Body

SOURCES = Path(native.__file__).parent


def constant(name: str, file: str) -> int:
    match = re.search(rf"\b{name} = (\d+)", (SOURCES / file).read_text(encoding="utf-8"))
    assert match is not None
    return int(match[1])


def test_the_fields_are_those_of_the_header_in_its_order() -> None:
    header = (SOURCES / "march.hpp").read_text(encoding="utf-8")
    body = header.split("struct FhashMarch {")[1].split("\n};")[0]
    declarations = re.sub(r"//.*", "", body).split(";")[:-1]
    names = [
        re.sub(r"\[.*|^.*[ *]", "", name.strip())
        for declaration in declarations
        for name in declaration.split(",")
    ]
    assert names == [name for name, _ in March._fields_]


def test_both_sides_have_the_same_constants() -> None:
    assert constant("FHASH_SURFACES", "march.hpp") == MAX_SURFACES
    assert constant("FHASH_POWERS", "march.hpp") == POWERS
    assert constant("FHASH_BRICK", "march.hpp") == SIDE
    assert constant("TILE", "march_packet.hpp") == TILE


def test_a_structure_keeps_its_arrays_and_refuses_those_of_another_type() -> None:
    structure = March(values=np.arange(1000, dtype=np.float32), depth=None, eye=numbers([1, 2, 3]))
    assert structure.values[999] == 999
    assert not structure.depth
    assert list(structure.eye) == [1.0, 2.0, 3.0]
    with pytest.raises(AssertionError, match="values is float64"):
        March(values=np.zeros(3))
    with pytest.raises(AssertionError, match="depth is not contiguous"):
        March(depth=np.zeros((4, 4), dtype=np.float32)[:, ::2])


COUNTS = (21, 17, 13)


def input_of(values: Any, low: float, high: float, level: float, **place: Any) -> MarchInput:
    """The input for a frame of values, a table and a surface."""
    grid = Grid(counts=COUNTS, origin=np.zeros(3), spacing=np.array([1.0, 2.0, -3.0]))
    frame = Frame(values=np.asarray(values, dtype=np.float32), **place)
    task = Task(
        rays=Rays.of(Camera(), grid, (4, 4)),
        step=0.5,
        threshold=0.0,
        table=Table(
            low=low, high=high, colours=np.ones((2, 3), np.float32), extinctions=np.ones(2)
        ),
        surfaces=(Surface(value=level, colour=np.ones(3), opacity=1.0),),
    )
    return MarchInput.of(frame, task, Bricks.of(frame))


def test_places_of_the_domain_are_those_of_the_frame() -> None:
    values = np.zeros((3, 4, 5))
    whole = input_of(np.zeros(COUNTS[::-1]), 0.0, 1.0, 0.5, first=(0, 0, 0))
    part = input_of(values, 0.0, 1.0, 0.5, first=(2, 4, 6), stride=2)
    shift = np.array([6.0, 4.0, 2.0])
    np.testing.assert_array_equal(part.eye, (whole.eye - shift) / 2)
    np.testing.assert_array_equal(part.forward, whole.forward / 2)
    np.testing.assert_array_equal(part.box, (whole.box - shift[:, None]) / 2)
    np.testing.assert_array_equal(part.spacing, 2 * whole.spacing)
    np.testing.assert_array_equal(part.seen, [[0, 4], [0, 3], [0, 2]])


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1e38), (-3e38, 3e38), (0.0, 1e-30), (2.0**-130, 2.0**-129)]
)
def test_values_are_scaled_to_what_float32_can_compute_with(low: float, high: float) -> None:
    shares = np.linspace(0, 1, 27).reshape(3, 3, 3)
    given = input_of(low + shares * (high - low), low, high, (low + high) / 2, first=(0, 0, 0))
    assert 1e-28 < given.high - given.low < MAX_MAGNITUDE
    scaled = (given.values - given.low) / (given.high - given.low)
    np.testing.assert_allclose(scaled, shares, atol=1e-5)
    assert given.levels[0] == pytest.approx((given.low + given.high) / 2)


CENTRAL = Lighting(
    ambient=0.2, diffuse=0.8, specular=0.3, specular_power=8.0, lamp=None, central=True
)
CELL = replace(CENTRAL, central=False)
WHITE = np.ones(3)
GRADING = Grading(factors=np.interp(np.arange(1025), [0, 300, 900], [0, 1, 0.3]), top=0.2)
BODY = Body(
    bounds=np.array([[-0.5, 17.3], [-0.5, 40], [-0.5, 40]]),
    planes=np.array([[-0.6, 0.8, 0, -4.5], [0, 0.6, -0.8, -7.25]]),
)
PATHS = {"quickest": 0, "AVX2": 1, "plain": 2}


@pytest.fixture(params=PATHS)
def path(request):
    return PATHS[request.param]


def marched(values, task, path=0, first=(0, 0, 0)):
    frame = Frame(values=np.asarray(values, dtype=np.float32), first=first)
    return march_native(native.library(), frame, task, Bricks.of(frame), path=path)


def task_of(
    shape,
    extinctions,
    *,
    camera=None,
    size=(20, 18),
    step=0.5,
    threshold=0.0,
    lighting=CENTRAL,
    **more,
):
    table = None
    if extinctions is not None:
        colours = np.tile(np.float32([0.9, 0.6, 0.3]), (len(extinctions), 1))
        table = Table(
            low=0.0,
            high=1.0,
            colours=colours,
            extinctions=np.asarray(extinctions, dtype=np.float64),
        )
    rays = Rays.of(
        camera or Camera(azimuth=20.0),
        Grid(counts=shape[::-1], origin=np.zeros(3), spacing=np.ones(3)),
        size,
    )
    return Task(rays=rays, step=step, threshold=threshold, table=table, lighting=lighting, **more)


def waves(shape=(14, 17, 22), pace=1.0):
    z, y, x = np.meshgrid(*(np.linspace(0, pace, size) for size in shape), indexing="ij")
    return (0.5 + 0.25 * np.sin(7 * x + 3 * y) + 0.25 * np.cos(5 * y - 6 * z + 2 * x)).astype(
        np.float32
    )


def trilinear(values, places):
    """Values and gradients of the cell at places (n, 3), x, y, z, clamped."""
    last = np.array(values.shape[::-1]) - 1
    at = np.clip(places, 0, last)
    low = np.minimum(at.astype(np.int64), last - 1)
    share = at - low
    value, slope = np.zeros(len(at)), np.zeros((len(at), 3))
    for corner in np.ndindex(2, 2, 2):
        index = low + corner
        weights = np.where(corner, share, 1 - share)
        found = values[index[:, 2], index[:, 1], index[:, 0]].astype(np.float64)
        weight = weights.prod(axis=1)
        value += np.where(weight > 0, weight * found, 0)
        for axis in range(3):
            slope[:, axis] += (
                (2 * corner[axis] - 1) * np.delete(weights, axis, axis=1).prod(axis=1) * found
            )
    return value, slope


def slopes(values, places):
    """Central differences, where one is missing that of the cell, where that is missing none."""
    places = np.clip(places, 0, np.array(values.shape[::-1]) - 1)
    central = np.stack(
        [
            (trilinear(values, places + one)[0] - trilinear(values, places - one)[0]) / 2
            for one in np.eye(3)
        ],
        axis=-1,
    )
    return np.nan_to_num(np.where(np.isnan(central), trilinear(values, places)[1], central))


def lit(colour, slope, along, lighting):
    length = np.sqrt((slope**2).sum(axis=1))
    cosine = np.abs((slope * along).sum(axis=1)) / np.where(length > 0, length, np.inf)
    shine = lighting.specular * cosine**lighting.specular_power
    return colour * (lighting.ambient + lighting.diffuse * cosine)[:, None] + shine[:, None]


def places_of(task, shape):
    """Pixels, places, lengths and directions of the samples of all rays, number by number."""
    origin, along = (
        np.array(np.broadcast_to(part.reshape(-1, 3), (np.prod(task.rays.size), 3)))
        for part in task.rays.pixels()
    )
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        ends = (np.stack([np.zeros(3), np.array(shape[::-1]) - 1.0]) - origin[:, None]) / along[
            :, None
        ]
    enter, leave = np.maximum(ends.min(axis=1).max(axis=1), 0), ends.max(axis=1).min(axis=1)
    for number in range(int(np.ceil((leave - enter).max() / task.step))):
        pixels = np.flatnonzero(enter + number * task.step < leave)
        left = leave[pixels] - enter[pixels] - number * task.step
        yield (
            pixels,
            origin[pixels] + (enter[pixels] + (number + 0.5) * task.step)[:, None] * along[pixels],
            np.minimum(left, task.step),
            along[pixels],
        )


def pictured(values, task):
    """The lit picture of a task."""
    rgb, clear = np.zeros((np.prod(task.rays.size), 3)), np.ones(np.prod(task.rays.size))
    for pixels, places, length, along in places_of(task, values.shape):
        value = trilinear(values, places)[0]
        extinction = np.interp(
            value, np.linspace(0, 1, len(task.table.extinctions)), task.table.extinctions
        )
        opacity = np.where(np.isnan(value), 0, -np.expm1(-extinction * length))
        colour = lit(
            task.table.colours[0].astype(np.float64), slopes(values, places), along, task.lighting
        )
        rgb[pixels] += (clear[pixels] * opacity)[:, None] * colour
        clear[pixels] *= 1 - opacity
    return np.concatenate([rgb, 1 - clear[:, None]], axis=1).reshape(
        task.rays.size[1], task.rays.size[0], 4
    )


@pytest.mark.parametrize("missing", [False, True])
def test_a_volume_is_lit_by_central_differences(path, missing) -> None:
    values = waves()
    if missing:
        values[4:7, 5:9, 3:12] = np.nan
    task = task_of(values.shape, np.linspace(0, 0.4, 100), shaded=True)
    found = marched(values, task, path)
    np.testing.assert_allclose(found.rgba, pictured(values, task), atol=5e-4)
    cell = marched(values, replace(task, lighting=CELL), path)
    assert np.abs(found.rgba - cell.rgba)[..., :3].max() > 0.02
    np.testing.assert_array_equal(found.rgba[..., 3], cell.rgba[..., 3])
    assert found.counters == cell.counters


CASES = {
    "fog": {},
    "shaded": {"shaded": True, "lighting": CELL, "depth": True, "normal": True},
    "central": {"shaded": True, "antialiasing": 2},
    "jitter": {"jitter": True, "step": 1.7},
    "surfaces": {"shaded": True, "surfaces": (Surface(value=0.62, colour=WHITE, opacity=0.4),)},
    "maximum": {"projection": "maximum", "depth": True},
    "minimum": {"projection": "minimum", "depth": True},
    "average": {"projection": "average", "depth": True, "extinctions": [1.0] * 100},
    "attenuated": {"projection": "attenuated", "attenuation": 0.4, "depth": True},
    "graded": {"shaded": True, "grading": GRADING},
    "graded fog": {
        "grading": GRADING,
        "surfaces": (Surface(value=0.62, colour=WHITE, opacity=0.4),),
    },
    "clipped": {"shaded": True, "body": BODY},
    "narrow": {"extinctions": [0.0] * 50 + [1.0] * 3 + [0.0] * 50},
}


@pytest.mark.parametrize("shape", [(14, 17, 22), (1, 30, 30), (30, 30, 1)])
@pytest.mark.parametrize("case", CASES)
def test_all_paths_make_one_picture(path, case, shape) -> None:
    values = waves(shape)
    more = {
        "extinctions": np.concatenate([np.zeros(40), np.linspace(0, 0.4, 60)]),
        "size": (37, 29),
        **CASES[case],
    }
    for first, counts in (((0, 0, 0), shape), ((0, 2, 0), (shape[0], shape[1] + 5, shape[2]))):
        task = task_of(counts, **more)
        quickest, found = marched(values, task, 0, first), marched(values, task, path, first)
        assert found.rgba[..., 3].max() > 0.01
        np.testing.assert_allclose(found.rgba, quickest.rgba, atol=2e-4)
        for name in ("rays", "samples"):
            assert found.counters[name] == pytest.approx(quickest.counters[name], rel=0.01)
        if task.depth:
            np.testing.assert_array_equal(np.isfinite(found.depth), np.isfinite(quickest.depth))


def test_all_paths_make_one_picture_in_a_grid_of_light(path) -> None:
    values = waves()
    for shaded in (False, True):
        task = task_of(values.shape, np.linspace(0, 0.4, 100), shaded=shaded)
        frame = Frame(values=values, first=(0, 0, 0))
        light = light_grid(frame, task, shadows=Shadows(), lamp=np.array([0, 0, 1.0]))
        task = replace(task, light=light)
        np.testing.assert_allclose(
            marched(values, task, path).rgba, marched(values, task).rgba, atol=2e-5
        )


@pytest.mark.parametrize("step", [0.3, 0.5, 0.9, 2.5, 3.9, 7.0])
@pytest.mark.parametrize("jitter", [False, True])
def test_no_surface_is_lost_by_skipping(path, step, jitter) -> None:
    values = waves((27, 30, 38), pace=2.0)
    samples = []
    for camera in (Camera(azimuth=20.0, elevation=10.0), Camera(view="xy", projection="parallel")):
        for level in (0.52, 0.9):
            surface = Surface(value=level, colour=WHITE, opacity=0.5)
            task = task_of(
                values.shape,
                None,
                camera=camera,
                size=(80, 70),
                step=step,
                jitter=jitter,
                surfaces=(surface,),
            )
            found, everything = (
                marched(values, task, path),
                marched(values, replace(task, skipping=False), path),
            )
            np.testing.assert_allclose(found.rgba, everything.rgba, atol=1e-5)
            samples.append(found.counters["samples"] / everything.counters["samples"])
    if step < 1:
        assert max(samples) < 0.9
