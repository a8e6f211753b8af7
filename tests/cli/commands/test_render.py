"""`fhash render`."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import click
import numpy as np
import pytest
from click.testing import CliRunner
from command_line import Fhash, Refused
from PIL import Image as Pictures

import fhash_codec
from fhash_cli.commands.render import (
    PLANE,
    SETTINGS,
    SIZE,
    SceneOptions,
    numbers_type,
    opacity_type,
    scene_options,
)
from fhash_codec.rendering.scenes import Scene, scene_in_png
from fhash_formats.errors import InputError


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        (numbers_type(2), "1,2.5", (1.0, 2.5)),
        (SIZE, "800x600", (800, 600)),
        (SIZE, "64", (64, 64)),
        (opacity_type(), "linear", "linear"),
        (opacity_type(), "0:0,2:1", [[0.0, 0.0], [2.0, 1.0]]),
        (opacity_type(named=False), "0.1:1", [[0.1, 1.0]]),
        (PLANE, "0,0,1,0.5", {"normal": [0.0, 0.0, 1.0], "offset": 0.5}),
        (PLANE, "1,2,3,0,0,-1", {"point": [1.0, 2.0, 3.0], "normal": [0.0, 0.0, -1.0]}),
    ],
)
def test_texts_are_read(kind: click.ParamType[Any], text: str, value: Any) -> None:
    assert kind.convert(text, None, None) == value


@pytest.mark.parametrize(
    ("kind", "text", "part"),
    [
        (numbers_type(3), "1,2", "not 3 numbers"),
        (SIZE, "wide", "not a size"),
        (opacity_type(), "0:a", "neither the name of an opacity nor points"),
        (opacity_type(named=False), "linear", "not points"),
        (PLANE, "0,0,1", "neither a normal and an offset"),
        (PLANE, "a,b,c,d", "neither a normal and an offset"),
    ],
)
def test_other_texts_are_refused(kind: click.ParamType[Any], text: str, part: str) -> None:
    with pytest.raises(click.BadParameter, match=part):
        kind.convert(text, None, None)


VOLUME = cast(fhash_codec.Volume, SimpleNamespace(shape=(5, 2, 3, 4)))


def scene(
    file: str | None = None,
    places: dict[str, object] | None = None,
    effects: tuple[str, ...] = (),
    isosurfaces: tuple[str, ...] = (),
    settings: tuple[str, ...] = (),
) -> Scene:
    options = SceneOptions(
        file=file, places=places or {}, effects=effects, isosurfaces=isosurfaces, settings=settings
    )
    return options.scene(VOLUME)


@pytest.mark.parametrize("place", sorted({setting.place for setting in SETTINGS} - {"step"}))
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


def test_clips_and_gradients_are_put_where_a_scene_has_them() -> None:
    found: list[Scene] = []

    @click.command()
    @scene_options
    def command(options: SceneOptions) -> None:
        found.append(options.scene(VOLUME))

    def parsed(*words: str) -> dict[str, object]:
        done = CliRunner().invoke(
            command, ["--bare", *words], standalone_mode=False, catch_exceptions=False
        )
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
    assert parsed("--gradient-opacity", "0:0,0.1:1") == {
        "transfer_function": {"gradient_opacity": [[0.0, 0.0], [0.1, 1.0]]}
    }
    assert parsed("--effect", "average-intensity") == {"effects": {"average_intensity": True}}
    with pytest.raises(InputError, match="effect 'clip' is not known"):
        parsed("--effect", "clip")


SMALL = ("--size", "24x18", "-q")


def test_numbered_pictures_go_on(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    words = ["render", run, "-o", tmp_path / "a.png", "--animate", "steps,orbit=90", *SMALL]
    first = json.loads(fhash(*words, "--frames", "4", "--json").stdout)
    assert [Path(path).name for path in first["paths"]] == [f"a.000{n}.png" for n in range(4)]
    assert (first["rendered"], first["kept"]) == (4, 0)
    assert first["counters"]["rays"] > 0
    (tmp_path / "a.0002.png").unlink()
    assert "1 rendered, 3 kept" in fhash(*words, "--frames", "4").stdout
    scenes = [scene_in_png(path) for path in sorted(tmp_path.glob("*.png"))]
    assert [scene.camera.azimuth for scene in scenes] == [0, 30, 60, 90]
    assert [scene.step for scene in scenes] == pytest.approx([0, 2 / 3, 4 / 3, 2])


def test_a_film_and_its_pictures(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    words = ["--animate", "orbit", "--frames", "3", "--fps", "5", "--pictures", tmp_path / "p.png"]
    result = fhash("render", run, "-o", tmp_path / "a.gif", *words, *SMALL)
    assert result.exit_code == 0, result.stderr
    with Pictures.open(tmp_path / "a.gif") as picture:
        assert picture.info["duration"] == 200
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["a.gif", "p.0000.png", "p.0001.png", "p.0002.png"]


def test_an_evolution_with_features(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    words = ["render", run, "-o", tmp_path / "a.png", "--evolution", "::2", "--columns", "2"]
    words += ["--track", "interval:6:8=#ff0000", "--track", "isosurface:9", *SMALL]
    found = json.loads(fhash(*words, "--json").stdout)
    assert found["steps"] == [0, 2]
    with Pictures.open(tmp_path / "a.png") as picture:
        assert picture.width >= 24 * 2 + 1
    tracked = found["tracked"]
    assert [entry["feature"] for entry in tracked] == ["interval:6:8", "isosurface:9"]
    assert all(place["vertices"] > 0 for entry in tracked for place in entry["steps"])
    assert "interval:6:8" in fhash(*words, "--force").stdout


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["-o", "{}/a.png", "--animate", "steps", "--evolution", ":"], "exclude"),
        (["-o", "{}/a.png", "--frames", "3"], "--animate"),
        (["-o", "{}/a.png", "--columns", "3"], "--evolution"),
        (["-o", "{}/a.mpg", "--animate", "orbit"], ".mp4"),
        (["-o", "{}/a.gif", "--evolution", ":"], ".png"),
        (["-o", "{}/a.png", "--animate", "steps=0:9"], "outside"),
        (["-o", "{}/a.png", "--animate", "{}/none.toml"], "no such animation"),
        (["-o", "{}/a.png", "--evolution", "7:9"], "steps 0 to 2"),
        (["-o", "{}/a.png", "--animate", "orbit", "--track", "blob:3"], "not known"),
        (
            ["-o", "{}/a.png", "--animate", "orbit", "--track", "own", "--track", "isosurface:8"],
            "own",
        ),
        (["-o", "{}/no/a.png", "--animate", "orbit"], "does not exist"),
        (["-o", "{}/a.gif", "--animate", "orbit", "--pictures", "{}/no/a.png"], "does not exist"),
    ],
)
def test_one_line_and_nothing_written(
    refused: Refused, words: list[str], part: str, run: Path, tmp_path: Path
) -> None:
    line = refused(2, "render", run, *SMALL, *(word.format(tmp_path) for word in words))
    assert part in line


def test_a_picture_without_ink_says_so_and_the_step_is_told(fhash: Fhash, tmp_path: Path) -> None:
    values = np.full((3, 10, 10, 10), 3, np.float32)
    fhash_codec.encode(values, tmp_path / "flat.fhz", fhash_codec.EncodeConfig(effort=1))
    words = ("-o", tmp_path / "a.png", "--size", "20", "--force")
    empty = fhash("render", tmp_path / "flat.fhz", *words, "-q")
    assert (empty.exit_code, len(empty.stderr.splitlines())) == (0, 1)
    assert "0.00% of the picture's pixels" in empty.stderr
    assert "all values are 3" in empty.stderr
    values[1, 2:6, 2:6, 2:6] = 5
    fhash_codec.encode(values, tmp_path / "box.fhz", fhash_codec.EncodeConfig(effort=1))
    drawn = fhash("render", tmp_path / "box.fhz", *words, "-q")
    assert (drawn.exit_code, drawn.stderr) == (0, "")
    assert "1, t = 1, of five steps the one of most structure" in drawn.stdout
    first = fhash("render", tmp_path / "box.fhz", *words, "-q", "--t", "0", "--effect", "box")
    assert "at step 0: another step" in first.stderr
    assert "five steps" not in first.stdout


def test_a_picture_is_replayed_and_changed(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    first, again, scene, changed = (
        tmp_path / name for name in ("a.png", "b.png", "s.json", "c.png")
    )
    assert (
        fhash(
            "render",
            run,
            "-o",
            first,
            *["--size", "32", "--time", "0.5", "--effect", "shading", "--save-scene"],
            scene,
        ).exit_code
        == 0
    )
    for source in (first, scene, again):
        assert fhash("render", run, "-o", again, "--scene", source, "--force").exit_code == 0
        assert again.read_bytes() == first.read_bytes()
    words = [
        "--t",
        "-1",
        "--set",
        "effects.shading=false",
        "--set",
        "camera.zoom=2",
        "--effect",
        "time-label",
    ]
    assert fhash("render", run, "-o", changed, "--scene", first, *words).exit_code == 0
    found = scene_in_png(changed)
    assert (
        found.step,
        found.time,
        found.effects.shading,
        found.camera.zoom,
        found.effects.time_label,
    ) == (2, None, None, 2, True)


def test_explain_says_what_is_done_and_what_it_took(
    fhash: Fhash, run: Path, tmp_path: Path
) -> None:
    view = tmp_path / "v.png"
    result = fhash("render", run, "-o", view, "--bare", "--explain", "--size", "24")
    assert result.exit_code == 0
    assert "none: no effect asks for it" in result.stdout
    assert "evaluations" in result.stdout
    plan = json.loads(
        fhash("render", run, "-o", view, "--explain", "--json", "--size", "24", "--force").stdout
    )["plan"]
    assert plan["march"].startswith("cache")


def test_buffers_stand_beside_the_picture(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    result = fhash(
        "render",
        run,
        "-o",
        tmp_path / "v.png",
        *[
            "--size",
            "24x20",
            "--buffer",
            "depth",
            "--buffer",
            "normal",
            "--json",
            "--opacity",
            "5:0,6:0.9",
        ],
    )
    assert result.exit_code == 0, result.stderr
    names = [Path(path).name for path in json.loads(result.stdout)["paths"]]
    assert names == ["v.depth.npy", "v.normal.npy", "v.png"]
    assert np.load(tmp_path / "v.depth.npy").shape == (20, 24)
    assert np.isfinite(np.load(tmp_path / "v.depth.npy")).any()


def test_without_a_name_the_picture_is_called_as_the_run(
    fhash: Fhash, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert fhash("render", run, "--size", "16").exit_code == 0
    assert (tmp_path / "tiny.png").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--effect", "shadng"], "did you mean 'shading'"),
        (["--set", "effects.shading.ambiet=1"], "did you mean 'ambient'"),
        (["--set", "size"], "PLACE=VALUE"),
        (["--march", "gpu"], "allowed: auto"),
        (["--opacity", "0:0,99:0"], "shows nothing"),
        (["--gradient-opacity", "0.1"], "points [gradient, factor 0..1]"),
        (["--clip-box", "1:0,:,:"], "the first end must be below the second"),
        (["--clip-plane", "0,0,1"], "neither a normal and an offset"),
        (
            ["--effect", "minimum-intensity", "--set", "effects.maximum_intensity=true"],
            "leave one of them",
        ),
        (["--t", "3"], "outside the series"),
        (["--t", "-4"], "step is -1"),
        (["--time", "77"], "77"),
        (["--t", "1", "--time", "1"], "exclude each other"),
        (["--size", "0x5"], "size is 0"),
        (["--zoom", "nan"], "zoom"),
        (["--position", "1,2,3", "--focal-point", "1,2,3"], "are the same"),
        (["--view", "xy", "--view-up", "0,0,1"], "parallel to the direction of view"),
        (["--scene", "missing.toml"], "no such scene"),
        (["--save-scene", "s.toml"], "written as .json"),
    ],
)
def test_a_bad_scene_is_one_line_and_nothing_is_written(
    refused: Refused, run: Path, tmp_path: Path, words: list[str], said: str
) -> None:
    assert said in refused(2, "render", run, "-o", tmp_path / "view.png", *words)


def test_a_jpeg_says_where_its_scene_may_stay(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    words = ["render", run, "-o", tmp_path / "v.jpg", "--size", "40x30"]
    result = fhash(*words)
    assert result.exit_code == 0
    assert "not in a JPEG; --save-scene FILE.json keeps it" in result.stdout
    with Pictures.open(tmp_path / "v.jpg") as picture:
        assert (picture.format, picture.size) == ("JPEG", (40, 30))
    clear = fhash(*words, "--background", "transparent", "--force")
    assert clear.exit_code == 2
    assert "cannot be transparent" in clear.stderr
    other = fhash("render", run, "-o", tmp_path / "v.gif")
    assert ".png, .jpg or .jpeg" in other.stderr
