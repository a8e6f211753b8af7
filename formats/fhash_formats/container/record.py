"""Metadata documents: strict JSON, and checked access to their fields."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.values import exact_number

MAX_BYTES = 16 << 20
"""Bytes of a document."""
MAX_DEPTH = 64
"""Objects and arrays within each other."""

# Tokens are strings and brackets. A string without an end reaches to the end of the text. The
# possessive quantifiers keep every text from taking more than linear time.
_TOKEN = re.compile(r'"(?:[^"\\]++|\\.)*+(?:"|\\?\Z)|[\[{]|[\]}]', re.DOTALL)


def loads(data: bytes | memoryview) -> dict[str, Any]:
    """The JSON object in `data` (UTF-8); raises DamagedFileError that says what is wrong."""
    if len(data) > MAX_BYTES:
        raise DamagedFileError(f"JSON of {len(data)} bytes; the limit is {MAX_BYTES}")
    try:
        text = bytes(data).decode("utf-8")
        _check_depth(text)
        value = json.loads(
            text, object_pairs_hook=_unique, parse_constant=_refuse_constant, parse_float=_finite
        )
        # The parser accepts a lone surrogate, which would fail later, where the text is shown.
        json.dumps(value, ensure_ascii=False).encode("utf-8")
    except DamagedFileError:
        raise
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(f"JSON is damaged: {error}") from error
    if not isinstance(value, dict):
        raise DamagedFileError(f"JSON is a {type(value).__name__}; an object is needed")
    return value


def dumps(value: Mapping[str, Any], what: str) -> bytes:
    """Compact JSON with sorted keys, UTF-8.

    Raises InputError, naming `what`, for values that JSON cannot hold.
    """
    try:
        data = json.dumps(
            value, sort_keys=True, allow_nan=False, ensure_ascii=False, separators=(",", ":")
        ).encode("utf-8")
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{what} cannot be stored as JSON: {error}") from error
    if len(data) > MAX_BYTES:
        raise InputError(f"{what} takes {len(data)} bytes as JSON; the limit is {MAX_BYTES}")
    return data


def _check_depth(text: str) -> None:
    """Raise DamagedFileError for text that is nested too deep.

    This comes before parsing, because a parser that recurses may exhaust the stack.
    """
    depth = 0
    for token in _TOKEN.finditer(text):
        kind = token[0][0]
        depth += (kind in "[{") - (kind in "]}")
        if depth > MAX_DEPTH:
            raise DamagedFileError(f"JSON is nested more than {MAX_DEPTH} deep")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in pairs:
        if name in values:
            raise DamagedFileError(f"JSON has the key {name[:80]!a} twice")
        values[name] = value
    return values


def _refuse_constant(name: str) -> NoReturn:
    raise DamagedFileError(f"JSON has {name}, which is not a JSON number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise DamagedFileError(f"JSON has the number {text[:40]}, which is beyond float64")
    return value


MAX_LENGTH = 1 << 40
"""Length that a header may declare for an axis, and a limit for other counts in it."""


class Record:
    """A JSON object whose values are checked as they are taken; raises DamagedFileError.

    `prefix` comes before a key in messages, for example "header key model.".
    """

    def __init__(self, values: Mapping[str, Any], prefix: str) -> None:
        self._values = values
        self._prefix = prefix

    def get(self, key: str) -> Any:
        """The value of `key`; the key must be there."""
        if key not in self._values:
            raise DamagedFileError(f"{self._prefix}{key} is missing")
        return self._values[key]

    def has(self, key: str) -> bool:
        """Whether the key is there."""
        return key in self._values

    def need(self, condition: bool, key: str, allowed: str) -> None:
        """Refuse the value of `key` unless `condition` holds; `allowed` says what is needed."""
        if not condition:
            raise DamagedFileError(
                f"{self._prefix}{key} is {ascii(self.get(key))[:80]}; needed: {allowed}"
            )

    def record(self, key: str) -> Record:
        """The value of `key`, an object."""
        value = self.get(key)
        self.need(isinstance(value, Mapping), key, "an object")
        return Record(value, f"{self._prefix}{key}.")

    def records(self, key: str) -> list[Record]:
        """The value of `key`, a list of objects."""
        values = self._all(key, lambda value: isinstance(value, Mapping), "a list of objects")
        return [
            Record(value, f"{self._prefix}{key}.{number}.") for number, value in enumerate(values)
        ]

    def _all(
        self, key: str, fits: Callable[[Any], bool], allowed: str, count: int | None = None
    ) -> list[Any]:
        """The value of `key`, a list of `count` values, or of any number, that all fit."""
        values = self.get(key)
        good = isinstance(values, list) and count in (None, len(values)) and all(map(fits, values))
        self.need(good, key, allowed)
        return list(values)

    def text(self, key: str) -> str:
        """The value of `key`, a string."""
        value = self.get(key)
        self.need(isinstance(value, str), key, "a string")
        return str(value)

    def texts(self, key: str) -> list[str]:
        """The value of `key`, a list of strings."""
        return self._all(key, lambda value: isinstance(value, str), "a list of strings")

    def choice(self, key: str, allowed: tuple[str, ...]) -> str:
        """The value of `key`, one of the strings `allowed`."""
        value = self.get(key)
        self.need(isinstance(value, str) and value in allowed, key, " or ".join(allowed))
        return str(value)

    def integer(self, key: str, low: int, high: int) -> int:
        """The value of `key`, a whole number from `low` to `high`."""
        value = self.get(key)
        self.need(
            type(value) is int and low <= value <= high, key, f"a whole number from {low} to {high}"
        )
        return int(value)

    def integers(self, key: str, count: int, low: int, high: int) -> list[int]:
        """The value of `key`, a list of `count` whole numbers from `low` to `high`."""
        allowed = f"{count} whole numbers from {low} to {high}"
        return self._all(key, lambda n: type(n) is int and low <= n <= high, allowed, count)

    def number(self, key: str) -> float:
        """The value of `key`, a finite number."""
        value = self.get(key)
        self.need(_is_finite(value), key, "a finite number")
        return float(value)

    def number_or_null(self, key: str) -> float | None:
        """The value of `key`, a finite number, or None where the key is null or missing."""
        return None if self._values.get(key) is None else self.number(key)

    def numbers_or_null(self, key: str, count: int) -> None:
        """Refuse the value of `key` unless it is a list of `count` finite numbers or null."""
        allowed = f"{count} finite numbers or null"
        self._all(key, lambda value: value is None or _is_finite(value), allowed, count)

    def numbers(self, key: str, count: int) -> list[float]:
        """The value of `key`, a list of `count` finite numbers; integers beyond 2^53 stay such."""
        found = self._all(key, _is_finite, f"{count} finite numbers", count)
        return [exact_number(value) for value in found]


def _is_finite(value: object) -> bool:
    """Whether a JSON value is a number that float64 can hold.

    Python takes `True` for a number, and whole numbers of JSON may be too large for float64.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False
