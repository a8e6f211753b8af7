"""Heads and masks that lie in arrays of their own, as the codec of their table names them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["apart_message", "without_names"]


def without_names(configuration: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The configuration of `fhash.transform` without the parts that lie in arrays of their own.

    The names of these arrays come second. Scores and edges of a mask stay.
    """
    result, names = dict(configuration), []
    for key in ("head", "mask"):
        part = configuration.get(key)
        if isinstance(part, Mapping) and isinstance(part.get("array"), str):
            names.append(part["array"])
            result[key] = {name: value for name, value in part.items() if name != "array"}
    if isinstance(result.get("head"), Mapping) and not result["head"]:
        del result["head"]
    return result, tuple(names)


def apart_message(names: Sequence[str]) -> str:
    """Why a table cannot be decoded alone. names: arrays of `without_names`."""
    return (
        f"the table needs {' and '.join(names)} beside it; "
        "fhash_codec.open reads it, and fhash export --plain writes a file for any Zarr reader"
    )
