"""`fhash render`: pictures from the command line, their reports, and refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from PIL import Image as Pictures

import fhash_codec
from fhash_codec.rendering.scene.scene import scene_in_png
from fhash_codec.rendering.task.task import COUNTERS

Fhash = Callable[..., Result]


def test_a_picture_is_that_of_the_library(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    view = tmp_path / "view.png"
    words = [
        "--t",
        "1",
        "--size",
        "60x48",
        "--azimuth",
        "30",
        "--cmap",
        "plasma",
        "--effect",
        "shading",
        "--isosurface",
        "7,red,0.5",
    ]
    result = fhash("render", run, "-o", view, *words, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    said = json.loads(result.stdout)
    assert said["paths"] == [str(view)]
    assert (said["size"], said["step"], said["time"], said["march"]) == ([60, 48], 1, 1, "cache")
    assert list(said["counters"]) == list(COUNTERS)
    assert said["seconds"] > 0
    assert "plan" not in said
    scene = scene_in_png(view)
    assert scene.effects.isosurfaces[0].colour == "red"
    with fhash_codec.open(run) as volume:
        np.testing.assert_array_equal(
            np.asarray(Pictures.open(view)), fhash_codec.render(volume, scene).to_uint8()
        )


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
            "--size",
            "32",
            "--time",
            "0.5",
            "--effect",
            "shading",
            "--save-scene",
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
    result = fhash("render", run, "-o", view, "--explain", "--size", "24")
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
        "--size",
        "24x20",
        "--depth",
        "--normal",
        "--json",
        "--opacity",
        "5:0,6:0.9",
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
        (["--set", "efects.box=true"], "did you mean 'effects'"),
        (["--set", "size"], "PLACE=VALUE"),
        (["--set", "size.across=3"], "pixels across and down"),
        (["--view", "xz2"], "did you mean 'xz'"),
        (["--march", "gpu"], "allowed: auto"),
        (["--cmap", "virids"], "did you mean 'viridis'"),
        (["--opacity", "linar"], "did you mean 'linear'"),
        (["--opacity", "1:2:3"], "points [value, opacity]"),
        (["--opacity", "0:0,99:0"], "shows nothing"),
        (["--gradient-opacity", "0.1"], "points [gradient, factor 0..1]"),
        (["--gradient-opacity", "steep"], "not points such as"),
        (["--clip-box", "1:0,:,:"], "'1:0' ends before it begins"),
        (["--clip-box", ":,:,98:99"], "leaves nothing of the volume"),
        (["--clip-plane", "0,0,1"], "neither a normal and an offset"),
        (["--clip-plane", "0,0,0,1"], "the normal has no length"),
        (["--effect", "minimum-intensity", "--attenuation", "1"], "leave one of them"),
        (["--t", "3"], "outside the series"),
        (["--t", "-4"], "step is -1"),
        (["--time", "77"], "77"),
        (["--t", "1", "--time", "1"], "exclude each other"),
        (["--size", "0x5"], "size is 0"),
        (["--size", "99999x99999"], "size is 99999"),
        (["--size", "16384x16384"], "more than"),
        (["--size", "wide"], "not a size"),
        (["--zoom", "nan"], "zoom"),
        (["--position", "1,2"], "3 numbers"),
        (["--position", "1,2,3", "--focal-point", "1,2,3"], "are the same"),
        (["--view", "xy", "--view-up", "0,0,1"], "parallel to the direction of view"),
        (["--range", "5,4"], "must be below"),
        (["--isosurface", "high"], "write a value"),
        (["--no-volume"], "shows nothing"),
        (["--background", "wite"], "did you mean 'white'"),
        (["--lod", "11"], "lod is 11"),
        (["--scene", "missing.toml"], "no such scene"),
        (["--save-scene", "s.toml"], "written as .json"),
    ],
)
def test_a_bad_scene_is_one_line_and_nothing_is_written(
    refused: Callable[..., str], run: Path, tmp_path: Path, words: list[str], said: str
) -> None:
    assert said in refused(2, "render", run, "-o", tmp_path / "view.png", *words)


def test_outputs_are_checked_before_any_work(
    refused: Callable[..., str], run: Path, tmp_path: Path
) -> None:
    (tmp_path / "view.png").write_bytes(b"mine")
    assert "--force" in refused(2, "render", run, "-o", tmp_path / "view.png")
    assert ".png" in refused(2, "render", run, "-o", tmp_path / "view.gif")
    assert "does not exist" in refused(2, "render", run, "-o", tmp_path / "no" / "view.png")
    (tmp_path / "v.depth.npy").write_bytes(b"mine")
    assert "--force" in refused(2, "render", run, "-o", tmp_path / "v.png", "--depth")
    (tmp_path / "run.png").write_bytes(run.read_bytes())
    assert "input itself" in refused(
        2, "render", tmp_path / "run.png", "-o", tmp_path / "run.png", "--force"
    )


def test_a_file_that_is_missing_or_damaged_keeps_its_exit_code(
    refused: Callable[..., str], tmp_path: Path
) -> None:
    assert "no such" in refused(2, "render", tmp_path / "none.fhz", "-o", tmp_path / "v.png")
    (tmp_path / "bad.fhz").write_bytes(b"not a container")
    refused(4, "render", tmp_path / "bad.fhz", "-o", tmp_path / "v.png")


def test_an_evolution_is_replayed_from_its_picture(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    first, second, single = (tmp_path / name for name in ("a.png", "b.png", "c.png"))
    for words in (
        ["-o", first, "--size", "32", "--evolution", ":", "--columns", "2"],
        ["-o", second, "--scene", first],
        ["-o", single, "--scene", first, "--t", "1"],
    ):
        assert fhash("render", run, *words).exit_code == 0
    assert first.read_bytes() == second.read_bytes()
    with Pictures.open(first) as whole, Pictures.open(single) as one:
        assert (whole.size, one.size) == ((65, 65), (32, 32))
    refused = fhash("render", run, "-o", tmp_path / "d.png", "--scene", first, "--explain")
    assert refused.exit_code == 2
    assert "--explain" in refused.stderr


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


def test_tracked_features_have_a_box_and_a_legend(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    view = tmp_path / "v.png"
    words = ["--size", "80x60", "--track", "interval:5:20", "--track", "isosurface:3=red"]
    assert fhash("render", run, "-o", view, *words).exit_code == 0
    effects = scene_in_png(view).effects
    assert effects.box
    assert [entry.text for entry in effects.legend] == [
        "density: 5 to 20 kg m-3",
        "density = 3 kg m-3",
    ]
    panels = tmp_path / "p.jpg"
    assert fhash("render", run, "-o", panels, *words, "--evolution", "0:3").exit_code == 0
    with Pictures.open(panels) as picture:
        assert picture.height > 60
