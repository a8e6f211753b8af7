"""The native marcher: its structure, its task and its pictures."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frame_field import frame_of, table_of, waves
from frame_field import task_of as plain_task

from fhash_codec import native
from fhash_codec.rendering.bricks import SIDE, Bricks
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
from fhash_codec.rendering.march_task import Grading, Lighting, Surface
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
    frame = frame_of(values, **place)
    surfaces = (Surface(value=level, colour=np.ones(3), opacity=1.0),)
    table = table_of([1.0, 1.0], low, high)
    more = {"camera": Camera(), "size": (4, 4), "surfaces": surfaces}
    task = plain_task(COUNTS[::-1], table, (1.0, 2.0, -3.0), **more)
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
    frame = frame_of(values, first=first)
    return march_native(native.library(), frame, task, Bricks.of(frame), path=path)


def task_of(shape, extinctions, **more):
    table = None if extinctions is None else table_of(extinctions, colour=(0.9, 0.6, 0.3))
    given = {"camera": Camera(azimuth=20.0), "size": (20, 18), "lighting": CENTRAL, **more}
    return plain_task(shape, table, **given)


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
    values = waves((14, 17, 22))
    for shaded in (False, True):
        task = task_of(values.shape, np.linspace(0, 0.4, 100), shaded=shaded)
        frame = frame_of(values)
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
