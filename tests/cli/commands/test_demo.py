"""`fhash demo`: three files that agree with the figures it prints."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from PIL import Image

import fhash_codec
from fhash_codec.simulation.presets import PRESETS

Fhash = Callable[..., Result]


SMALL = ("--shape", "8,10,12", "--steps", "5")


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
    result = fhash("demo", "--scene", scene, *SMALL, "-o", folder, "--json", "-q")
    assert (result.exit_code, result.stderr) == (0, "")
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


@pytest.mark.usefixtures("small")
def test_demo_keeps_files_that_exist_and_explains_where_asked(fhash: Fhash, tmp_path: Path) -> None:
    words = ("demo", "--shape", "5,6,7", "--steps", "2", "-o", tmp_path / "demo", "-q")
    first = fhash(*words)
    assert first.stdout.startswith("data")
    assert "never made" not in first.stdout
    assert fhash(*words).exit_code == 2
    again = fhash(*words, "--force", "--explain")
    assert "never made, cost nothing" in again.stdout


@pytest.mark.usefixtures("small")
def test_a_file_of_a_scene_gives_the_files_their_name(fhash: Fhash, tmp_path: Path) -> None:
    scene = tmp_path / "wake.toml"
    scene.write_text('feature = "interval:0.5:2"\n[[effects]]\neffect = "blob"\n')
    result = fhash("demo", "--scene", scene, *SMALL, "-o", tmp_path, "-q", "--json", "--explain")
    assert result.exit_code == 0, result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"wake.{suffix}" for suffix in ("fhz", "h5", "png", "toml")
    ]
    report = json.loads(result.stdout)
    assert report["settings"] == "--feature interval:0.5:2"
    assert ["1 blob", "computed: adds its value inside its surface"] in report["explain"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--scene", "vortx"), "did you mean 'vortex'"),
        (("--scene", "none.toml"), "none.toml: no such file"),
        (("--shape", "3,4"), "is not Z,Y,X"),
        (("--shape", "0,4,5"), "shape is 0; allowed: 1 to 16384"),
        (("--steps", "0"), "--steps"),
        (("--seed", "-1"), "--seed"),
        (("--paper-shape",), "flame, bubble, shell do"),
        (("--paper-shape", "--scene", "shell", "--steps", "3"), "--paper-shape excludes"),
        (("--gallery", "g", "--steps", "3"), "--steps is for a scene"),
    ],
)
def test_unsuitable_words_are_refused_in_one_line(
    refused: Callable[..., str], tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    assert message in refused(2, "demo", *words, "-o", tmp_path / "run.npy")
    if "--gallery" not in words:
        assert message in refused(2, "demo", *words, "-o", tmp_path / "demo")


def test_a_scene_with_a_wrong_feature_is_refused_before_it_is_simulated(
    refused: Callable[..., str], tmp_path: Path
) -> None:
    scene = tmp_path / "s.toml"
    scene.write_text('feature = "intervall:1:2"\n[[effects]]\neffect = "blob"\n')
    assert "intervall" in refused(2, "demo", "--scene", scene, "-o", tmp_path / "demo")


def test_demo_in_a_folder_that_cannot_be_is_refused(
    refused: Callable[..., str], tmp_path: Path
) -> None:
    assert "No such file or directory" in refused(2, "demo", "-o", tmp_path / "no" / "demo")
    (tmp_path / "file").write_text("")
    refused(2, "demo", "-o", tmp_path / "file")


def test_outputs_that_are_one_file_are_refused(refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "vortex.png").symlink_to(tmp_path / "vortex.h5")
    assert "is the input itself" in refused(2, "demo", "-o", tmp_path, "--force")
