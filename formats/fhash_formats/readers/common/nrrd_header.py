"""Header of NRRD: its fields, key/value pairs, and the numbers in them.

Source: teem.sourceforge.net/nrrd/format.html. Raises InputError for what no reader could use.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.support.plain_json import decoded_text

TYPE_NAMES = {
    "i1": "signed char|int8|int8_t",
    "u1": "uchar|unsigned char|uint8|uint8_t",
    "i2": "short|short int|signed short|signed short int|int16|int16_t",
    "u2": "ushort|unsigned short|unsigned short int|uint16|uint16_t",
    "i4": "int|signed int|int32|int32_t",
    "u4": "uint|unsigned int|uint32|uint32_t",
    "i8": "longlong|long long|long long int|signed long long|signed long long int|int64|int64_t",
    "u8": "ulonglong|unsigned long long|unsigned long long int|uint64|uint64_t",
    "f4": "float",
    "f8": "double",
}

TYPES = {name: short for short, names in TYPE_NAMES.items() for name in names.split("|")}
"""Number types by their names in the header."""

MAX_HEADER = 64 * 2**20
"""Bytes of the longest header; own ones list every coordinate."""

MAX_DIMENSIONS = 16
"""Dimensions of NRRD."""

ALIASES = {
    "datafile": "data file",
    "sampleunits": "sample units",
    "axismins": "axis mins",
    "spacedirections": "space directions",
    "spaceorigin": "space origin",
    "spacedimension": "space dimension",
    "lineskip": "line skip",
    "byteskip": "byte skip",
    "centers": "centerings",
}
"""Names of fields without blanks, and the usual names."""

Fields = Mapping[str, str]

MAGIC = b"NRRD000"


def read_header(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """Fields, key/value pairs, and the first byte behind the header."""
    fields: dict[str, str] = {}
    pairs: dict[str, str] = {}
    with path.open("rb") as file:
        lines = [file.readline(MAX_HEADER)]
        if not re.fullmatch(rb"NRRD000[1-5]\r?\n", lines[0]):
            raise InputError(f"it begins with {lines[0][:20]!r}; NRRD0001 to NRRD0005 can be read")
        while line := file.readline(MAX_HEADER):
            text = decoded_text(line).rstrip("\r\n")
            if file.tell() > MAX_HEADER:
                raise InputError(f"its header is longer than {MAX_HEADER} bytes")
            if not text:
                break
            if text.startswith("#"):
                continue
            key, separator, value = text.partition(":=")
            if separator and ": " not in key:
                pairs[key] = value
                continue
            key, separator, value = text.partition(":")
            if not separator:
                raise InputError(f"its header has the line {text[:60]!r}")
            key = re.sub(r"[ _-]", "", key.strip().lower())
            key = ALIASES.get(key, key)
            fields[key] = value.strip()
            if key == "data file" and value.split()[:1] == ["LIST"]:
                rest = decoded_text(file.read(MAX_HEADER))
                fields["list"] = rest
                break
        return fields, pairs, file.tell()


def sizes_of(fields: Fields) -> tuple[int, ...]:
    """Lengths of the dimensions, the fastest first."""
    words = fields.get("sizes", "").split()
    dimension = fields.get("dimension", "")
    if not words or not all(re.fullmatch("0{0,9}[1-9][0-9]{0,17}", word) for word in words):
        raise InputError(
            f"its sizes are {fields.get('sizes', '')!r}; whole numbers above 0 are needed"
        )
    if dimension != str(len(words)) or len(words) > MAX_DIMENSIONS:
        raise InputError(f"it has {len(words)} sizes and the dimension {dimension!r}")
    return tuple(map(int, words))


def words_of(fields: Fields, name: str, count: int, default: str) -> list[str]:
    """The words of a field that has one for each dimension; `default` where it is missing."""
    words = fields[name].split() if name in fields else [default] * count
    if len(words) != count:
        raise InputError(f"its {name} are {len(words)}, its dimensions {count}")
    return words


def directions_of(fields: Fields, count: int) -> list[tuple[float, ...] | None] | None:
    """The vector of each dimension in space, None for one that has none; None without the field."""
    if "space directions" not in fields:
        return None
    found = vectors(fields["space directions"])
    if len(found) != count:
        raise InputError(f"its space directions are {len(found)}, its dimensions {count}")
    return found


def vectors(text: str) -> list[tuple[float, ...] | None]:
    """Vectors such as (1,0,0); None for "none", and for one of NaN, as pynrrd writes it."""
    found: list[tuple[float, ...] | None] = []
    for word in re.findall(r"\([^)]*\)|\S+", text):
        if word == "none":
            found.append(None)
            continue
        try:
            found.append(tuple(float(part) for part in word.strip("()").split(",")))
        except ValueError as error:
            raise InputError(f"{word!r} is no vector") from error
    return [None if each is not None and np.isnan(each).all() else each for each in found]


def dtype_of(fields: Fields) -> np.dtype[Any]:
    """The type of the values in the file."""
    kind = TYPES.get(" ".join(fields.get("type", "").lower().split()))
    if kind is None:
        raise InputError(f"its values are of the type {fields.get('type')!r}, which has no numbers")
    order = fields.get("endian", "little").lower()
    if order not in ("little", "big"):
        raise InputError(f"its byte order is {order!r}")
    return np.dtype(("<" if order == "little" else ">") + kind)


def whole(fields: Fields, name: str) -> int:
    """A whole number from -1 on, 0 without the field."""
    text = fields.get(name, "0")
    try:
        number = int(text)
    except ValueError as error:
        raise InputError(f"its {name} is {text!r}") from error
    if number < -1:
        raise InputError(f"its {name} is {number}")
    return number


def number_of(text: str) -> float:
    """A number in any notation, NaN too."""
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{text!r} stands where a number is needed") from error
