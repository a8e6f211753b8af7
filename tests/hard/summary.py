"""Joins the results of `fhash selftest` and the figures of the long tests into one document.

Usage: `python tests/hard/summary.py SELFTEST.md FIGURES.jsonl OUT.md`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

ABOUT = {
    "hostile files": "Mutations of the golden containers through the commands: how each of them ended, and at most how many seconds of\n"
    "processor time and bytes of memory it took. What is refused ends with exit code 4. Too large (1) is a sound file that declares more\n"
    "than there is memory for here, nothing to show (2) one whose usual picture would be empty or cannot be placed.",
    "the native code under sanitizers": "Coverage-guided fuzzing of the native library under address and undefined-behaviour\n"
    "sanitizers: decoders, encoders (what they write has to decode to what was coded), transforms, heads, the marcher and its light.",
    "kill -9 at an operation": "The process is killed before each of its operations on files: the older output stays whole, and the\n"
    "next run clears away what was left.",
    "kill -9 at a random moment": "The process is killed at random: the older output stays, and the same command gives the same file.",
    "kill -9 while checkpoints are written": "The same, where checkpoints are written all the time.",
    "a full disk": "Each operation on files fails as it does on a full disk: refused with one line, nothing half-written. What is\n"
    "not refused did not need the operation.",
    "a signal at each stage": "Ctrl-C and SIGTERM in each stage: one line, nothing half-written, and the older output stays.",
    "a signal at an operation": "The same at operations on files.",
    "a source that changes": "The source grows, shrinks, is written again or vanishes while it is read: refused.",
    "two at once": "Two writers of one output: the result is one of the two, whole.",
    "little memory": "Under tighter and tighter limits of memory: done, or one line.",
    "a large series": "",
    "a large decode within 1 GiB": "A series larger than the limit of memory, decoded within it.",
}


def text(records: list[dict[str, Any]]) -> str:
    """Return a section for each case, with a row for each of its records.

    Figures that are tables themselves follow the rows.
    """
    cases: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        cases.setdefault(record.pop("case"), []).append(record)
    parts = ["## Hostile files and faults\n\nMade by `make hard`.\n"]
    for case, records_of_case in cases.items():
        about = ABOUT.get(case, "")
        plain = [
            {name: value for name, value in record.items() if not isinstance(value, dict)}
            for record in records_of_case
        ]
        tables = [_table(plain)]
        for record in records_of_case:
            tables += [
                _table([{name: row, **columns} for row, columns in value.items()])
                for name, value in record.items()
                if isinstance(value, dict)
            ]
        parts.append(
            "\n\n".join([f"### {case[0].upper()}{case[1:]}", *([about] if about else []), *tables])
            + "\n"
        )
    return "\n".join(parts)


def _table(rows: list[dict[str, Any]]) -> str:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [
        columns,
        ["---"] * len(columns),
        *([_cell(row.get(name, "")) for name in columns] for row in rows),
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value).replace("|", "\\|")


def main() -> None:
    selftest, figures, out = map(Path, sys.argv[1:])
    records = [json.loads(line) for line in figures.read_text(encoding="utf-8").splitlines()]
    out.write_text(selftest.read_text(encoding="utf-8") + "\n" + text(records), encoding="utf-8")


if __name__ == "__main__":
    main()
