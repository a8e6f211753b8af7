"""Output of commands with `--json`, held to its JSON Schemas in both directions."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import types
import typing
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import jsonschema
import pytest
from click.testing import Result

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.append(str(DOCS))

from schemas import RESULTS, keys, schema_of

Draft = jsonschema.Draft202012Validator
WHOLE = Draft.TYPE_CHECKER.redefine("integer", lambda _, value: type(value) is int)
"""Types of JSON by which 1.0 is no integer."""
Validator = jsonschema.validators.extend(Draft, type_checker=WHOLE)


@cache
def validator(name: str) -> Any:
    Validator.check_schema(schema_of(name))
    return Validator(schema_of(name))


def faults(name: str, value: Any) -> list[str]:
    """Faults of a value by the schema of a command, or of settings."""
    return [
        f"{each.json_path}: {each.message[:300]}" for each in validator(name).iter_errors(value)
    ]


def hold(words: Sequence[str], result: Result) -> None:
    """Refuse what a command line printed where none of the command's schemas takes it."""
    if "--json" not in words or not result.stdout.startswith("{"):
        return
    command = " ".join(words[: 2 if words[0] == "bench" else 1])
    names = [name for name in RESULTS if f"{name} ".startswith(f"{command} ")]
    value = json.loads(result.stdout)
    found = {name: faults(name, value) for name in (*names, *["errors"] * bool(result.exit_code))}
    assert not all(found.values()), f"fhash {command}: {found}"


def parsed(result: Result, code: int = 0) -> Any:
    assert result.exit_code == code, result.output
    (line,) = result.stdout.splitlines()
    return json.loads(line, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))


def check(name: str, *values: Any) -> None:
    """Hold objects that a command printed to its schema, every key of which one of them has."""
    assert [fault for value in values for fault in faults(name, value)] == []
    unsaid = [key for key, inner in keys(schema_of(name)) if not inner.get("description")]
    assert not unsaid, f"nothing is said of keys of fhash {name}: {unsaid}"
    optional = schema_of("errors")["properties"].keys() if name != "errors" else ()
    unseen = [
        key for key, _ in keys(schema_of(name)) if key not in optional and not within(values, key)
    ]
    assert not unseen, f"keys that fhash {name} did not print: {unseen}"


def within(values: Sequence[Any], key: str) -> Sequence[Any]:
    """The values of a key such as `a[].b.*.c` in some objects."""
    for part in re.findall(r"\[\]|[^.\[]+", key):
        if part == "[]":
            values = [entry for value in values if value for entry in value]
        elif part == "*":
            values = [entry for value in values if value for entry in value.values()]
        else:
            values = [value[part] for value in values if value and part in value]
    return values


def example(hint: Any) -> Any:
    """A value of an annotation; of a dataclass one with such values in all fields."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        return hint(**{name: example(each) for name, each in hints.items()})
    if typing.is_typeddict(hint):
        return {name: example(each) for name, each in typing.get_type_hints(hint).items()}
    if origin in (types.UnionType, typing.Union, Literal):
        return inner[0] if origin is Literal else example(inner[0])
    if origin is tuple:
        return tuple(example(each) for each in inner if each is not ...)
    if origin is dict:
        return {example(inner[0]): example(inner[1])}
    return {float: 1.5, int: 1, bool: True, str: "a"}.get(hint, "a")
