"""Records of settings: frozen dataclasses that check their fields and go to and from JSON values."""

from __future__ import annotations

import dataclasses
import difflib
import json
import sys
import tomllib
import types
import typing
from collections.abc import Mapping
from dataclasses import field
from functools import cache
from pathlib import Path
from typing import Any, Self

from fhash_formats.errors import InputError, MissingInputError

__all__ = ["Record", "limits"]


class Record:
    """A frozen dataclass that is checked field by field against its annotations and its `limits`, and goes to and from JSON values."""

    def __post_init__(self) -> None:
        hints = _hints(type(self))  # type: ignore[arg-type]
        for each in dataclasses.fields(self):  # type: ignore[arg-type]
            object.__setattr__(
                self, each.name, _checked(each, hints[each.name], getattr(self, each.name))
            )

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name, without those that are the default."""
        return {
            each.name: _plain(getattr(self, each.name))
            for each in dataclasses.fields(self)  # type: ignore[arg-type]
            if getattr(self, each.name) != _default(each)
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """From `to_dict`'s values; raises InputError for an unknown name (offering the nearest) or a value that is not allowed."""
        if not isinstance(values, Mapping):
            raise InputError(
                f"{cls.__name__.lower()} is {values!r:.40}; a table of settings is needed"
            )
        known = [each.name for each in dataclasses.fields(cls)]  # type: ignore[arg-type]
        for name in values:
            if name not in known:
                near = difflib.get_close_matches(str(name), known, n=1, cutoff=0.0)
                raise InputError(
                    f"unknown setting '{str(name)[:60]}' of {cls.__name__.lower()}; did you mean '{near[0]}'?"
                )
        for each in dataclasses.fields(cls):  # type: ignore[arg-type]
            if each.name not in values and _default(each) is dataclasses.MISSING:
                raise InputError(f"{each.name} is missing: {_wanted(each)} is needed")
        return cls(**values)

    @classmethod
    def read(cls, path: Path, what: str, missing: str) -> Self:
        """From a file: TOML by its suffix .toml, else JSON. what: it is, missing: what is said where there is none. Raises InputError."""
        try:
            text = path.read_text(encoding="utf-8")
            return cls.from_dict(
                tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
            )
        except FileNotFoundError as error:
            raise MissingInputError(f"{path}: {missing}") from error
        except (OSError, ValueError, RecursionError) as error:
            if isinstance(error, InputError):
                raise InputError(f"{path}: {error}") from error
            raise InputError(f"{path}: not {what}: {error}") from error


def limits(
    default: Any,
    help: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """A field with its help (units and range included) and what it may be."""
    return field(
        default=default, metadata={"help": help, "low": low, "high": high, "choices": choices}
    )


@cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _default(each: dataclasses.Field[Any]) -> Any:
    return (
        each.default_factory() if each.default_factory is not dataclasses.MISSING else each.default
    )


def _plain(value: Any) -> Any:
    if isinstance(value, Record):
        return value.to_dict()
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


def _checked(each: dataclasses.Field[Any], hint: Any, value: Any) -> Any:
    """The value as its annotation wants it; raises InputError."""
    found = _fitted(hint, value)
    if found is _WRONG:
        raise InputError(f"{each.name} is {value!r:.60}; {_wanted(each)} is needed")
    low: float | None = each.metadata.get("low")
    high: float | None = each.metadata.get("high")
    choices: tuple[str, ...] = each.metadata.get("choices", ())
    for part in found if isinstance(found, tuple) else (found,):
        if (
            low is not None
            and high is not None
            and isinstance(part, int | float)
            and not isinstance(part, bool)
            and not low <= part <= high
        ):
            raise InputError(f"{each.name} is {part:g}; allowed: {low:g} to {high:g}")
        if choices and isinstance(part, str) and part not in choices:
            near = difflib.get_close_matches(part, choices, n=1, cutoff=0.6)
            raise InputError(
                f"{each.name} is '{part[:60]}'; allowed: {', '.join(choices)}"
                + (f"; did you mean '{near[0]}'?" if near else "")
            )
    return found


def _wanted(each: dataclasses.Field[Any]) -> str:
    return f"'{each.name}' ({each.metadata.get('help', 'a table of settings, true or false')})"


_WRONG = object()


def _fitted(hint: Any, value: Any) -> Any:
    """The value converted to a type, or _WRONG: numbers are finite, tuples come from lists too, records from tables and `true`."""
    origin = typing.get_origin(hint)
    if origin in (types.UnionType, typing.Union):
        for option in typing.get_args(hint):
            found = _fitted(option, value)
            if found is not _WRONG:
                return found
        return _WRONG
    if origin is tuple:
        parts = typing.get_args(hint)
        if not isinstance(value, list | tuple):
            return _WRONG
        kinds = [parts[0]] * len(value) if parts[-1] is ... else parts
        if len(kinds) != len(value):
            return _WRONG
        fitted = tuple(_fitted(kind, part) for kind, part in zip(kinds, value, strict=True))
        return _WRONG if _WRONG in fitted else fitted
    if isinstance(hint, type) and issubclass(hint, Record):
        if isinstance(value, hint):
            return value
        if value is True:
            return hint.from_dict({})
        return hint.from_dict(value) if isinstance(value, Mapping) else _WRONG
    if hint is type(None):
        return None if value is None or value is False else _WRONG
    if hint is bool or isinstance(value, bool):
        return value if hint is bool and isinstance(value, bool) else _WRONG
    if hint is float:
        return (
            float(value)
            if isinstance(value, int | float) and abs(value) <= sys.float_info.max
            else _WRONG
        )
    return value if isinstance(value, hint) else _WRONG
