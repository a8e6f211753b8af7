"""Any value as JSON values: what JSON cannot hold becomes null, or text in attributes.

JSON has no NaN, no infinities, no numbers beyond float64, no bytes, no numpy types and no lone
surrogates. Two rules replace these. Figures (headers, histories, reports) become null. Attributes
of a source become text, as in Zarr: "NaN", "Infinity", "-Infinity", or the digits of a number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

__all__ = ["UnknownValueError", "attribute_json", "decoded_text", "plain_json", "plain_text"]

MAX_DEPTH = 24
"""Objects and lists within each other; what lies deeper cannot be held."""
_NUMBERS = "biufSUTO"
"""Kinds of numpy types whose values have a form in JSON."""


class UnknownValueError(Exception):
    """A value that has no form in JSON."""


def plain_json(value: Any) -> Any:
    """A figure, or a list or object of figures, as JSON values.

    Numpy's numbers and arrays become numbers and lists. NaN, infinities, numbers beyond float64 and
    values of other kinds become null.
    """
    return _converted(value, 0, is_figure=True)


def attribute_json(value: Any) -> Any:
    """An attribute as JSON values.

    NaN, infinities and numbers beyond float64 become text. Raises UnknownValueError for values of
    other kinds.
    """
    return _converted(value, 0, is_figure=False)


def decoded_text(data: bytes) -> str:
    """Bytes as text: UTF-8, else Latin-1, in which older programs wrote units such as "\u00b0C"."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def plain_text(text: str) -> str:
    """The text without lone surrogates, which no file can hold.

    Python makes those of bytes that are no UTF-8: they are read as Latin-1. "?" stands for others.
    """
    if not any("\udc80" <= letter <= "\udcff" for letter in text):
        return text.encode("utf-8", errors="replace").decode("utf-8")
    letters = (chr(ord(c) - 0xDC00) if "\udc80" <= c <= "\udcff" else c for c in text)
    return plain_text("".join(letters))


def _converted(value: Any, depth: int, *, is_figure: bool) -> Any:
    """A value as JSON values, by the rule of figures or of attributes."""
    if isinstance(value, str):
        return plain_text(value)
    if value is None or isinstance(value, bool | np.bool_):
        return None if value is None else bool(value)
    if isinstance(value, int | float | np.number) and not isinstance(value, np.complexfloating):
        return _number(value, is_figure=is_figure)
    if isinstance(value, bytes):
        return decoded_text(value)
    if depth < MAX_DEPTH:
        if isinstance(value, np.ndarray | np.generic):
            if value.dtype.kind in "Mm":
                return np.asarray(value).astype(str).tolist()
            if value.dtype.kind in _NUMBERS:
                return _converted(value.tolist(), depth, is_figure=is_figure)
        if isinstance(value, Mapping):
            return {
                plain_text(str(name)): _converted(member, depth + 1, is_figure=is_figure)
                for name, member in value.items()
            }
        if isinstance(value, list | tuple):
            return [_converted(member, depth + 1, is_figure=is_figure) for member in value]
    if is_figure:
        return None
    raise UnknownValueError


def _number(value: Any, *, is_figure: bool) -> Any:
    """A number of Python or numpy as an int or float; null or text where float64 cannot hold it."""
    try:
        wide = float(value)
    except OverflowError:
        wide = math.inf
    if math.isfinite(wide):
        return int(value) if isinstance(value, int | np.integer) else wide
    if is_figure:
        return None
    if isinstance(value, int):
        try:
            return str(value)
        except ValueError as error:  # Python refuses to write out thousands of digits
            raise UnknownValueError from error
    if value != value:
        return "NaN"
    if value in (math.inf, -math.inf):
        return "Infinity" if value > 0 else "-Infinity"
    return str(value)  # a long double beyond float64
