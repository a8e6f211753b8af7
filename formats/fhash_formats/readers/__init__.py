"""Readers of time-varying volumes: one file per format, and `registry` to find the right one.

`hdf5`, `netcdf` (with `netcdf3`), `zarr_store` (with `zarr_coded`), `raw`, `vtk` (with
`vtk_document`), `images` and `tiff` are the formats; `joined` makes one series of many files.
`common/` holds what several formats share: the user's request, the choice of a variable and of its
axes, coordinates, packed values, stored bytes, errors. NetCDF, Zarr and VTK import `hdf5`, since
their files may be HDF5 too; no other format knows of another one, and none of the writers.
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
