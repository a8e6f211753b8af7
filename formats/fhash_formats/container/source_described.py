"""Writing of all that belongs to a variable: the header's `source` and arrays `auxiliary/...`.

FORMAT.md, Source metadata, is the norm; `source_entry` reads it. A coordinate that has the bits of
one of the four positions is written by reference, a small array into the header, a larger one as an
array of its own.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.source_entry import AUXILIARY, narrowed
from fhash_formats.errors import InputError
from fhash_formats.series import AXES, Coordinate
from fhash_formats.source_metadata import SourceMetadata, SourceVariable
from fhash_formats.support.number_types import DTYPES
from fhash_formats.support.plain_json import UnknownValueError
from fhash_formats.support.typed_values import inline_values, stored_type, typed_attribute

__all__ = ["describe_metadata"]

MAX_INLINE = 256
"""Values of an array that is written into the header. One of its own takes some 450 bytes more."""
_PLAIN = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,99}")


def describe_metadata(
    metadata: SourceMetadata,
    coords: Mapping[str, Coordinate],
    attributes: Mapping[str, Any],
) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """The header's `source`, and the arrays by name that belong to it.

    coords: those of the container, for "t", "z", "y" and "x". attributes: `variable.attributes` of
    the header; only what differs from them is written. Raises InputError for an attribute or array
    that no container holds.
    """
    names = {axis: coords[axis].name for axis in AXES}
    entry: dict[str, Any] = {
        "dimensions": [
            axis if axis and names[axis] == name else [name, axis]
            for name, axis in metadata.dimensions.items()
        ]
    }
    own = set(metadata.dimensions)
    lengths = {
        name: length
        for variable in metadata.variables
        for name, length in zip(variable.dimensions, variable.values.shape, strict=True)
        if name not in own
    }
    arrays: dict[str, npt.NDArray[Any]] = {}
    described = [_described(variable, metadata, coords, arrays) for variable in metadata.variables]
    optional = {
        "lengths": lengths,
        "variables": described,
        "variable": _difference(metadata.variable_attributes, attributes),
        "attributes": _difference(metadata.attributes, {}),
        "stored": metadata.stored,
        "file": metadata.file,
        "digest": metadata.digest,
    }
    return entry | {key: value for key, value in optional.items() if value}, arrays


def _described(
    variable: SourceVariable,
    metadata: SourceMetadata,
    coords: Mapping[str, Coordinate],
    arrays: dict[str, npt.NDArray[Any]],
) -> dict[str, Any]:
    """One entry of `variables`; an array that needs one of its own is added to `arrays`."""
    kind = stored_type(variable.values)
    if kind is None:
        raise InputError(f"{variable.name}: values of type {variable.values.dtype} have no form")
    values = variable.values if kind not in DTYPES else variable.values.astype(DTYPES[kind])
    axis = _same_positions(variable, values, metadata, coords) if kind in DTYPES else None
    if axis is not None:
        same = coords[axis].name == variable.name
        entry: dict[str, Any] = {"axis": axis} | ({} if same else {"name": variable.name})
        base = coords[axis].attributes if same else {}
        if variable.dimensions != (metadata.along(axis),):
            entry["dimensions"] = list(variable.dimensions)
    else:
        entry, base = {"name": variable.name}, {}
        if variable.dimensions:
            entry["dimensions"] = list(variable.dimensions)
        listed = inline_values(values, kind) if _fits_header(values) else None
        if listed is None:
            place = variable.name if _PLAIN.fullmatch(variable.name) else "variable"
            while place in {name.removeprefix(AUXILIARY) for name in arrays}:
                place += "_"
            entry["array"] = place
            arrays[AUXILIARY + place] = np.atleast_1d(values)
        else:
            entry["values"] = listed
    if kind != "float64":
        entry["dtype"] = kind
    if variable.is_coordinate != (axis is not None):
        entry["coordinate"] = variable.is_coordinate
    changed = _difference(variable.attributes, base)
    return entry | ({"attributes": changed} if changed else {})


def _fits_header(values: npt.NDArray[Any]) -> bool:
    """Whether values stand in the header: few of them, and texts in any case."""
    return values.size <= MAX_INLINE or values.dtype.kind not in "iuf"


def _same_positions(
    variable: SourceVariable,
    values: npt.NDArray[Any],
    metadata: SourceMetadata,
    coords: Mapping[str, Coordinate],
) -> str | None:
    """The axis whose positions are these values in every bit; None where there is none."""
    for axis in AXES:
        positions = coords[axis].values
        along = variable.dimensions == (metadata.along(axis),)
        scalar = variable.dimensions == () and coords[axis].name == variable.name
        if not (along or scalar) or values.size != positions.size:
            continue
        if values.dtype.kind in "iu" and not np.isfinite(positions).all():
            continue
        same = values.reshape(-1).astype(np.float64).tobytes() == positions.tobytes()
        if same and narrowed(positions, values.dtype).tobytes() == values.tobytes():
            return axis
    return None


def _difference(attributes: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes that a base of JSON values has not, or not so; null for those to be left out."""
    found: dict[str, Any] = {name: None for name in base if name not in attributes}
    for name, value in attributes.items():
        try:
            typed = typed_attribute(value)
        except UnknownValueError as error:
            raise InputError(f"attribute {name} has a value that cannot be stored") from error
        if name not in base or json.dumps(base[name]) != json.dumps(typed):
            found[name] = typed
    return found
