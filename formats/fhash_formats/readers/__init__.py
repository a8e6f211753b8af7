"""Readers of time-varying volumes: one file per format, `registry` to find the right one.

registry     formats, open_series             hdf5 netcdf zarr_store npy raw   the formats
request      what the user may say            joined        many files as one series
variables    which array is meant             masks         a mask over a series
roles        which dimension is which axis    lattice       frames in (z, y, x) from any order
positions    coordinates                      failures      errors in one line, files that change
hdf5_tree    the datasets of an HDF5 file     cf_packing    packed values in zarr
flat         values without chunks
"""

from fhash_formats.readers.common.request import RawLayout, parse_shape
from fhash_formats.readers.masks import Mask, open_mask
from fhash_formats.readers.registry import REGISTRY, Reader, open_series

__all__ = ["REGISTRY", "Mask", "RawLayout", "Reader", "open_mask", "open_series", "parse_shape"]
