"""Every command and every piece of Python of the README, word for word, on a fresh install."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from folders import Block, blocks
from fresh_install import fhash, run

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = blocks(ROOT / "README.md")
MAX_LINES = 120


def commands(block: Block) -> list[list[str]]:
    text = block.text.replace("\\\n", " ").replace("&&", "\n")
    lines = [shlex.split(line, comments=True) for line in text.splitlines()]
    return [line for line in lines if line]


def test_the_readme_is_short() -> None:
    assert README.count("\n") <= MAX_LINES


def test_every_block_is_python_or_commands() -> None:
    assert {block.language for block in BLOCKS} == {"sh", "python"}


def test_installs_name_extras_that_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = set(re.findall(r"fhash\[([a-z,]+)\]", README))
    assert {name for names in extras for name in names.split(",")} <= set(
        project["optional-dependencies"]
    )


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"\bmake (\w+)(?=`| )", README):
        assert re.search(rf"^([\w ]+ )?{target}\b[\w ]*:", makefile, flags=re.MULTILINE), target


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which a reader of the README types everything, in order."""
    return tmp_path_factory.mktemp("reader")


@pytest.mark.docs
@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: f"line {block.line}")
def test_what_the_readme_shows_runs(block: Block, site: Path, folder: Path) -> None:
    if block.language == "python":
        result = run(site, folder, "-W", "error", "-c", block.text)
        assert result.returncode == 0, result.stderr
        return
    for words in commands(block):
        if words[:2] == ["pip", "install"]:  # what the fixture `site` did
            assert words[2:] == ["."], words
        elif words[0] == "make":  # runs this test
            assert len(words) == 2, words
        else:
            assert words[0] == "fhash", words
            fhash(site, folder, *words[1:])
