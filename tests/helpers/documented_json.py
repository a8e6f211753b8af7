"""Keys of docs/json.md with their types, and the comparison with what a command prints."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "json.md"
TYPES = {"text": str, "number": (int, float), "integer": int, "boolean": bool, "object": dict}


def documented() -> dict[str, dict[str, str]]:
    """Types by key of each command, as the document has them."""
    commands: dict[str, dict[str, str]] = {}
    for section in DOCUMENT.read_text().split("\n## ")[1:]:
        title = section.partition("\n")[0].replace("`", "").removeprefix("fhash ")
        inherited = re.search(r"All keys of `fhash (\w+)`", section)
        rows = re.findall(r"^\| `([^`]+)` \| ([a-z ]+) \|", section, re.MULTILINE)
        commands[title] = {**(commands[inherited[1]] if inherited else {}), **dict(rows)}
    return commands


KEYS = documented()


def fits(value: Any, kind: str) -> bool:
    """Whether a value is of a documented type, such as `list of numbers or null`."""
    if " or " in kind:
        return any(fits(value, part) for part in kind.split(" or "))
    if kind.startswith(("list of ", "lists of ")):
        inner = kind.partition(" of ")[2]
        return isinstance(value, list) and all(fits(entry, inner) for entry in value)
    if kind == "null":
        return value is None
    name = kind.removeprefix("free ")
    allowed = TYPES[name if name in TYPES else name.removesuffix("s")]
    return isinstance(value, allowed) and (allowed is bool or not isinstance(value, bool))


def entries(values: Any, kinds: dict[str, str], place: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of an object with its value, as the document writes keys; free objects closed."""
    for name, value in values.items():
        key = place + name
        if key not in kinds and any(kind.startswith(f"{place}*") for kind in kinds):
            key = f"{place}*"
        if key in kinds or not key.endswith("*"):
            yield key, value
        free = "free object" in kinds.get(key, "")
        if isinstance(value, dict) and not free:
            yield from entries(value, kinds, f"{key}.")
        elif isinstance(value, list) and not free:
            for entry in value:
                if isinstance(entry, dict):
                    yield from entries(entry, kinds, f"{key}[].")


def check(command: str, *results: Any) -> None:
    """Compare the objects that a command printed with its section of the document."""
    kinds, seen = KEYS[command], set()
    for result in results:
        for key, value in entries(result, kinds):
            assert key in kinds, f"docs/json.md lacks the key `{key}` of fhash {command}"
            assert fits(value, kinds[key]), f"{command}: {key} is {value!r}, not {kinds[key]}"
            seen.add(key)
    unseen = {key for key in kinds.keys() - seen if not key.endswith("*")}
    assert not unseen, f"docs/json.md has keys that fhash {command} did not print: {unseen}"


def parsed(result: Result, code: int = 0) -> Any:
    assert result.exit_code == code, result.output
    (line,) = result.stdout.splitlines()
    return json.loads(line, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
