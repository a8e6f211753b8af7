"""Records of settings: frozen dataclasses that check their fields and convert to and from JSON."""

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

from fhash_formats.errors import InputError, MissingInputError, suggestion

KINDS = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a text",
    type(None): "null",
}
"""Kinds of values that fields have, for messages."""


class _RefusedSettingError(InputError):
    """A setting that is not allowed.

    Attributes:
        place: of the setting, from the record that is made, such as `camera.azimuth`.
        fault: what is wrong with it.
    """

    def __init__(self, place: str, fault: str) -> None:
        super().__init__(f"{place} {fault}")
        self.place, self.fault = place, fault

    def within(self, name: str) -> _RefusedSettingError:
        """The same fault, of a record that is a setting itself."""
        return _RefusedSettingError(f"{name}.{self.place}", self.fault)


class Record:
    """A frozen dataclass that checks each field against its annotation and its `limits`.

    It converts to and from JSON values. Values are converted to the annotated types where that
    loses nothing: see `_converted`.
    """

    def __post_init__(self) -> None:
        """Check and convert every field; raises InputError."""
        hints = _hints(type(self))  # type: ignore[arg-type]
        for setting in dataclasses.fields(self):  # type: ignore[arg-type]
            value = _checked(
                self.label(setting), setting, hints[setting.name], getattr(self, setting.name)
            )
            object.__setattr__(self, setting.name, value)

    @staticmethod
    def label(setting: dataclasses.Field[Any]) -> str:
        """The name of a field in messages."""
        return setting.name

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name, without the fields that have their defaults."""
        return {
            setting.name: _plain(getattr(self, setting.name))
            for setting in dataclasses.fields(self)  # type: ignore[arg-type]
            if getattr(self, setting.name) != _default(setting)
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Make a record of the values of `to_dict`.

        Raises InputError for a value that is not allowed, and for an unknown name, with the nearest
        known one.
        """
        if not isinstance(values, Mapping):
            raise InputError(
                f"{cls.__name__.lower()} is {values!r:.40}; a table of settings is needed"
            )
        settings = dataclasses.fields(cls)  # type: ignore[arg-type]
        names = [setting.name for setting in settings]
        for name in values:
            if name not in names:
                raise InputError(
                    f"unknown setting {str(name)[:60]!r} of {cls.__name__.lower()}; "
                    f"{suggestion(str(name), names)}"
                )
        for setting in settings:
            if setting.name not in values and _default(setting) is dataclasses.MISSING:
                hints = _hints(cls)  # type: ignore[arg-type]
                needed = _needed(setting, hints[setting.name])
                raise _RefusedSettingError(setting.name, f"is missing; {needed}")
        return cls(**values)

    @classmethod
    def read(cls, path: Path, what: str, missing: str) -> Self:
        """Read a record from a file: TOML if its suffix is .toml, else JSON.

        Args:
            path: of the file.
            what: the kind of file, for messages, such as "a scene".
            missing: message for a file that does not exist.

        Raises InputError, MissingInputError for a file that does not exist.
        """
        try:
            text = path.read_text(encoding="utf-8")
            return cls.from_dict(
                tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
            )
        except FileNotFoundError as error:
            raise MissingInputError(f"{path}: {missing}") from error
        except UnicodeDecodeError as error:
            raise InputError(
                f"{path}: not {what}: it holds no text; JSON or TOML is needed"
            ) from error
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
    **more: str | bool,
) -> Any:
    """Declare a field of a Record with its help and the values that it may have.

    Args:
        default: of the field; dataclasses.MISSING for a field that must be given.
        help: one line, with units, also for the options of the command line.
        low: smallest number allowed; checked only together with `high`.
        high: largest number allowed.
        choices: texts allowed; any text if empty.
        more: what one kind of record knows of its fields besides.
    """
    declared = {"help": help, "low": low, "high": high, "choices": choices, **more}
    return field(default=default, metadata=declared)


@cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _default(setting: dataclasses.Field[Any]) -> Any:
    if setting.default_factory is not dataclasses.MISSING:
        return setting.default_factory()
    return setting.default


def _needed(setting: dataclasses.Field[Any], hint: Any) -> str:
    """The kind and range of values that a field takes, and its help, for messages."""
    low, high = setting.metadata.get("low"), setting.metadata.get("high")
    allowed = "" if low is None or high is None else f" from {low:g} to {high:g}"
    told = setting.metadata.get("help")
    return f"{_kind(hint)}{allowed} is needed" + (f": {told}" if told else "")


def _kind(hint: Any) -> str:
    """The kind of values of an annotation, for messages."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        kinds = [_kind(each) for each in inner if each is not type(None)]
        return " or ".join(dict.fromkeys(kinds))
    if origin is tuple:
        kinds = [_kind(each) for each in inner if each is not ...]
        if inner[-1] is ...:
            return f"a list, each {kinds[0]},"
        return f"a list of {len(kinds)}, each {' or '.join(dict.fromkeys(kinds))},"
    if isinstance(hint, type) and issubclass(hint, Record):
        return "a table of settings, true or false"
    return KINDS.get(hint, "another value")


def _plain(value: Any) -> Any:
    """A value of a field as a JSON value."""
    if isinstance(value, Record):
        return value.to_dict()
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _checked(name: str, setting: dataclasses.Field[Any], hint: Any, value: Any) -> Any:
    """Convert a value to the type of its field and check it; raises InputError.

    name: of the field, for messages.
    """
    try:
        converted = _converted(hint, value)
    except _RefusedSettingError as error:
        raise error.within(name) from error
    if converted is _WRONG:
        raise _RefusedSettingError(name, f"is {value!r:.60}; {_needed(setting, hint)}")
    for item in converted if isinstance(converted, tuple) else (converted,):
        if isinstance(item, str):
            _check_choice(name, setting, item)
        elif isinstance(item, int | float) and not isinstance(item, bool):
            _check_range(name, setting, item)
    return converted


def _check_range(name: str, setting: dataclasses.Field[Any], number: float) -> None:
    low: float | None = setting.metadata.get("low")
    high: float | None = setting.metadata.get("high")
    if low is not None and high is not None and not low <= number <= high:
        shown = number if isinstance(number, int) else f"{number:g}"
        raise _RefusedSettingError(name, f"is {shown}; allowed: {low:g} to {high:g}")


def _check_choice(name: str, setting: dataclasses.Field[Any], text: str) -> None:
    choices: tuple[str, ...] = setting.metadata.get("choices", ())
    if choices and text not in choices:
        near = difflib.get_close_matches(text, choices, n=1, cutoff=0.6)
        raise _RefusedSettingError(
            name,
            f"is '{text[:60]}'; allowed: {', '.join(choices)}"
            + (f"; did you mean '{near[0]}'?" if near else ""),
        )


_WRONG = object()
"""Result of a conversion that is not possible; None is a value that fields may have."""


def _converted(hint: Any, value: Any) -> Any:
    """Convert a value to an annotated type; _WRONG if that is not possible.

    Lists become tuples, tables and `true` become records, `false` becomes None where a field may be
    None, integers become floats. Numbers must be finite.
    """
    origin = typing.get_origin(hint)
    if origin in (types.UnionType, typing.Union):
        return _first_option(typing.get_args(hint), value)
    if origin is tuple:
        return _tuple(typing.get_args(hint), value)
    if isinstance(hint, type) and issubclass(hint, Record):
        return _record(hint, value)
    if hint is type(None):
        return None if value is None or value is False else _WRONG
    if hint is bool or isinstance(value, bool):
        # Python's booleans are integers: they are kept apart from numbers here.
        return value if hint is bool and isinstance(value, bool) else _WRONG
    if hint is float:
        return _finite(value)
    return value if isinstance(value, hint) else _WRONG


def _first_option(options: tuple[Any, ...], value: Any) -> Any:
    """Convert a value to the first of several types that it fits."""
    for option in options:
        converted = _converted(option, value)
        if converted is not _WRONG:
            return converted
    return _WRONG


def _tuple(hints: tuple[Any, ...], value: Any) -> Any:
    """Convert the items of a list or tuple; `hints` may end in `...` for any number of items."""
    if not isinstance(value, list | tuple):
        return _WRONG
    item_hints = [hints[0]] * len(value) if hints[-1] is ... else hints
    if len(item_hints) != len(value):
        return _WRONG
    items = tuple(_converted(hint, item) for hint, item in zip(item_hints, value, strict=True))
    return _WRONG if _WRONG in items else items


def _record(cls: type[Record], value: Any) -> Any:
    """Convert a table, or `true` for the defaults, to a record."""
    if isinstance(value, cls):
        return value
    if value is True:
        return cls.from_dict({})
    return cls.from_dict(value) if isinstance(value, Mapping) else _WRONG


def _finite(value: Any) -> Any:
    """Convert a number to a float; integers beyond float64 are not possible."""
    if isinstance(value, int | float) and abs(value) <= sys.float_info.max:
        return float(value)
    return _WRONG
