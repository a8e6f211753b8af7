"""Scenes: their files, and the times that they may not name at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.scene.scene import Scene
from fhash_formats.errors import InputError, MissingInputError

VALUES: dict[str, Any] = {
    "camera": {"view": "xz", "position": [1.5, 2.0, 3.25]},
    "size": [30, 20],
    "background": "transparent",
    "effects": {"shading": {"ambient": 0.5}, "buffers": ["depth"]},
    "step": 3.5,
}


def test_a_scene_comes_back_from_its_json() -> None:
    scene = Scene.from_dict(VALUES)
    assert scene.to_dict() == VALUES
    assert Scene.from_dict(json.loads(json.dumps(scene.to_dict()))) == scene
    assert Scene().to_dict() == {}


def test_a_scene_is_read_from_toml_json_and_pictures(tmp_path: Path) -> None:
    import numpy as np

    scene = Scene.from_dict(VALUES)
    (tmp_path / "a.json").write_text(json.dumps(VALUES))
    (tmp_path / "a.toml").write_text(
        'size = [30, 20]\nbackground = "transparent"\nstep = 3.5\n'
        '[camera]\nview = "xz"\nposition = [1.5, 2, 3.25]\n'
        '[effects]\nbuffers = ["depth"]\nshading = {ambient = 0.5}\n'
    )
    Image(rgba=np.zeros((2, 3, 4), dtype=np.float32), scene=VALUES).save(tmp_path / "a.png")
    for name in ("a.json", "a.toml", "a.png"):
        assert Scene.load(tmp_path / name) == scene


@pytest.mark.parametrize("name", ["a.json", "a.toml", "a.png"])
def test_a_scene_that_is_not_there(tmp_path: Path, name: str) -> None:
    with pytest.raises(MissingInputError, match="no such"):
        Scene.load(tmp_path / name)
    (tmp_path / name).write_text("[")
    with pytest.raises(InputError, match="not a") as caught:
        Scene.load(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"step": 1, "time": 2}, "step and time exclude each other"),
        ({"step": 1, "evolution": {"steps": [0]}}, "steps of its own"),
        ({"time": 1, "evolution": {"steps": [0]}}, "steps of its own"),
        ({"camra": {}}, "did you mean 'camera'"),
        ({"effects": {"shadow": True}}, "did you mean 'shadows'"),
        ({"evolution": {}}, "steps is missing"),
        ({"effects": {"clip": True}}, "clip cuts nothing"),
        ({"effects": {"clip": {"z": [2, 1]}}}, "z is 2 to 1; the first end must be below"),
        ({"effects": {"clip": {"planes": [{"normal": [0, 0, 1]}]}}}, "either a point or an offset"),
        ({"effects": {"clip": {"planes": [{"offset": 1}]}}}, "normal is missing"),
        (
            {"effects": {"clip": {"planes": [{"normal": [0, 0, 0], "offset": 1}]}}},
            "the normal has no length",
        ),
        (
            {"effects": {"clip": {"planes": 7 * [{"normal": [0, 0, 1], "offset": 1}]}}},
            "clip has 7 planes; allowed: 6",
        ),
        (
            {"effects": {"attenuated_maximum_intensity": {"attenuation": 0}}},
            "attenuation is 0; allowed: 1e-06 to 1000",
        ),
        ({"size": [0, 9]}, "size is 0; allowed: 1 to 16384"),
    ],
)
def test_scenes_that_contradict_themselves_are_refused(
    values: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Scene.from_dict(values)


def test_a_clip_and_projections_are_read_and_written() -> None:
    planes = [{"normal": [0, 0, 1], "offset": 2.0}, {"point": [1, 2, 3], "normal": [1, 1, 0]}] * 3
    values = {
        "transfer_function": {"gradient_opacity": [[0, 0.0], [0.5, 1]]},
        "effects": {"clip": {"x": [None, 3.5], "z": [0, None], "planes": planes}},
    }
    scene = Scene.from_dict(values)
    assert Scene.from_dict(scene.to_dict()) == scene
    assert json.loads(json.dumps(scene.to_dict())) == json.loads(json.dumps(values))
    assert Scene.from_dict({"effects": {"clip": False}}) == Scene()
    toml = {"x": [False, 3.5], "z": [0, False], "planes": planes}  # TOML has no null
    assert Scene.from_dict({**values, "effects": {"clip": toml}}) == scene
    both = Scene.from_dict(
        {"effects": {"average_intensity": True, "attenuated_maximum_intensity": True}}
    )
    assert both.effects.projections == ("average", "attenuated")
    assert scene.effects.projections == ()
