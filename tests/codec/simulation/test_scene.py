"""Scenes to simulate, and the presets."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.simulation.flows import Vortex
from fhash_codec.simulation.scene import MAX_EFFECTS, PRESETS, SimulatedScene, scene_of
from fhash_codec.simulation.simulate import simulate
from fhash_formats.errors import InputError, MissingInputError

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "scenes.md"
TOML = """
name = "smoke"
shape = [4, 5, 6]
[[effects]]
effect = "vortex"
strength = 2
"""


def test_toml_json_and_tables_are_the_same_scene(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(TOML)
    scene = scene_of(tmp_path / "s.toml")
    assert (scene.shape, scene.effects) == ((4, 5, 6), (Vortex(strength=2.0),))
    (tmp_path / "s.JSON").write_text(json.dumps(scene.to_dict()))
    assert scene_of(str(tmp_path / "s.JSON")) == scene == scene_of(scene.to_dict())
    assert scene_of(scene) is scene


@pytest.mark.parametrize("name", ["vortex", "front", "flame", "bubble", "shell"])
def test_presets_survive_a_round_through_their_tables(name: str) -> None:
    scene = scene_of(name)
    assert SimulatedScene.from_dict(json.loads(json.dumps(scene.to_dict()))) == scene


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[effects]]\neffect = 'shel'", "effect 1 is 'shel'; did you mean 'shell'"),
        ("efects = []", "unknown setting 'efects'"),
        ("shape = [4, 5]", "shape is [4, 5]; a list of 3"),
        ("shape = [4, 0, 5]", "shape is 0; allowed: 1 to 16384"),
        ("steps = 2.5", "steps is 2.5; a whole number"),
        ("duration = 0", "duration is 0; allowed"),
        ("name = ' '", "name is empty"),
        ("effects = 3", "effects is 3; a list of tables"),
        ("effects = [1]", "effect 1 is 1; a table"),
        ("splits = 65", "splits is 65; allowed: 1 to 64"),
        ("a = ", "not a scene"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)) as error:
        scene_of(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_no_text_or_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="no such file"):
        scene_of(tmp_path / "none.toml")
    (tmp_path / "s.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="holds no text"):
        scene_of(tmp_path / "s.json")
    (tmp_path / "t.json").write_text("[1]")
    with pytest.raises(InputError, match="a table of settings is needed"):
        scene_of(tmp_path / "t.json")


def test_an_unknown_preset_names_the_nearest_or_all_and_the_suffixes() -> None:
    with pytest.raises(InputError, match=r"did you mean 'flame'\?; a file ends in .toml or .json"):
        scene_of("flames")
    with pytest.raises(InputError, match="known: vortex, front, flame, bubble, shell"):
        scene_of("zzz")


def test_the_number_of_effects_is_limited() -> None:
    table = {"effect": "rotation"}
    assert len(scene_of({"effects": [table] * MAX_EFFECTS}).effects) == MAX_EFFECTS
    with pytest.raises(InputError, match="65 effects; allowed: 64"):
        scene_of({"effects": [table] * (MAX_EFFECTS + 1)})


def test_a_scene_without_a_paper_shape_says_which_have_one() -> None:
    with pytest.raises(InputError, match="flame, bubble, shell do"):
        scene_of("vortex").as_in_paper()


def test_the_document_has_every_setting_of_a_scene() -> None:
    text = DOCUMENT.read_text(encoding="utf-8").partition("## Settings of a scene")[2]
    rows = re.findall(
        r"^\| `(\w+)` \| [^|]* \| ([^|]*)\| ([^|]*) \|$", text.partition("## E")[0], re.M
    )
    limits = {
        setting.name: setting.metadata
        for setting in dataclasses.fields(SimulatedScene)
        if setting.name != "effects"
    }
    assert {name: help for name, _, help in rows} == {
        name: each["help"] for name, each in limits.items()
    }
    for name, allowed, _ in rows:
        low, high = limits[name]["low"], limits[name]["high"]
        assert allowed.strip() == ("" if low is None else f"{low:g} to {high:g}")


PAPER = {
    "flame": (54, 172, 200, 136),
    "bubble": (256, 128, 128, 241),
    "shell": (216, 216, 216, 136),
}
"""Vertices along z, y and x, and steps, of Table 2."""


@pytest.mark.parametrize("name", PAPER)
def test_paper_shapes_are_those_of_the_paper(name: str) -> None:
    scene = simulate(name).scene
    large = scene.as_in_paper()
    assert (*large.shape, large.steps) == PAPER[name]
    # Both shapes have the same proportions as the box, so that cells are cubes, about.
    for shape in (scene.shape, large.shape):
        cells = [length / count for length, count in zip(scene.size, shape, strict=True)]
        assert max(cells) < 1.05 * min(cells)


@pytest.mark.parametrize("name", PRESETS)
def test_something_happens_and_the_seed_changes_it(name: str) -> None:
    shape = (4, 12, 16, 14)
    first, again, other = (simulate(name, shape, seed) for seed in (0, 0, 1))
    for step in range(3):
        assert not np.array_equal(first.read(step), first.read(step + 1))
    np.testing.assert_array_equal(first.read(3), again.read(3))
    assert not np.array_equal(first.read(3), other.read(3))
