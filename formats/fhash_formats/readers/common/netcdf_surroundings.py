"""All that belongs to a variable of a NetCDF file, opened once more with nothing decoded."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.readers.common.cf_packing import Packing
from fhash_formats.readers.common.failures import refusing
from fhash_formats.readers.common.layout import Layout
from fhash_formats.readers.common.netcdf_store import (
    close_groups,
    magic_of,
    open_groups,
    quietly,
)
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.surroundings import (
    Stored,
    Wanted,
    metadata_of,
)
from fhash_formats.series import Coordinate
from fhash_formats.source_metadata import SourceMetadata

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["netcdf_metadata", "stored_variable"]


def netcdf_metadata(
    path: Path,
    handle: tuple[str, str],
    groups: Collection[str],
    layout: Layout,
    request: Request,
    coords: Mapping[str, Coordinate],
    packed: Packing | None,
    without: Collection[str],
) -> Callable[[], SourceMetadata]:
    """A function that reads what belongs to a variable.

    handle: group and name of the variable. groups: its own group and those around it, the nearest
        first. coords: positions of the axes. packed: how the values are
        packed; None where they are read as they are stored. without: attributes that do not hold
        for the values.
    """

    def read() -> SourceMetadata:
        source = str(path)
        with refusing(f"{source} cannot be read as NetCDF"):
            with quietly():
                opened = open_groups(source, path, magic_of(path), decoded=False)
            try:
                scope = [opened[group] for group in groups if group in opened]
                variables = {
                    str(name): stored_variable(array)
                    for dataset in reversed(scope)
                    for name, array in dataset.variables.items()
                }
                used = [each.name for each in coords.values()]
                wanted = Wanted(
                    source=source, name=handle[1], used=used, without=without, path=path
                )
                attributes = scope[0].attrs
                return metadata_of(
                    handle[1], variables, attributes, layout, request, wanted, packed, coords["t"]
                )
            finally:
                close_groups(opened)

    return read


def stored_variable(array: xr.Variable) -> Stored:
    """A variable of a dataset of which nothing was decoded."""
    return Stored(
        dimensions=tuple(map(str, array.dims)),
        shape=array.shape,
        dtype=array.dtype,
        attributes=dict(array.attrs),
        read=partial(_values, array),
    )


def _values(array: xr.Variable, places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
    with quietly():
        values: npt.NDArray[Any] = array[places].to_numpy()
    # without what xarray notes of the stored type, such as enumerations
    return values if values.dtype.kind == "O" else np.asarray(values, dtype=values.dtype.str)
