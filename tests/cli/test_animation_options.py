"""Options for several pictures: values, options that exclude each other, and outputs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from PIL import Image as Pictures

import fhash_codec
from fhash_cli.animation_options import (
    AnimationOptions,
    add_animation_options,
    run_animation,
    tracking,
)
from fhash_cli.main import Program
from fhash_cli.options import run_argument
from fhash_cli.output import Progress
from fhash_codec.rendering.scene.scene import Scene, scene_in_png

SMALL = Scene(size=(24, 18))


@click.group(cls=Program)
def program() -> None:
    """A stand-in for fhash."""


@click.command("render")
@run_argument
@click.option("-o", "output", required=True)
@click.option("--force", is_flag=True)
@add_animation_options
def render(run: str, output: str, force: bool, several: AnimationOptions) -> None:
    """A stand-in for `fhash render`."""
    with fhash_codec.open(run) as volume, Progress(quiet=True) as progress:
        scene = several.over(SMALL, volume)
        if several.several(scene):
            result, text = run_animation(
                volume, scene, several, output, force=force, progress=progress
            )
        else:
            result, text = tracking(volume, SMALL, several, progress).to_dict(), ""
    click.echo(json.dumps({"result": result, "text": text}))


class OneCommand(Program):
    """Program with the command above."""

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        return render if name == "render" else None


def invoke(*words: object) -> Result:
    group = OneCommand("fhash")
    return CliRunner().invoke(group, ["render", *map(str, words)], prog_name="fhash")


def done(*words: object) -> dict[str, Any]:
    result = invoke(*words)
    assert result.exit_code == 0, result.stderr
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def test_numbered_pictures_go_on(run: Path, tmp_path: Path) -> None:
    words = (run, "-o", tmp_path / "a.png", "--animate", "steps,orbit=90", "--frames", "4")
    first = done(*words)
    assert [Path(path).name for path in first["result"]["paths"]] == [
        f"a.000{number}.png" for number in range(4)
    ]
    assert (first["result"]["rendered"], first["result"]["kept"]) == (4, 0)
    assert first["result"]["counters"]["rays"] > 0
    (tmp_path / "a.0002.png").unlink()
    again = done(*words)
    assert (again["result"]["rendered"], again["result"]["kept"]) == (1, 3)
    assert "1 rendered, 3 kept" in again["text"]
    scenes = [scene_in_png(path) for path in sorted(tmp_path.glob("*.png"))]
    assert [scene.camera.azimuth for scene in scenes] == [0, 30, 60, 90]
    assert [scene.step for scene in scenes] == pytest.approx([0, 2 / 3, 4 / 3, 2])


def test_a_film_and_its_pictures(run: Path, tmp_path: Path) -> None:
    done(
        run,
        "-o",
        tmp_path / "a.gif",
        "--animate",
        "orbit",
        "--frames",
        "3",
        "--fps",
        "5",
        "--pictures",
        tmp_path / "p.png",
    )
    with Pictures.open(tmp_path / "a.gif") as picture:
        assert picture.info["duration"] == 200
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.gif",
        "p.0000.png",
        "p.0001.png",
        "p.0002.png",
    ]


def test_an_evolution_with_features(run: Path, tmp_path: Path) -> None:
    found = done(
        run,
        "-o",
        tmp_path / "a.png",
        "--evolution",
        "::2",
        "--columns",
        "2",
        "--track",
        "interval:6:8=#ff0000",
        "--track",
        "isosurface:9",
    )
    assert found["result"]["steps"] == [0, 2]
    with Pictures.open(tmp_path / "a.png") as picture:
        assert picture.size == (24 * 2 + 1, 18)
    tracked = found["result"]["tracked"]
    assert [entry["feature"] for entry in tracked] == ["interval:6:8", "isosurface:9"]
    assert all(place["vertices"] > 0 for entry in tracked for place in entry["steps"])
    assert "interval:6:8" in found["text"]


def test_a_single_picture_of_the_features_of_the_file(run: Path, tmp_path: Path) -> None:
    scene = Scene.from_dict(done(run, "-o", tmp_path / "a.png", "--track", "own")["result"])
    assert {colour for _, colour in scene.transfer_function.colours} == {"#d55e00"}  # type: ignore[misc, str-unpack]
    assert Scene.from_dict(done(run, "-o", tmp_path / "a.png")["result"]) == SMALL


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
    words: list[str], part: str, run: Path, tmp_path: Path
) -> None:
    result = invoke(run, *(word.format(tmp_path) for word in words))
    assert result.exit_code == 2
    assert part in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_is_there_is_refused(run: Path, tmp_path: Path) -> None:
    (tmp_path / "a.gif").write_bytes(b"mine")
    words = (run, "-o", tmp_path / "a.gif", "--animate", "orbit", "--frames", "2")
    refused = invoke(*words)
    assert refused.exit_code == 2
    assert "--force" in refused.stderr
    assert (tmp_path / "a.gif").read_bytes() == b"mine"
    done(*words, "--force")
    assert (tmp_path / "a.gif").read_bytes().startswith(b"GIF")
