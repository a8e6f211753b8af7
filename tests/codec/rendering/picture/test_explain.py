"""The reasons of a plan, in words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, Renderer, Scene, Volume
from fhash_codec.rendering.picture.planning import plan_at, plan_picture
from fhash_formats.series import ArraySeries, Coordinate, index_coordinate

TOPICS = [
    "picture",
    "proportions",
    "time",
    "march",
    "value",
    "gradient",
    "secondary rays",
    "level of detail",
    "region",
    "bricks",
    "rays end",
    "step",
]


def lines(volume: Volume, **scene: Any) -> dict[str, str]:
    return plan_picture(volume, Scene.from_dict(scene)).to_dict()


def test_every_plan_has_the_same_topics(volume: Volume) -> None:
    assert list(lines(volume)) == TOPICS
    more = lines(volume, effects={"buffers": ["depth"], "box": True, "time_label": True})
    assert list(more) == [*TOPICS, "buffers", "around"]
    assert more["buffers"] == "depth"
    assert more["around"].startswith("box, time_label: drawn afterwards; the volume has 512 x ")


@pytest.mark.parametrize(
    ("scene", "topic", "words"),
    [
        ({"size": [30, 20], "effects": {"antialiasing": 2}}, "picture", "30 x 20, perspective, 4 "),
        ({"scale": [1, 2, 3]}, "proportions", "stretched by 1, 2, 3: as the scene says"),
        ({"step": 0.5}, "time", "step 0.5, between two: both are decoded"),
        ({}, "march", "decode once, then march what was decoded, since the file has no network"),
        ({"effects": {"maximum_intensity": True}}, "value", "the largest along each ray"),
        ({"effects": {"minimum_intensity": True}}, "value", "the smallest along each ray"),
        ({"effects": {"average_intensity": True}}, "value", "the mean along each ray"),
        ({"effects": {"average_intensity": True}}, "bricks", "only those that hold values; all"),
        ({"effects": {"average_intensity": True}}, "rays end", "behind the volume"),
        (
            {"effects": {"attenuated_maximum_intensity": True}},
            "rays end",
            "where no later value can be larger",
        ),
        (
            {"transfer_function": {"gradient_opacity": [[0, 0], [1, 1]]}},
            "gradient",
            "where a sample has opacity, for opacity by gradient",
        ),
        (
            {"effects": {"clip": {"z": [2, 5], "planes": [{"normal": [1, 0, 0], "offset": 2}]}}},
            "clip",
            "x 0 to 27, y 0 to 23, z 2 to 5, cut by 1 plane(s): nothing outside is decoded",
        ),
        ({"effects": {"clip": {"z": [2, 5]}}}, "region", "(what the clip leaves, in whole tiles)"),
        ({"effects": {"isosurfaces": [{"value": 5}]}}, "value", "can be seen, and 1 surface(s)"),
        ({"effects": {"isosurfaces": [{"value": 5}]}}, "gradient", "on surfaces, for shading"),
        ({"effects": {"shading": True}}, "gradient", "where a sample has opacity, for shading"),
        ({"effects": {"shadows": True}}, "secondary rays", "shadows on a grid of 2 vertices"),
        ({"effects": {"ambient_occlusion": True}}, "secondary rays", "within 8 vertices"),
        ({"effects": {"shadows": True}}, "region", "(all: light comes from everywhere)"),
        ({"march": {"lod": 1}}, "level of detail", "1: as the scene says"),
        ({"march": {"skipping": False}}, "bricks", "all are marched: skipping is off"),
        ({"march": {"threshold": 0}}, "rays end", "behind the volume"),
    ],
)
def test_a_line_says_what_the_scene_asks_for(
    volume: Volume, scene: dict[str, Any], topic: str, words: str
) -> None:
    assert words in lines(volume, **scene)[topic]
    assert all("\n" not in line for line in lines(volume, **scene).values())


def test_a_plan_moved_in_time_says_so(volume: Volume) -> None:
    plan = plan_picture(volume, Scene())
    moved = plan_at(plan, volume, Scene(time=1.5))
    assert (moved.step, moved.time) == (1.5, 1.5)
    assert moved.task is plan.task
    changed = {topic for topic in TOPICS if moved.to_dict()[topic] != plan.to_dict()[topic]}
    assert changed == {"time"}


def test_places_and_planes_are_explained(tmp_path: Path) -> None:
    def explained(values: np.ndarray, z: Coordinate, **scene: Any) -> dict[str, str]:
        axes = {
            axis: index_coordinate(axis, n) for axis, n in zip("tzyx", values.shape, strict=True)
        }
        series = ArraySeries(values, name="q", units="K", coords={**axes, "z": z})
        fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(effort=1), force=True)
        with fhash_codec.open(tmp_path / "a.fhz") as opened:
            return lines(opened, **scene)

    values = np.random.default_rng(0).random((1, 4, 9, 9)).astype(np.float32)
    depth = Coordinate(name="depth", values=np.array([0, 1, 2, 6.0]), attributes={"units": "hPa"})
    assert explained(values, depth)["proportions"] == (
        "those of the coordinates; z is uneven and resampled to 7 even vertices;"
        " z ascends downwards"
    )
    single = Coordinate(name="z", values=np.zeros(1))
    lit = explained(values[:, :1], single, effects={"shading": True})
    assert lit["gradient"] == "none: a plane is drawn in its colours, without light"


@pytest.mark.parametrize(
    ("march", "words"),
    [
        ({"mode": "stream"}, "one sample of each ray in a pass"),
        ({"mode": "arm"}, "as many samples as rays in a pass"),
        ({"mode": "arm", "samples_per_pass": 5000}, "5,000 samples in a pass"),
    ],
)
def test_a_line_says_how_a_network_is_marched(
    files: dict[str, Path], march: dict[str, Any], words: str
) -> None:
    with fhash_codec.open(files["paper"]) as network:
        plan = Renderer(network).plan(Scene.from_dict({"march": march}))
    assert words in dict(plan.reasons)["march"]
