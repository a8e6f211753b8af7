"""The gallery: pictures and a page with commands that give the same again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import Result

from fhash_cli import gallery
from fhash_cli.gallery import commands, page
from fhash_codec.demo.gallery import PICTURES

Fhash = Callable[..., Result]
PAGE = Path(__file__).resolve().parents[2] / "docs" / "gallery.md"
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


def test_a_folder_that_cannot_be_is_refused(refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "give a folder" in refused(2, "demo", "--gallery", tmp_path / "file")
