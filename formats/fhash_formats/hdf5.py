"""The codec `fhash.transform` as a filter of HDF5: for h5py, h5netcdf, and xarray through it.

Importing this module registers the filter with h5py, which is all that reading needs. Other
programs that load HDF5 find it where `fhash hdf5-plugin-path` says. The documentation shows the
tools.
"""

from __future__ import annotations

import ctypes
import struct
from typing import Any

import h5py

from fhash_formats import native
from fhash_formats.transform.tile import DEFAULT_EFFORT, Quality, check_effort

FILTER = 34274
"""Number of the filter (native/hdf5_filter.cpp), from the range for private use."""
_VERSION = 1
"""First number of the client data."""
_KINDS = ("max_error", "max_error_rel", "step")
"""Kinds of a bound, by their number in the client data."""


class Transform(dict[str, Any]):
    """Keywords of `h5py.Group.create_dataset`, and `encoding` of xarray with engine h5netcdf.

        file.create_dataset("density", data=values, chunks=True, **Transform(max_error=0.01))

    They are `compression`, the number of the filter, and `compression_opts`, five numbers, which
    serve h5repack, nccopy and `nc_def_var_filter` as well. Datasets of float16 to float64 and
    integers can be coded; a chunk of up to 2^27 values is coded alone. HDF5 refuses others when the
    dataset is made.

    Args:
        max_error: as in `Quality`; exactly one of the three is given.
        max_error_rel: as in `Quality`, of each chunk.
        step: as in `Quality`.
        effort: as in `encode_chunk`: 1 is the fastest, 9 tries the most.

    Raises InputError.
    """

    def __init__(
        self,
        *,
        max_error: float | None = None,
        max_error_rel: float | None = None,
        step: float | None = None,
        effort: int = DEFAULT_EFFORT,
    ) -> None:
        check_effort(effort)
        quality = Quality(max_error=max_error, max_error_rel=max_error_rel, step=step)
        ((kind, bound),) = quality.to_dict().items()
        low, high = struct.unpack("<II", struct.pack("<d", bound))
        numbers = (_VERSION, low, high, _KINDS.index(kind), effort)
        super().__init__(compression=FILTER, compression_opts=numbers)


def _register() -> None:
    find = native.library().H5PLget_plugin_info
    find.restype, find.argtypes = ctypes.c_void_p, ()
    h5py.h5z.register_filter(find())


_register()
