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
        ({"size": [0, 9]}, "size is 0; allowed: 1 to 16384"),
    ],
)
def test_scenes_that_contradict_themselves_are_refused(
    values: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Scene.from_dict(values)
