"""Attributes of variables and coordinates as JSON values, and those that no other file may take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fhash_formats.support.plain_json import (
    UnknownValueError,
    attribute_json,
    decoded_text,
    plain_text,
)

__all__ = [
    "PACKING",
    "PLUMBING",
    "REFERENCES",
    "STORED",
    "json_attributes",
    "plain_text",
    "text_of",
]

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
ancillary_variables formula_terms compress geometry node_coordinates node_count
part_node_count interior_ring"""
REFERENCES = frozenset(REFERENCE_NAMES.split())
"""Attributes that name other variables of the same file."""


STORED = PLUMBING | PACKING | REFERENCES
"""Attributes that tell of a stored array and of its file, and not of its values."""


def json_attributes(
    attributes: Mapping[str, Any], *, without: frozenset[str] = PLUMBING
) -> dict[str, Any]:
    """The attributes as JSON values: numbers, text, lists, objects.

    Bytes are read as UTF-8, else as Latin-1. Not-a-number, infinities and numbers beyond float64
    become text, as in zarr. References, compound values and others that JSON cannot hold are
    dropped, and so are the names in `without`.
    """
    result: dict[str, Any] = {}
    for name in attributes:
        if name not in without:
            try:
                result[plain_text(str(name))] = attribute_json(attributes[name])
            except (UnknownValueError, TypeError, OSError):
                # h5py raises TypeError or OSError for types of attributes that it does not know.
                continue
    return result


def text_of(value: Any) -> str:
    """An attribute as text; see `decoded_text` for bytes."""
    return decoded_text(value) if isinstance(value, bytes) else str(value)
