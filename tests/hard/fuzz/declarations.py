"""Declarations of what the native libraries export, made from the text of their sources.

The fuzzer includes them as `exports.hpp`. So its targets declare nothing themselves, and a call
that no longer fits a function does not compile.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

__all__ = ["CALL", "exported", "header"]

CALL = re.compile(r"\bfhash_\w+")
"""Names of functions in the text of a target."""

_EXPORTED = re.compile(r"FHASH_(?:EXPORT|KERNEL)\s+(\S+)\s+(fhash_\w+)\(([^)]*)\)")
_FOR_TARGETS = re.compile(r"^FHASH_FOR_TARGETS\((fhash_\w+),\s*\(([^)]*)\)", re.MULTILINE)
_MACRO = re.compile(r"^#define (\w+)(?:\(([^)]*)\))?[ \t]+(\S.*)$", re.MULTILINE)


def exported(sources: Iterable[Path]) -> dict[str, str]:
    """Return the parameters of each exported function of some files of C++, by its name."""
    return {name: parameters for _, name, parameters in _functions(sources)}


def header(sources: Iterable[Path]) -> str:
    """Return a header of C++ that declares the exported functions of some files."""
    lines = [
        re.sub(r"\b(u?int\d+_t|size_t)\b", r"std::\1", f"{result} {name}({parameters});")
        for result, name, parameters in _functions(sources)
    ]
    structures = sorted(set(re.findall(r"\bFhash\w+|\bfhash_\w+(?=\*)", "\n".join(lines))))
    body = [*(f"struct {name};" for name in structures), *lines]
    return "\n".join(["#pragma once", "#include <cstdint>", 'extern "C" {', *body, "}", ""])


def _functions(sources: Iterable[Path]) -> Iterator[tuple[str, ...]]:
    """Yield result, name and parameters of each exported function, without namespaces."""
    for path in sources:
        for function in _EXPORTED.findall(_expanded(path.read_text(encoding="utf-8"))):
            plain = (" ".join(part.replace("std::", "").split()) for part in function)
            yield tuple(re.sub(r"\bi64\b", "int64_t", part) for part in plain)


def _expanded(text: str) -> str:
    """Return a source without comments, in which its own macros around exports are expanded."""
    text = re.sub(r"//.*", "", text).replace("\\\n", " ")
    text = _FOR_TARGETS.sub(r"FHASH_KERNEL int64_t \1(\2)", text)  # target.hpp
    macros = _MACRO.findall(text)
    text = _MACRO.sub("", text)
    for name, given, body in macros:
        if given and ("FHASH_EXPORT" in body or "FHASH_KERNEL" in body):
            call = re.compile(rf"^{name}\(([^)]*)\)", re.MULTILINE)
            text = call.sub(lambda at, of=given, to=body: _filled(to, of, at[1]), text)
    for name, given, body in macros:
        if not given:
            text = re.sub(rf"\b{name}\b", lambda _, to=body: to, text)
    return text


def _filled(body: str, parameters: str, arguments: str) -> str:
    """Return the body of a macro for some arguments."""
    for name, to in zip(parameters.split(","), arguments.split(","), strict=True):
        body = re.sub(rf"(?:##)?\b{name.strip()}\b", to.strip(), body)
    return body
