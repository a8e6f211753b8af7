"""Functions that C++ sources export, with the kinds of their arguments."""

from __future__ import annotations

import re
from pathlib import Path

from fhash_formats.native import ARRAY, INTEGER, REAL

_KINDS = {"*": ARRAY, "int64_t": INTEGER, "double": REAL}
_EXPORTED = re.compile(r"FHASH_EXPORT \S+ (fhash_\w+)\(([^)]*)\)")


def exported(folder: Path) -> dict[str, tuple[type, ...]]:
    """The functions of a folder's sources by name; not those that return an ABI number."""
    return {
        name: tuple(_kind(argument) for argument in arguments.split(",") if argument)
        for path in folder.glob("*.cpp")
        for name, arguments in _EXPORTED.findall(path.read_text(encoding="utf-8"))
        if not name.endswith("_abi_version")
    }


def _kind(argument: str) -> type:
    return _KINDS["*" if "*" in argument else argument.split()[0].removeprefix("std::")]
