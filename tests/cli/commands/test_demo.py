"""`fhash demo`."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from command_line import Fhash, Refused
from PIL import Image

import fhash_codec
from fhash_cli.commands.demo import SHAPE
from fhash_codec import gallery
from fhash_codec.gallery import PICTURES, commands, page
from fhash_codec.simulation.scene import PRESETS
from fhash_codec.simulation.simulate import Simulation

SMALL = ("--shape", "6,7,8", "--steps", "3", "-q")


@pytest.mark.parametrize(
    ("text", "shape"),
    [
        ("54,172,200", {"z": 54, "y": 172, "x": 200}),
        (" 1, 2 ,3", {"z": 1, "y": 2, "x": 3}),
        ("x=64,y=63,z=62", {"x": 64, "y": 63, "z": 62}),
        ("z=4,x=6,y=5,t=7", {"z": 4, "x": 6, "y": 5, "t": 7}),
    ],
)
def test_shapes_are_z_y_x_or_named(text: str, shape: dict[str, int]) -> None:
    assert SHAPE.convert(text, None, None) == shape


@pytest.mark.parametrize(
    "text", ["", "5", "5,6", "5,6,7,8", "5,6,-7", "5x6x7", "x=5,y=6", "a=1", "\uff15,6,7"]
)
def test_other_shapes_are_refused(text: str) -> None:
    with pytest.raises(click.BadParameter, match="is not Z,Y,X such as"):
        SHAPE.convert(text, None, None)


def test_a_file_of_a_scene_is_simulated_and_never_replaced(
    fhash: Fhash, refused: Refused, tmp_path: Path
) -> None:
    scene = tmp_path / "wake.json"
    scene.write_text(json.dumps({"name": "dye", "effects": [{"effect": "blob"}]}))
    result = fhash("demo", "--scene", scene, *SMALL, "-o", tmp_path / "wake.npy", "--explain")
    assert result.exit_code == 0, result.stderr
    assert "1 blob" in result.stdout
    assert "never made, cost nothing" in result.stdout
    assert np.load(tmp_path / "wake.npy").shape == (3, 6, 7, 8)
    (tmp_path / "same.npy").symlink_to(scene)
    message = refused(2, "demo", "--scene", scene, *SMALL, "-o", tmp_path / "same.npy", "--force")
    assert "is the input itself" in message
    scene.write_text('{"effects": [{"effect": "blub"}]}')
    message = refused(2, "demo", "--scene", scene, "-o", tmp_path / "other.npy")
    assert message.startswith(f"{scene}: effect 1 is 'blub'; did you mean 'blob'")


@pytest.mark.parametrize("suffix", ["npy", "h5", "zarr"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_an_interrupt_leaves_nothing(
    fhash: Fhash,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    suffix: str,
    error: type[BaseException],
) -> None:
    read = Simulation.read

    def broken(self: Simulation, step: int) -> Any:
        if step == 2:
            raise error
        return read(self, step)

    monkeypatch.setattr(Simulation, "read", broken)
    result = fhash("demo", *SMALL, "-o", tmp_path / f"run.{suffix}")
    assert result.exit_code == (130 if error is KeyboardInterrupt else 1)
    assert len(result.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_one_frame_is_read_before_the_next_is_computed(
    fhash: Fhash, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames come one by one: none is computed before the one before it is on its way to disk."""
    steps: list[int] = []
    read = Simulation.read
    monkeypatch.setattr(
        Simulation, "read", lambda self, step: steps.append(step) or read(self, step)
    )
    assert fhash("demo", *SMALL, "-o", tmp_path / "run.npy").exit_code == 0
    assert steps == [0, 1, 2]


PAGE = Path(__file__).resolve().parents[3] / "docs" / "gallery.md"
MAX_BYTES = 150_000


def test_the_page_in_docs_is_that_of_the_command() -> None:
    assert PAGE.read_text(encoding="utf-8") == page("gallery")
    for picture in PICTURES:
        path = PAGE.parent / "gallery" / f"{picture.name}.png"
        assert 1000 < path.stat().st_size < MAX_BYTES


def test_the_commands_of_the_page_give_its_pictures(
    fhash: Fhash, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (plane,) = (picture for picture in PICTURES if picture.name == "plane")
    words = list(plane.options)
    words[words.index("--size") + 1] = "256x160"
    small = replace(plane, options=tuple(words))
    monkeypatch.setattr(gallery, "PICTURES", (small,))
    monkeypatch.setattr(gallery, "GALLERY_SERIES", {"sea": gallery.GALLERY_SERIES["sea"]})
    folder = tmp_path / "g"
    made = fhash("demo", "--gallery", folder, "-q", "--json")
    assert made.exit_code == 0
    assert json.loads(made.stdout)["pictures"] == [str(folder / "plane.png")]
    assert (tmp_path / "g.md").read_text(encoding="utf-8") == page("g")
    again = fhash("demo", "--gallery", folder, "-q")
    assert again.exit_code == 2
    assert "--force" in again.stderr
    monkeypatch.chdir(folder / "series")
    encode, render = (shlex.split(line)[1:] for line in commands(small))
    assert encode == ["encode", "sea.h5", "-o", "sea.fhz", *gallery.GALLERY_SERIES["sea"].options]
    assert fhash(*render, "-q").exit_code == 0
    assert Path("plane.png").read_bytes() == (folder / "plane.png").read_bytes()


def test_a_folder_that_cannot_be_is_refused(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "give a folder" in refused(2, "demo", "--gallery", tmp_path / "file")


SMALL_DEMO = ("--shape", "8,10,12", "--steps", "5")


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Encoding with the least effort."""
    encode = fhash_codec.encode

    def encode_fast(*words: Any, **options: Any) -> dict[str, Any]:
        *files, config = words
        return encode(*files, replace(config, effort=1), **options)

    monkeypatch.setattr(fhash_codec, "encode", encode_fast)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("scene", PRESETS)
def test_demo_makes_data_container_and_picture(fhash: Fhash, tmp_path: Path, scene: str) -> None:
    folder = tmp_path / "demo"
    result = fhash("demo", "--scene", scene, *SMALL_DEMO, "-o", folder, "--json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert sorted(path.name for path in folder.iterdir()) == [
        f"{scene}.{suffix}" for suffix in ("fhz", "h5", "png")
    ]
    with Image.open(report["picture"]) as picture:
        assert 900 < picture.width < 1400
    again = json.loads(fhash("diff", report["data"], report["path"], "--json").stdout)
    assert [again[name] for name in ("psnr", "bytes", "max_abs_error")] == [
        report[name] for name in ("psnr", "bytes", "max_abs_error")
    ]
    assert (report["scene"], report["shape"]) == (scene, [5, 8, 10, 12])
    assert report["counters"]["frames"] == 5
    assert "explain" not in report


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--scene", "vortx"), "did you mean 'vortex'"),
        (("--scene", "none.toml"), "none.toml: no such file"),
        (("--shape", "3,4"), "is not Z,Y,X"),
        (("--shape", "0,4,5"), "shape is 0; allowed: 1 to 16384"),
        (("--shape", "z=4,y=5,x=6,t=7", "--steps", "3"), "--steps exclude each other"),
        (("--steps", "0"), "--steps"),
        (("--seed", "-1"), "--seed"),
        (("--shape", "paper"), "flame, bubble, shell do"),
        (("--shape", "paper", "--scene", "shell", "--steps", "3"), "--shape paper excludes"),
        (("--gallery", "g", "--steps", "3"), "--steps is for a scene"),
    ],
)
def test_unsuitable_words_are_refused_in_one_line(
    refused: Refused, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    assert message in refused(2, "demo", *words, "-o", tmp_path / "run.npy")
    if "--gallery" not in words:
        assert message in refused(2, "demo", *words, "-o", tmp_path / "demo")


def test_a_scene_with_a_wrong_feature_is_refused_before_it_is_simulated(
    refused: Refused, tmp_path: Path
) -> None:
    scene = tmp_path / "s.toml"
    scene.write_text('feature = "intervall:1:2"\n[[effects]]\neffect = "blob"\n')
    assert "intervall" in refused(2, "demo", "--scene", scene, "-o", tmp_path / "demo")
