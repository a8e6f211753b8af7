"""Options of a scene: each sets its place, over a scene that a file gives."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import click
import pytest
from click.testing import CliRunner

import fhash_codec
from fhash_cli.scene_options import PLACES, SceneOptions, scene_options
from fhash_codec.rendering.scene.scene import Scene
from fhash_formats.errors import InputError

VOLUME = cast(fhash_codec.Volume, SimpleNamespace(shape=(5, 2, 3, 4)))


def scene(
    file: str | None = None,
    places: dict[str, object] | None = None,
    effects: tuple[str, ...] = (),
    isosurfaces: tuple[str, ...] = (),
    settings: tuple[str, ...] = (),
) -> Scene:
    options = SceneOptions(
        file=file,
        places=places or {},
        effects=effects,
        isosurfaces=isosurfaces,
        settings=settings,
    )
    return options.scene(VOLUME)


def test_without_options_it_is_the_default_scene() -> None:
    assert scene() == Scene()


@pytest.mark.parametrize("place", sorted(set(PLACES.values()) - {"step"}))
def test_every_option_sets_a_place_that_a_scene_has(place: str) -> None:
    with pytest.raises(InputError) as refused:
        scene(places={place: object()})
    assert place.split(".")[-1] in str(refused.value)
    assert "did you mean" not in str(refused.value)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("camera.azimuth=x", r"^camera\.azimuth is 'x'; a number from .* is needed: .*degrees"),
        ("camera.zoom=-1", r"^camera\.zoom is -1; allowed: "),
        ("effects.shading.gradient=cel", r"^effects\.shading\.gradient is 'cel'; .*'cell'\?$"),
        ("camera.position=[1,2]", r"^camera\.position is \[1, 2\]; a list of 3, each a number,"),
    ],
)
def test_a_setting_that_is_refused_is_named_with_what_it_takes(setting: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        scene(settings=(setting,))


def test_a_negative_step_counts_from_the_end() -> None:
    assert scene(places={"step": -1.0}).step == 4


def test_options_replace_parts_of_the_scene_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "scene.json"
    file.write_text(json.dumps({"time": 2.0, "camera": {"view": "xy", "zoom": 3.0}}))
    changed = scene(file=str(file), places={"step": 1.0, "camera.zoom": 2.0})
    assert (changed.step, changed.time) == (1.0, None)
    assert (changed.camera.view, changed.camera.zoom) == ("xy", 2.0)


def test_effects_surfaces_and_settings_add_up() -> None:
    shown = scene(
        effects=("ambient-occlusion", "shading"),
        isosurfaces=("1.5,orange,0.5", "2"),
        settings=("effects.shading.ambient=0.3",),
    )
    assert shown.effects.ambient_occlusion is not None
    assert shown.effects.shading is not None
    assert shown.effects.shading.ambient == 0.3
    surfaces = shown.effects.isosurfaces
    assert [(surface.value, surface.opacity) for surface in surfaces] == [(1.5, 0.5), (2.0, 1.0)]


def test_an_unknown_effect_names_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean 'shadows'"):
        scene(effects=("shadow",))


def test_clips_and_gradients_are_put_where_a_scene_has_them() -> None:
    found: list[Scene] = []

    @click.command()
    @scene_options
    def command(options: SceneOptions) -> None:
        found.append(options.scene(VOLUME))

    def parsed(*words: str) -> dict[str, object]:
        done = CliRunner().invoke(command, words, standalone_mode=False, catch_exceptions=False)
        assert done.exit_code == 0
        return found[-1].to_dict()

    planes = [
        {"normal": [-1.0, 0.0, 0.0], "offset": -12.0},
        {"normal": [0.0, 1.0, 1.0], "point": [1.0, 2.0, 3.0]},
    ]
    words = ("--clip-plane", "-1,0,0,-12", "--clip-plane", "1,2,3,0,1,1")
    assert parsed(*words) == {"effects": {"clip": {"planes": planes}}}
    assert parsed(*words, "--clip-box", ":,-2:0,:5") == {
        "effects": {"clip": {"y": [-2.0, 0.0], "x": [None, 5.0], "planes": planes}}
    }
    assert parsed("--gradient-opacity", "0:0,0.1:1", "--attenuation", "0.2") == {
        "transfer_function": {"gradient_opacity": [[0.0, 0.0], [0.1, 1.0]]},
        "effects": {"attenuated_maximum_intensity": {"attenuation": 0.2}},
    }
    assert parsed("--effect", "average-intensity") == {"effects": {"average_intensity": True}}
    with pytest.raises(InputError, match="effect 'clip' is not known"):
        parsed("--effect", "clip")
