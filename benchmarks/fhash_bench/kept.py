"""Results that a bench keeps in a folder, one JSON file each, so that it goes on where it was."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from fhash_formats.errors import InputError
from fhash_formats.support.files import replacing

Result = TypeVar("Result")


def settings_id(settings: Mapping[str, Any], version: int) -> str:
    """Eight hexadecimal digits of a hash of settings, by which their result is found again.

    version: of the way in which it is measured.
    """
    text = json.dumps({**settings, "version": version}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def file_name(words: Sequence[str], settings: Mapping[str, Any], version: int) -> str:
    """Name of the file of a result; other words, settings or versions have another name."""
    plain = "_".join(re.sub(r"[^A-Za-z0-9.-]+", "-", word) for word in words)
    return f"{plain[:120]}_{settings_id({**settings, 'words': words}, version)}.json"


def of_fields(record: type[Result], values: Mapping[str, Any]) -> Result:
    """A record of all its fields by name; raises InputError for missing or unknown ones."""
    needed = sorted(record.__dataclass_fields__)  # type: ignore[attr-defined]
    if sorted(values) != needed:
        raise InputError(
            f"a result has the fields {', '.join(sorted(values))}; needed: {', '.join(needed)}"
        )
    return record(**values)


def load(path: Path, of: Callable[[Any], Result]) -> Result | None:
    """A kept result, made by `of` of its JSON values; None where there is none that can be read."""
    try:
        return of(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def save(path: Path, values: Mapping[str, Any]) -> None:
    """Keep the JSON values of a result; its folder is made, and its file complete or absent.

    Raises OutputError where it cannot be written.
    """
    text = json.dumps(values, indent=1, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, force=True) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
