"""Figures of the documents, from the files of benchmarks/results: `python -m fhash_bench.results`.

README.md and the pages of docs/ hold marks, `<!-- result: NAME -->...<!-- end -->`: the table of
NAME.json, and below it command, date and machine. `NAME.KEY` is one table or one figure of the
file. A file is what `fhash bench ... --json` printed, or has the same record under `machine`, and
`columns` and `rows`, or `facts` by KEY: figures, or tables of the same form.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fhash_bench.commands.rate import access_rows, bytes_rows, cell_rows, speed_rows
from fhash_bench.rate.measuring import Access, Point, RateBench, Speed, TilePrice
from fhash_bench.rate.table import RateCell

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
MARK = re.compile(r"<!-- result: ([\w-]+)(?:\.([\w-]+))? -->(.*?)<!-- end -->", re.DOTALL)
"""A mark: name of the result, key within it, and what stands there."""


def pages() -> list[Path]:
    """README.md, and every page of docs/ but those that are made."""
    written = (page for page in (ROOT / "docs").rglob("*.md") if page.parent.name != "made")
    return [ROOT / "README.md", *sorted(written)]


def filled(text: str) -> str:
    """Text of a page with all its marks filled anew.

    Raises FileNotFoundError for a mark without a result, and KeyError for a key that it lacks.
    """
    return MARK.sub(_filled, text)


def _filled(mark: re.Match[str]) -> str:
    name, key = mark[1], mark[2]
    result = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    inside = _value(result, key) if key else f"{_value(result, 'rows')}\n{_record(result)}\n"
    return f"<!-- result: {name}{'.' * bool(key)}{key or ''} -->{inside}<!-- end -->"


def _record(result: Mapping[str, Any]) -> str:
    """Command, date and machine of a result, in a line."""
    machine = result["machine"]
    load = f", {machine['threads']} threads, load {machine['load']}" if "load" in machine else ""
    return f"`{machine['command']}`, {machine['date']}, {machine['processor']}{load}."


def _value(result: Mapping[str, Any], key: str) -> str:
    """Markdown of a table or a figure of a result."""
    if "points" in result:  # of `fhash bench rate`
        kinds = {"points": Point, "speeds": Speed, "access": Access, "tiles": TilePrice}
        parts = {name: tuple(kind(**row) for row in result[name]) for name, kind in kinds.items()}
        fields = {name: result[name] for name in RateBench.__dataclass_fields__}
        rate = RateBench(**{**fields, **parts})
        printed = {"rows": bytes_rows, "speeds": speed_rows, "access": access_rows}
        if key in printed:
            return _table(printed[key](rate))
    if "cells" in result and key == "rows":  # of `fhash bench table`
        return _table(cell_rows([RateCell.from_dict(cell) for cell in result["cells"]]))
    found = {**result["machine"], **result.get("facts", {}), "rows": result}[key]
    if isinstance(found, dict):
        return _table([found["columns"], *found["rows"]])
    return f"`{found}`" if key == "command" else _text(found)


def _text(value: Any) -> str:
    """A figure, whole numbers in groups of three digits; nothing for null."""
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def _table(rows: Sequence[Sequence[Any]]) -> str:
    """A table whose first row is its heading, on lines of its own."""
    lines = [f"| {' | '.join(map(_text, row))} |" for row in rows]
    return "\n".join(["", lines[0], f"|{'---|' * len(rows[0])}", *lines[1:], ""])


def main() -> None:
    """Fill the marks of every page."""
    for page in pages():
        text = page.read_text(encoding="utf-8")
        new = filled(text)
        if new != text:
            page.write_text(new, encoding="utf-8")
            print(f"wrote {page.relative_to(ROOT)}", file=sys.stderr)


if __name__ == "__main__":
    main()
