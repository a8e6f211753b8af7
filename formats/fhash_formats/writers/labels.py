"""Names and attributes as HDF5, NetCDF and Zarr can hold them, without what would change the meaning of the values."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fhash_formats.series import AXES, Coordinate
from fhash_formats.writers.region import Region

# The values are physical: whoever undid a packing left in the attributes would undo it twice.
PACKING = ("scale_factor", "add_offset", "_FillValue", "missing_value", "_Unsigned", "_Encoding", "dtype")
# A range in packed units, or a wrong one, hides good values in the readers that obey it.
RANGES = ("valid_range", "valid_min", "valid_max")
# Names of other variables of the source, which are not in the output.
REFERENCES = (
    "coordinates",
    "grid_mapping",
    "bounds",
    "climatology",
    "cell_measures",
    "ancillary_variables",
    "formula_terms",
    "compress",
    "geometry",
)
# What the file formats themselves keep among the attributes.
HDF5_OWN = ("CLASS", "NAME", "DIMENSION_LIST", "DIMENSION_LABELS", "REFERENCE_LIST")
NETCDF_OWN = ("_Netcdf4Dimid", "_Netcdf4Coordinates", "_NCProperties", "_nc3_strict", "_ARRAY_DIMENSIONS")
DROPPED = frozenset([*PACKING, *RANGES, *REFERENCES, *HDF5_OWN, *NETCDF_OWN])

# HDF5 keeps an attribute of at most 64 KiB in the header; text is not bound by it.
ATTRIBUTE_BYTES = 32 * 2**10


def safe_name(name: str) -> str:
    """A name that HDF5, NetCDF and Zarr take as one name: no slash, no control character, not only dots, no leading "__"."""
    safe = "".join("_" if char in "/\\" or not char.isprintable() else char for char in name).strip()
    if safe.startswith("__"):
        safe = "_" + safe.lstrip("_")
    return safe if safe.strip("._") else "values"


def safe_names(region: Region) -> tuple[str, dict[str, str]]:
    """The name of the variable and those of its coordinates by axis, all different."""
    variable = safe_name(region.name)
    used = {variable}
    names = {}
    for axis in AXES:
        name = unique = safe_name(region.coords[axis].name or axis)
        number = 2
        while unique in used:
            unique = f"{name}_{number}"
            number += 1
        used.add(unique)
        names[axis] = unique
    return variable, names


def variable_attributes(region: Region) -> dict[str, Any]:
    """The attributes of the values, JSON values: the region's own, its units, and its name where it had to be changed."""
    kept = _kept(region.attributes)
    if region.units:
        kept["units"] = region.units
    if safe_name(region.name) != region.name:
        kept.setdefault("long_name", region.name)
    return kept


def coordinate_attributes(axis: str, coordinate: Coordinate) -> dict[str, Any]:
    """The attributes of a coordinate, JSON values, with the CF attribute `axis` ("T", "Z", "Y", "X") where it has none."""
    return {"axis": axis.upper(), **_kept(coordinate.attributes)}


def hdf5_value(value: Any) -> Any:
    """A JSON value as an attribute of HDF5 and NetCDF: text, a number, a list of one kind of them, or else JSON text."""
    if isinstance(value, str):
        return value.replace("\0", "")
    if isinstance(value, bool):
        return np.int8(value)  # NetCDF has no boolean
    if isinstance(value, float):
        return np.float64(value)
    if isinstance(value, int) and -(2**63) <= value < 2**63:
        return np.int64(value)
    if isinstance(value, list) and value and len(value) * 8 <= ATTRIBUTE_BYTES:
        kinds = {type(item) for item in value}
        if kinds == {str}:
            return [item.replace("\0", "") for item in value]
        if kinds == {float} or (kinds == {int} and all(-(2**63) <= item < 2**63 for item in value)):
            return np.array(value)
    return json.dumps(value)


def _kept(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {str(key): _json(value) for key, value in attributes.items() if key and key not in DROPPED}


def _json(value: Any) -> Any:
    """The value in JSON's types; NaN and infinity, which JSON has not, as text."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): _json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
