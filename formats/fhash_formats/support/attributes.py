"""Attributes of variables and coordinates as JSON values, and those that no other file may take."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

STORAGE_NAMES = """CLASS NAME DIMENSION_LIST REFERENCE_LIST DIMENSION_LABELS _ARRAY_DIMENSIONS
_Netcdf4Dimid _Netcdf4Coordinates _NCProperties _nc3_strict"""
PLUMBING = frozenset(STORAGE_NAMES.split())
"""Attributes by which HDF5, NetCDF and zarr tie datasets together; they describe no values."""

PACKING_NAMES = """_FillValue missing_value scale_factor add_offset _Unsigned _Encoding dtype
valid_min valid_max valid_range"""
PACKING = frozenset(PACKING_NAMES.split())
"""Attributes that describe stored numbers and are wrong for unpacked ones.

A reader would undo a packing a second time. A valid range in packed units would hide good values
from readers that obey it.
"""

REFERENCE_NAMES = """coordinates grid_mapping bounds climatology cell_measures
ancillary_variables formula_terms compress geometry"""
REFERENCES = frozenset(REFERENCE_NAMES.split())
"""Attributes that name other variables of the same file."""


class _Unknown(Exception):
    """A value that JSON cannot hold."""


def json_attributes(
    attributes: Mapping[str, Any], *, without: frozenset[str] = PLUMBING
) -> dict[str, Any]:
    """The attributes as JSON values: numbers, text, lists, objects.

    Bytes are read as UTF-8. Not-a-number and infinities become text, as in zarr. References,
    compound values and others that JSON cannot hold are dropped, and so are the names in `without`.
    """
    result: dict[str, Any] = {}
    for name in attributes:
        if name not in without:
            try:
                result[str(name)] = _json_value(attributes[name])
            except (_Unknown, TypeError, OSError):
                # h5py raises TypeError or OSError for types of attributes that it does not know.
                continue
    return result


def text_of(value: Any) -> str:
    """An attribute as text; bytes are read as UTF-8, and invalid ones become U+FFFD."""
    return value.decode("utf-8", errors="replace") if isinstance(value, bytes) else str(value)


def plain_text(text: str) -> str:
    """The text with "?" for each lone surrogate, which no file can hold.

    Python makes lone surrogates of the bytes of file names that are no UTF-8.
    """
    return text.encode("utf-8", errors="replace").decode("utf-8")


def _json_value(value: Any) -> Any:
    if isinstance(value, str):
        return plain_text(value)
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, bytes):
        return text_of(value)
    if isinstance(value, float):
        # float() turns numpy's float64, which is a float as well, into Python's.
        return (
            float(value)
            if math.isfinite(value)
            else {math.inf: "Infinity", -math.inf: "-Infinity"}.get(value, "NaN")
        )
    if isinstance(value, np.ndarray | np.generic):
        if value.dtype.kind in "biufSUTO":
            return _json_value(value.tolist())
        if value.dtype.kind in "Mm":
            return np.asarray(value).astype(str).tolist()
        raise _Unknown
    if isinstance(value, Mapping):
        return {str(name): _json_value(member) for name, member in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(member) for member in value]
    raise _Unknown
