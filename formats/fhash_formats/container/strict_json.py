"""Strict JSON (RFC 8259): no NaN, no infinity, no key twice, bounded size and depth."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any, NoReturn

from fhash_formats.errors import DamagedFileError, InputError

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
