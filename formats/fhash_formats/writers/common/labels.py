"""Names and attributes in the forms that HDF5, NetCDF and Zarr can hold.

Attributes that would change the meaning of the values are left out.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from fhash_formats.series import AXES, Coordinate
from fhash_formats.source_metadata import plain_form
from fhash_formats.support.attributes import PACKING, PLUMBING, REFERENCES, json_attributes
from fhash_formats.writers.common.region import Region

DROPPED = PACKING | PLUMBING | REFERENCES | {""}
"""Attributes that are left out.

Values are physical, so packing no longer holds; other variables of the source are not in the
output; no format has an attribute without a name.
"""

# HDF5 keeps an attribute of at most 64 KiB in the header; text is not bound by it.
ATTRIBUTE_BYTES = 32 * 2**10


def printable(text: str, instead: str = "_") -> str:
    """The text on one line, with `instead` for each control character."""
    return "".join(char if char.isprintable() else instead for char in text)


def safe_name(name: str) -> str:
    """A name that HDF5, NetCDF and Zarr take as one name; see `plain_form`."""
    return plain_form(name, default="values")


def safe_names(region: Region) -> tuple[str, dict[str, str]]:
    """Names of the variable and of its coordinates by axis, all different."""
    variable = safe_name(region.name)
    used = {variable}
    names = {}
    for axis in AXES:
        names[axis] = unused_name(region.coords[axis].name or axis, used)
    return variable, names


def unused_name(name: str, used: set[str]) -> str:
    """A safe name that is not in use; it is put among those that are."""
    unique = plain_form(name, used, default="values")
    used.add(unique)
    return unique


def variable_attributes(region: Region) -> dict[str, Any]:
    """Attributes of the values, as JSON values.

    They are the region's own, its units, and its name where that had to be changed.
    """
    kept = json_attributes(region.attributes, without=DROPPED)
    if region.units:
        kept["units"] = region.units
    if safe_name(region.name) != region.name:
        kept.setdefault("long_name", region.name)
    return kept


def coordinate_attributes(axis: str, coordinate: Coordinate) -> dict[str, Any]:
    """Attributes of a coordinate, as JSON values.

    The CF attribute `axis` ("T", "Z", "Y", "X") is added where it is missing.
    """
    return {"axis": axis.upper(), **json_attributes(coordinate.attributes, without=DROPPED)}


def hdf5_value(value: Any) -> Any:
    """A JSON value as an attribute of HDF5 and NetCDF.

    It is text, a number, a list of one kind of them, or else JSON text.
    """
    if isinstance(value, str):
        return value.replace("\0", "")
    if isinstance(value, bool):
        return np.int8(value)  # NetCDF has no boolean
    if isinstance(value, float):
        return np.float64(value)
    if isinstance(value, int) and -(2**63) <= value < 2**63:
        return np.int64(value)
    if isinstance(value, np.generic | np.ndarray):
        return value if value.dtype.kind in "iufSU" else hdf5_value(value.tolist())
    if isinstance(value, list) and value and len(value) * 8 <= ATTRIBUTE_BYTES:
        kinds = {type(item) for item in value}
        if kinds == {str}:
            return [item.replace("\0", "") for item in value]
        if kinds == {float} or (kinds == {int} and all(-(2**63) <= item < 2**63 for item in value)):
            return np.array(value)
    return json.dumps(value)
