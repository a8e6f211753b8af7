"""The report of `make hard`: a section for each case, and the texts in docs/stability.md."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import summary

from fhash_codec.selftest.run import Summary, cases, markdown

DOCUMENT = Path(__file__).parents[2] / "docs" / "stability.md"


def test_a_case_is_a_section_with_a_row_for_each_record() -> None:
    text = summary.text(
        [
            {"case": "little memory", "command": "decode", "limits": 19, "share": 0.123456},
            {"case": "little memory", "command": "a|b", "limits": 1200},
            {"case": "a new case", "figure": 1, "kinds": {"first": {"refused": 2}}},
        ]
    )
    assert "### Little memory\n\n" + summary.ABOUT["little memory"] in text
    assert "| command | limits | share |\n| --- | --- | --- |" in text
    assert "| decode | 19 | 0.1235 |" in text
    assert "| a\\|b | 1,200 |  |" in text
    assert "### A new case\n\n| figure |\n" in text
    assert "| kinds | refused |\n| --- | --- |\n| first | 2 |" in text


def test_the_document_joins_both_reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [tmp_path / name for name in ("selftest.md", "figures.jsonl", "out.md")]
    paths[0].write_text("# Numerical stability\n")
    paths[1].write_text(json.dumps({"case": "two at once", "force": 1}) + "\n")
    monkeypatch.setattr(sys, "argv", ["summary.py", *map(str, paths)])
    summary.main()
    assert paths[2].read_text().startswith("# Numerical stability\n\n## Hostile files and faults")


def test_the_document_has_the_texts_that_are_written_now() -> None:
    document = DOCUMENT.read_text(encoding="utf-8")
    head = markdown(Summary(results=[]), options=" --all").split("\n\n")[1]
    assert head.replace("0 hard cases", f"{len(cases())} hard cases") in document
    for case in cases():
        assert f"\n| {case.name} | {case.about} |" in document, case.name
    for name, about in summary.ABOUT.items():
        section = f"### {name[0].upper()}{name[1:]}\n\n"
        assert section + (f"{about}\n\n| " if about else "| ") in document, name
