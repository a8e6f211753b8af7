"""Joins the results of `fhash selftest` and the figures of the long tests into one document.

Usage: `python tests/hard/summary.py SELFTEST.md FIGURES.jsonl OUT.md`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

ABOUT = {
    "hostile files": """\
Mutations of the golden containers, read by every command. The first table shows the largest
processor time in seconds and the largest memory in bytes of one command; the others show how the
commands ended. Refused means exit code 4. A sound file that declares more than fits into memory is
too large (exit code 1). If its usual picture would be empty or has no place in the coordinates,
there is nothing to show (exit code 2).""",
    "the native code under sanitizers": """\
Coverage-guided fuzzing of the native library under address and undefined-behaviour sanitizers:
decoders, encoders (whose output must decode to the input), transforms, heads and their training,
figures of quality, points of networks, the marcher, its light and its shading.""",
    "mutated sources": """\
Mutated files of the formats that this project reads itself, each read under limits of 5 seconds and
2 GiB: read, or refused by one line.""",
    "kill -9 at an operation": """\
The process is killed before each of its file operations. The older output stays complete, and the
next run removes temporary files.""",
    "kill -9 at a random moment": """\
The process is killed at a random moment. The older output stays, and the same command then gives
the same file.""",
    "kill -9 while checkpoints are written": """\
The same with a process that writes checkpoints all the time.""",
    "a full disk": """\
Each file operation fails as on a full disk. The command is refused with one line and leaves nothing
half-written. A command that is not refused did not need the operation.""",
    "a signal at each stage": """\
Ctrl-C, SIGTERM and SIGHUP in each stage: the command prints one line and leaves nothing
half-written, and the older output stays.""",
    "a signal at an operation": "The same signals at file operations.",
    "a source that changes": """\
The source grows, shrinks, is rewritten or vanishes while it is read: the command is refused.""",
    "a file that grows": """\
A running simulation appends; it is stopped before each file operation, in a new file and in one
that goes on. The file under the name stays complete, with every layer that was reported.""",
    "two at once": "Two processes write one output. The result is complete and of one of them.",
    "little memory": "Commands under ever smaller limits of memory finish, or end with one line.",
    "a large series": "",
    "a large decode within 1 GiB": "A series larger than the memory limit is decoded within it.",
}
"""A text for each case, by its name in the figures."""


def text(records: list[dict[str, Any]]) -> str:
    """Return a section for each case, with a row for each of its records.

    Figures that are tables themselves follow the rows.
    """
    cases: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        cases.setdefault(record.pop("case"), []).append(record)
    sections = ["## Hostile files and faults\n\nMade by `make hard`.\n"]
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
        sections.append(
            "\n\n".join([f"### {case[0].upper()}{case[1:]}", *([about] if about else []), *tables])
            + "\n"
        )
    return "\n".join(sections)


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
