"""Strings in these tests that name modules, functions and files of fhash name what exists.

A forked command line that waits for a function that was renamed would test nothing.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import mutations
import pytest
from fuzz import run
from test_faults_running import PLACES

import fhash_cli.main
from fhash_cli.output import Progress
from fhash_codec.paper.train import Breaks

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
DOTTED = re.compile(r"fhash_(?:codec|formats|cli)(?:\.\w+)*")
PATHS = re.compile(r"\b(?:fhash_codec|formats/fhash_formats|cli/fhash_cli|tests)/[\w/]+\.\w+")


def strings() -> Iterator[tuple[str, str]]:
    """The file and text of each string of the tests of this folder."""
    for path in sorted(HERE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield path.name, node.value


def test_modules_that_are_named_in_strings_exist() -> None:
    named = {(path, text) for path, text in strings() if DOTTED.fullmatch(text) and "." in text}
    assert len(named) > 15
    for path, name in named:
        assert importlib.util.find_spec(name) is not None, (path, name)


def test_files_that_are_named_in_texts_exist() -> None:
    sources = [path for kind in ("*.py", "*.cpp", "*.hpp") for path in HERE.rglob(kind)]
    named = {
        (path.name, name)
        for path in sources
        for name in PATHS.findall(path.read_text(encoding="utf-8"))
    }
    assert named
    for path, name in named:
        assert (ROOT / name).exists(), (path, name)


def test_functions_without_memory_exist() -> None:
    # All in one test: of cases, the quick set would run two.
    for _, module, name in PLACES:
        owner = importlib.import_module(module)
        for attribute in name.split("."):
            owner = getattr(owner, attribute)
        assert callable(owner)


def test_what_injections_replace_exists() -> None:
    assert callable(Progress.__call__)
    assert callable(fhash_cli.main.warn)
    assert "save_seconds" in inspect.signature(Breaks).parameters


def test_sources_of_the_fuzzer_exist() -> None:
    sources = [run.NATIVE / f"{name}.cpp" for name in run.SOURCES]
    sources += [run.CODEC / f"{name}.cpp" for name in (*run.CODEC_SOURCES, *run.MARCH)]
    for path in (*sources, *run.TARGETS):
        assert path.is_file(), path


@pytest.mark.hard
def test_seeds_of_the_fuzzer_are_written_of_every_golden(tmp_path: Path) -> None:
    run.prepare(tmp_path, every=40)
    assert any((tmp_path / "corpus").iterdir())


@pytest.mark.hard
def test_mutations_of_goldens_are_made() -> None:
    """A golden that a mutation cannot take would stop the long set after a quarter of an hour."""
    for number in range(0, 12_000, 10):
        assert mutations.mutation(number).data
