"""Readers of time-varying volumes: one file per format, and `registry` to find the right one.

`hdf5`, `netcdf`, `zarr_store`, `npy`, `raw`, `vtk_xml`, `vtkhdf`, `nrrd`, `metaimage` and `tiff`
are the formats. `joined` makes one series of many files, `pvd` of a list of files, `masks` opens a
mask over a series. `common/` holds what several formats share: the user's request, the choice of a
variable and of its axes, coordinates, packed values, stored bytes, errors.
"""

from fhash_formats.readers.common.file_series import RawLayout, parse_shape
from fhash_formats.readers.common.listing import Listed
from fhash_formats.readers.registry import (
    REGISTRY,
    Mask,
    Reader,
    list_variables,
    open_mask,
    open_series,
)

__all__ = [
    "REGISTRY",
    "Listed",
    "Mask",
    "RawLayout",
    "Reader",
    "list_variables",
    "open_mask",
    "open_series",
    "parse_shape",
]
