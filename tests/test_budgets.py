"""The size of the house: `tests/budgets.txt` gives each room its lines and its modules, and falls.

A room may not grow beyond its line of the table, and a line may not stand far above its room: who
makes a room smaller lowers its number in the same commit (`python tests/test_budgets.py` writes the
table anew). A number that rises has its reason behind it in the table.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_name("budgets.txt")
SUFFIXES = {".py", ".cpp", ".hpp", ".cu", ".cuh", ".c", ".h"}
ROOTS = ("formats", "fhash_codec", "cli", "benchmarks", "tests")
SLACK = 1.02
"""Factor by which a number of the table may stand above the house."""
MODULES = {"product": 208, "tests": 225}
"""Most modules in all, of the three packages of the product and of their tests. Three of these
packages leave with the streamed march, when its heir has run on a device."""


def sizes(rooms: list[str]) -> tuple[Counter[str], Counter[str]]:
    """Lines and Python modules of each room: a file counts in the longest room that it lies in."""
    lines: Counter[str] = Counter(dict.fromkeys(rooms, 0))
    modules: Counter[str] = Counter(dict.fromkeys(rooms, 0))
    for root in ROOTS:
        for path in sorted((ROOT / root).rglob("*")):
            place = path.relative_to(ROOT)
            others = place.parts[1] == "build" or "third_party" in place.parts
            others = others or path.name == "declarations.py"  # of headers, by setup.py
            if path.suffix not in SUFFIXES or others:
                continue
            inside = [each for each in rooms if place.is_relative_to(each)]
            assert inside, f"{place} lies in no room of {TABLE.name}"
            room = max(inside, key=len)
            lines[room] += path.read_text(encoding="utf-8").count("\n")
            modules[room] += path.suffix == ".py"
    return lines, modules


def table() -> dict[str, tuple[int, int, str]]:
    """Lines, modules and the reason of the last rise, by room."""
    rows = [
        re.fullmatch(r"(\S+) +(\d+) +(\d+) *(.*)", line)
        for line in TABLE.read_text(encoding="utf-8").splitlines()
        if line and not line.startswith("#")
    ]
    return {row[1]: (int(row[2]), int(row[3]), row[4]) for row in rows if row}


def test_rooms_keep_their_budgets() -> None:
    budgets = table()
    lines, modules = sizes(list(budgets))
    wrong = []
    for room, (most_lines, most_modules, _) in budgets.items():
        for found, most, what in (
            (lines[room], most_lines, "lines"),
            (modules[room], most_modules, "modules"),
        ):
            if found > most:
                wrong.append(f"{room} has {found} {what}, more than its {most}")
            elif most > max(found * SLACK, found + 1):
                wrong.append(f"{room} has {found} {what}: lower its {most} in {TABLE.name}")
    assert not wrong, "\n".join(wrong)


def test_modules_in_all() -> None:
    budgets = table()
    tests = sum(each[1] for room, each in budgets.items() if room.startswith("tests"))
    bench = sum(each[1] for room, each in budgets.items() if room.startswith("benchmarks"))
    assert tests <= MODULES["tests"]
    assert sum(each[1] for each in budgets.values()) - tests - bench <= MODULES["product"]


if __name__ == "__main__":
    _budgets = table()
    _lines, _modules = sizes(list(_budgets))
    _head = [x for x in TABLE.read_text(encoding="utf-8").splitlines() if x.startswith("#")]
    _rows = [
        f"{room:<36}{_lines[room]:>7}{_modules[room]:>5}  {why}".rstrip()
        for room, (_, _, why) in _budgets.items()
    ]
    TABLE.write_text("\n".join([*_head, *_rows]) + "\n", encoding="utf-8")
