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
from fhash_cli.commands import demo
from fhash_codec.demo.simulate import SCENES

Fhash = Callable[..., Result]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of a small shape, encoded with the least effort."""
    simulate, encode = demo.simulate, fhash_codec.encode

    def encode_fast(*words: Any, **options: Any) -> dict[str, Any]:
        *files, config = words
        return encode(*files, replace(config, effort=1), **options)

    monkeypatch.setattr(demo, "simulate", lambda name: simulate(name, (5, 8, 10, 12)))
    monkeypatch.setattr(fhash_codec, "encode", encode_fast)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("scene", SCENES)
def test_demo_makes_data_container_and_picture(fhash: Fhash, tmp_path: Path, scene: str) -> None:
    folder = tmp_path / "demo"
    result = fhash("demo", "--scene", scene, "-o", folder, "--json", "-q")
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
    assert fhash("demo", "--scene", scene, "-o", folder).exit_code == 2
    assert fhash("demo", "--scene", scene, "-o", folder, "--force", "-q").stdout.startswith("data")


def test_demo_in_a_folder_that_cannot_be_is_refused(
    refused: Callable[..., str], tmp_path: Path
) -> None:
    assert "No such file or directory" in refused(2, "demo", "-o", tmp_path / "no" / "demo")
    (tmp_path / "file").write_text("")
    refused(2, "demo", "-o", tmp_path / "file")


def test_outputs_that_are_one_file_are_refused(refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "vortex.png").symlink_to(tmp_path / "vortex.h5")
    assert "is the input itself" in refused(2, "demo", "-o", tmp_path, "--force")
