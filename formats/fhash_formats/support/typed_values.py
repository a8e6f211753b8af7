"""Attributes and small arrays of a source as JSON values that keep their type.

JSON has text, whole numbers, other numbers and lists of them; these stand for text, int64, float64
and arrays of these types. Every other type is named: `{"float32": 0.1}`, `{"int16": [1, 2]}`.
NaN and infinities are text, and bytes are text of one character a byte.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError
from fhash_formats.support.number_types import DTYPES
from fhash_formats.support.plain_json import (
    UnknownValueError,
    attribute_json,
    decoded_text,
    plain_text,
)

__all__ = [
    "MAX_BYTES",
    "TEXT",
    "attribute_value",
    "inline_array",
    "inline_values",
    "stored_type",
    "type_of_name",
    "typed_attribute",
]

TEXT = "text"
"""Name of the type of arrays of texts of any length."""
JSON = "json"
"""Name of the type of attributes that are any JSON values, as Zarr has them."""
MAX_BYTES_LENGTH = 1 << 16
"""Bytes of one text of a fixed length."""
MAX_BYTES = 1 << 28
"""Bytes of the values of one list: texts of a fixed length may take far more than in a file."""
_BYTES = re.compile(r"bytes([1-9][0-9]{0,4})")
_NOT_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


def stored_type(values: npt.NDArray[Any]) -> str | None:
    """Name of the type of an array; None for a type that no container holds."""
    dtype = values.dtype
    if dtype.kind == "S":
        size = max(1, dtype.itemsize)
        return f"bytes{size}" if size <= MAX_BYTES_LENGTH else None
    if dtype.kind in "UT" or (
        dtype.kind == "O" and all(isinstance(text, str) for text in values.reshape(-1))
    ):
        return TEXT
    name = dtype.newbyteorder("=").name
    return name if name in DTYPES else None


def type_of_name(name: object) -> np.dtype[Any]:
    """The type of a name; texts are objects. Raises DamagedFileError for another name."""
    if isinstance(name, str):
        if name in DTYPES:
            return DTYPES[name]
        sized = _BYTES.fullmatch(name)
        if sized is not None and int(sized[1]) <= MAX_BYTES_LENGTH:
            return np.dtype(f"S{sized[1]}")
        if name == TEXT:
            return np.dtype(object)
    raise DamagedFileError(f"type {ascii(name)[:40]} is not known")


def inline_values(values: npt.NDArray[Any], name: str) -> list[Any] | None:
    """The values in C order as JSON values; None where these would not give every bit back.

    name: `stored_type` of the values.
    """
    flat = values.reshape(-1)
    if name == TEXT:
        texts = [str(text) for text in flat]
        return texts if all(_has_form(text) for text in texts) else None
    if values.dtype.kind == "S":
        return [bytes(text).decode("latin-1") for text in flat]
    listed = [_number(value) for value in flat]
    plain = values.astype(values.dtype.newbyteorder("="))
    return listed if inline_array(listed, name, plain.shape).tobytes() == plain.tobytes() else None


def inline_array(
    listed: object, name: str, shape: tuple[int, ...], most: int = MAX_BYTES
) -> npt.NDArray[Any]:
    """The array of a list of JSON values, of at most `most` bytes.

    Raises DamagedFileError where they are not its values.
    """
    dtype = type_of_name(name)
    if not isinstance(listed, list) or len(listed) != math.prod(shape):
        raise DamagedFileError(f"a list of {math.prod(shape)} values is needed")
    if len(listed) * dtype.itemsize > most:
        raise DamagedFileError(f"{len(listed)} values of type {name} take too many bytes")
    plain = _numbers(listed, dtype)
    if plain is not None:
        return plain.reshape(shape)
    result: npt.NDArray[Any] = np.empty(len(listed), dtype=dtype)
    for number, value in enumerate(listed):
        result[number] = _stored(value, dtype)
    return result.reshape(shape)


def typed_attribute(value: Any) -> Any:
    """An attribute as JSON values that keep its type.

    Raises UnknownValueError for a value that no container holds.
    """
    if isinstance(value, str):
        if any("\ud800" <= letter < "\udc80" for letter in value):
            raise UnknownValueError
        return plain_text(value)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, bytes):
        return typed_attribute(decoded_text(value))
    if isinstance(value, list) and value and all(isinstance(each, str) for each in value):
        return [typed_attribute(each) for each in value]
    if isinstance(value, Mapping | list | tuple) or value is None:
        return {JSON: attribute_json(value)}
    array = np.asarray(value)
    name = stored_type(array)
    if name is None or array.ndim > 1:
        raise UnknownValueError
    listed = inline_values(array, name)
    if listed is None:
        raise UnknownValueError
    plain: Any = listed if array.ndim else listed[0]
    natural = TEXT if name == TEXT else name if name in ("int64", "float64") else None
    finite = listed and not (name == "float64" and any(isinstance(each, str) for each in listed))
    return plain if natural is not None and finite else {name: plain}


def attribute_value(value: Any, most: int = MAX_BYTES) -> Any:
    """The attribute that JSON values stand for, of at most `most` bytes.

    Raises DamagedFileError for others.
    """
    if isinstance(value, str | bool):
        return value
    if isinstance(value, int | float):
        return _scalar(value, "int64" if isinstance(value, int) else "float64")
    if isinstance(value, list) and value:
        if all(isinstance(each, str) for each in value):
            return list(value)
        whole = all(type(each) is int for each in value)
        return inline_array(value, "int64" if whole else "float64", (len(value),), most)
    if isinstance(value, Mapping) and len(value) == 1:
        ((name, inner),) = value.items()
        if name == JSON:
            return inner
        if isinstance(inner, list):
            array = inline_array(inner, name, (len(inner),), most)
            return array.tolist() if name == TEXT else array
        return _scalar(inner, name)
    raise DamagedFileError(f"attribute {ascii(value)[:80]} has no known type")


def _scalar(value: Any, name: str) -> Any:
    """One value of a type."""
    return inline_array([value], name, (1,))[0]


def _numbers(listed: list[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any] | None:
    """The numbers of a list at once; None where one of them needs a closer look."""
    types = set(map(type, listed))
    if dtype.kind in "iu" and types == {int}:
        limits = np.iinfo(dtype)
        inside = limits.min <= min(listed) and max(listed) <= limits.max
        return np.array(listed, dtype=dtype) if inside else None
    if dtype.kind != "f" or not types <= {int, float}:
        return None
    try:
        with np.errstate(over="ignore"):
            numbers = np.array(listed, dtype=np.float64).astype(dtype)
    except OverflowError:
        return None
    return numbers if np.isfinite(numbers).all() else None


def _number(value: Any) -> Any:
    """A number as JSON has it: the shortest text that gives its bits back."""
    if value.dtype.kind in "iu":
        return int(value)
    if np.isnan(value):
        return "NaN"
    if np.isinf(value):
        return "Infinity" if value > 0 else "-Infinity"
    return float(str(value))


def _stored(value: Any, dtype: np.dtype[Any]) -> Any:
    """One JSON value as an element of an array of a type; raises DamagedFileError."""
    if dtype.kind == "O" and isinstance(value, str):
        return value
    if dtype.kind == "S" and isinstance(value, str) and len(value) <= dtype.itemsize:
        try:
            return value.encode("latin-1")
        except UnicodeEncodeError:
            pass
    if dtype.kind in "iu" and type(value) is int:
        limits = np.iinfo(dtype)
        if limits.min <= value <= limits.max:
            return value
    if dtype.kind == "f":
        if isinstance(value, str) and value in _NOT_FINITE:
            return _NOT_FINITE[value]
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                with np.errstate(over="ignore"):
                    narrow = dtype.type(value)
            except OverflowError:
                narrow = dtype.type(math.inf)
            if np.isfinite(narrow):
                return narrow
    raise DamagedFileError(f"{ascii(value)[:40]} is no value of type {dtype}")


def _has_form(text: str) -> bool:
    """Whether a text is Unicode that a file can hold, without lone surrogates."""
    return not any("\ud800" <= letter <= "\udfff" for letter in text)
