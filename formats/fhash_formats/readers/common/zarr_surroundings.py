"""All that belongs to an array of a zarr hierarchy, as xarray writes and reads it there."""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.readers.common.cf_packing import Packing
from fhash_formats.readers.common.failures import refusing
from fhash_formats.readers.common.layout import Layout
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.surroundings import (
    Stored,
    Wanted,
    metadata_of,
    named_dimensions,
)
from fhash_formats.readers.common.variables import MIN_DIMENSIONS
from fhash_formats.series import Coordinate
from fhash_formats.source_metadata import SourceMetadata
from fhash_formats.support.attributes import PLUMBING

if TYPE_CHECKING:
    import zarr

__all__ = ["dimension_names", "zarr_metadata"]

FILL = "_FillValue"


def dimension_names(array: zarr.Array[Any]) -> list[str | None]:
    """Name of each dimension, None for one without a name.

    Format 3 has a field for them, xarray an attribute in format 2.
    """
    names: Any = array.attrs.get("_ARRAY_DIMENSIONS") or getattr(
        array.metadata, "dimension_names", None
    )
    if not isinstance(names, list | tuple) or len(names) != array.ndim:
        return [None] * array.ndim
    return [str(name) if name is not None else None for name in names]


def zarr_metadata(
    root: Path,
    path: str,
    arrays: Mapping[str, zarr.Array[Any]],
    groups: Mapping[str, Mapping[str, Any]],
    layout: Layout,
    request: Request,
    coords: Mapping[str, Coordinate],
    packed: Packing | None,
    without: Collection[str],
) -> Callable[[], SourceMetadata | None]:
    """A function that reads what belongs to an array.

    It gives None where dimensions have no names, and nothing but positions lies beside the array.

    root: of the hierarchy. path: of the array in it. arrays, groups: all of them, and the
    attributes of groups. The other arguments are those of `netcdf_metadata`.
    """

    def read() -> SourceMetadata | None:
        source = str(root)
        group, _, name = path.rpartition("/")
        with refusing(f"{source} cannot be read as zarr"):
            if not name:
                return None
            variables = {
                each.rpartition("/")[2]: stored
                for place in dict.fromkeys(["", group])  # those of the nearest place count
                for each, stored in _stored_in(arrays, place)
            }
            if None in dimension_names(arrays[path]):
                taken = {each.name.rpartition("/")[2] for each in coords.values()}
                if not any(
                    each not in (name, *taken) and len(stored.shape) < MIN_DIMENSIONS
                    for each, stored in variables.items()
                ):
                    return None
                own = tuple(named_dimensions(layout, coords))
                variables[name] = replace(variables[name], dimensions=own)
                for each in taken & variables.keys():  # positions have their own dimension
                    if variables[each].shape in [(length,) for length in layout.shape]:
                        variables[each] = replace(variables[each], dimensions=(each,))
            wanted = Wanted(
                source=source,
                name=name,
                used=[each.name.rpartition("/")[2] for each in coords.values()],
                without=without,
                path=root,
            )
            attributes = groups.get(group, {})
            return metadata_of(
                name, variables, attributes, layout, request, wanted, packed, coords["t"]
            )

    return read


def _stored_in(arrays: Mapping[str, zarr.Array[Any]], group: str) -> Sequence[tuple[str, Stored]]:
    """The arrays of a group; a dimension without a name has one of its own."""
    found = []
    for path, array in arrays.items():
        place, _, own = path.rpartition("/")
        if place != group:
            continue
        stored = Stored(
            dimensions=tuple(
                name or f"{own}_dim_{number}" for number, name in enumerate(dimension_names(array))
            ),
            shape=array.shape,
            dtype=np.dtype(array.dtype),
            attributes=_attributes(array),
            read=partial(_values, array),
        )
        found.append((path, stored))
    return found


def _attributes(array: zarr.Array[Any]) -> dict[str, Any]:
    """The attributes of an array, with the fill value in the type of the array."""
    found = {key: value for key, value in dict(array.attrs).items() if key not in PLUMBING}
    fill: Any = found.pop(FILL, None)
    if array.metadata.zarr_format == 2 and "_ARRAY_DIMENSIONS" in array.attrs:
        fill = array.fill_value if fill is None else fill
    dtype = np.dtype(array.dtype)
    if isinstance(fill, str) and dtype.kind == "f":
        fill = _decoded(fill)
    if fill is not None:
        try:
            found[FILL] = dtype.type(fill) if dtype.kind in "iuf" else fill
        except (ValueError, OverflowError, TypeError):
            found[FILL] = fill
    return found


def _decoded(text: str) -> Any:
    """A fill value of floats: a number as text, or base64 of a float64, as xarray writes it."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return struct.unpack("<d", base64.standard_b64decode(text))[0]
    except (struct.error, binascii.Error):
        return text


def _values(array: zarr.Array[Any], places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
    values = np.asarray(array[places])
    return values.astype(object) if values.dtype.kind in "TU" else values
