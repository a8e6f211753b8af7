"""Pages have the figures of benchmarks/results, and tables of figures from nowhere else."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from fhash_bench import results
from fhash_bench.results import MARK, RESULTS, ROOT, filled, pages

OTHERS = ("stability.md", "gallery.md", "json.md")
"""Pages that other programs write, and that with the table of exit codes."""
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
FIGURE = re.compile(r"[-+<~]?\d")


def typed(text: str) -> list[str]:
    """Tables of figures outside marks: more than half of the cells right of the first column begin
    with a digit."""
    found = []
    for table in TABLE.findall(MARK.sub("", text)):
        rows = [row.split("|")[2:-1] for row in table.splitlines()[2:]]
        cells = [cell.strip() for row in rows for cell in row]
        if sum(FIGURE.match(cell) is not None for cell in cells) > len(cells) / 2:
            found.append(table)
    return found


@pytest.mark.parametrize("page", pages(), ids=lambda path: path.name)
def test_a_page_is_up_to_date(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert filled(text) == text, "call `make results`"
    assert text.count("<!-- result:") == text.count("<!-- end -->") == len(MARK.findall(text))


@pytest.mark.parametrize("page", pages(), ids=lambda path: path.name)
def test_figures_are_typed_nowhere(page: Path) -> None:
    if page.name not in OTHERS:
        assert not typed(page.read_text(encoding="utf-8"))


def test_sentences_of_the_results_have_no_typed_figure() -> None:
    """Numbers with a fraction are measured; whole ones may be settings, such as 50 dB."""
    (page,) = (path for path in pages() if path.name == "results.md")
    text = re.sub(r"`[^`]*`", "", MARK.sub("", page.read_text(encoding="utf-8")))
    assert not re.findall(r".*\d[.,]\d.*", text)


def test_every_result_is_shown_and_says_where_it_is_from() -> None:
    shown = {mark[0] for page in pages() for mark in MARK.findall(page.read_text(encoding="utf-8"))}
    files = sorted(RESULTS.glob("*.json"))
    assert shown == {path.stem for path in files}
    for path in files:
        machine = json.loads(path.read_text(encoding="utf-8"))["machine"]
        assert {"command", "date", "processor"} <= machine.keys(), path.name


def test_a_table_that_is_typed_is_found() -> None:
    table = "| size | dB |\n|---|---|\n| a | 1,024 |\n"
    assert typed(table) == [table]
    assert not typed(f"<!-- result: a -->\n{table}<!-- end -->")
    assert not typed("| option | default |\n|---|---|\n| a | none |\n")


def test_marks_are_filled_from_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    record = {"command": "fhash x", "date": "2026-11-28", "processor": "a", "threads": 2, "load": 1}
    table = {"columns": ["a", "b"], "rows": [["c", 1024], [None, 0.5]]}
    document = {"machine": record, **table, "facts": {"gain": "2 dB", "small": table}}
    (tmp_path / "a-b.json").write_text(json.dumps(document))
    lines = "\n| a | b |\n|---|---|\n| c | 1,024 |\n|  | 0.5 |\n"
    where = "\n`fhash x`, 2026-11-28, a, 2 threads, load 1.\n"
    for key, inside in {
        "a-b": lines + where,
        "a-b.gain": "2 dB",
        "a-b.small": lines,
        "a-b.command": "`fhash x`",
    }.items():
        text = f"before <!-- result: {key} -->old<!-- end --> after"
        assert filled(text) == text.replace("old", inside)
    with pytest.raises(KeyError, match="gone"):
        filled("<!-- result: a-b.gone --><!-- end -->")
    with pytest.raises(FileNotFoundError):
        filled("<!-- result: gone --><!-- end -->")
    assert ROOT in RESULTS.parents
