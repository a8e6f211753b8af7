"""Rules of prose that a program can hold: how docstrings begin, and one constant a statement."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(
    path
    for folder in ("fhash_codec", "formats/fhash_formats", "cli/fhash_cli", "tests")
    for path in (ROOT / folder).rglob("*.py")
)
NATIVE = sorted(
    path
    for folder in ("fhash_codec", "formats", "tests")
    for suffix in ("cpp", "hpp", "c")
    for path in (ROOT / folder).rglob(f"*.{suffix}")
    if "third_party" not in path.parts
)
HEADLESS = re.compile(
    r"\s*(Of|In|By|That|What|As|With|From|Where|When|How|Which|No|More|For|At|On|To|Than)\b"
)
"""Words that a docstring must not begin with: its subject would be missing, or stand elsewhere."""
OPENED = re.compile(r'^ *"""(\s*.+)', re.MULTILINE)
"""The first line of a docstring: of a module, a class or a function, or below a constant."""
MAX_COLUMNS = 100


def constants_together(tree: ast.Module) -> Iterator[ast.Assign]:
    """Statements that define several upper-case names at once, at the top level or in a class."""
    bodies = [tree.body, *(node.body for node in ast.walk(tree) if isinstance(node, ast.ClassDef))]
    for statement in (statement for body in bodies for statement in body):
        if not isinstance(statement, ast.Assign) or not isinstance(statement.value, ast.Tuple):
            continue
        for target in statement.targets:
            names = target.elts if isinstance(target, ast.Tuple) else []
            if any(isinstance(name, ast.Name) and name.id.isupper() for name in names):
                yield statement


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize(
    ("text", "headless"),
    [
        ("Of the range: a share.", True),
        ("\n    What the header says.", True),
        ("Bytes of a chunk.", False),
        ("Office hours.", False),
    ],
)
def test_headless_docstrings_are_recognised(text: str, headless: bool) -> None:
    assert bool(HEADLESS.match(text)) is headless


def test_docstrings_begin_with_their_subject() -> None:
    found = [
        f"{relative(path)}: {text.strip()}"
        for path in SOURCES
        for text in OPENED.findall(path.read_text(encoding="utf-8"))
        if HEADLESS.match(text)
    ]
    assert not found, "\n".join(found)


def test_constants_are_defined_one_at_a_time() -> None:
    found = [
        f"{relative(path)}:{statement.lineno}"
        for path in SOURCES
        if "tests" not in path.parts
        for statement in constants_together(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not found, "\n".join(found)


def test_native_sources_fit_into_the_columns() -> None:
    assert NATIVE
    found = [
        f"{relative(path)}:{number}"
        for path in NATIVE
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if len(line) > MAX_COLUMNS
    ]
    assert not found, "\n".join(found)
