"""The codec `fhash.transform` as a filter of HDF5: for h5py, h5netcdf, and xarray through it.

Importing this module registers the filter with h5py, and puts the folder of the plugin into
HDF5_PLUGIN_PATH, where libraries of HDF5 that are loaded later, as that of netCDF4 is, find it. For
other programs `fhash hdf5-plugin-path` prints it. The documentation shows the tools.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from typing import Any

import h5py

from fhash_formats import native
from fhash_formats.errors import InputError
from fhash_formats.transform.tile import (
    DEFAULT_EFFORT,
    Quality,
    check_effort,
    check_missing,
)

FILTER = 34274
"""Number of the filter (native/hdf5_filter.cpp), from the range for private use."""
_VERSION = 1
"""First number of the client data."""
_KINDS = ("max_error", "max_error_rel", "step")
"""Kinds of a bound, by their number in the client data."""
_DEFAULT_PATH = (
    os.path.expandvars("%ALLUSERSPROFILE%/hdf5/lib/plugin")
    if os.name == "nt"
    else "/usr/local/hdf5/lib/plugin"
)
"""Folder of plugins where HDF5_PLUGIN_PATH is not set (H5PL_DEFAULT_PATH of HDF5)."""
_MAX_MISSING = 8
"""Missing values beside the fill value (native/hdf5_filter.cpp)."""


class Transform(dict[str, Any]):
    """Keywords of `h5py.Group.create_dataset`, and `encoding` of xarray with engine h5netcdf.

        file.create_dataset("density", data=values, chunks=True, **Transform(max_error=0.01))

    They are `compression`, the number of the filter, and `compression_opts`, five numbers and two
    for each value of `missing`, which serve h5repack, nccopy and `nc_def_var_filter` as well.
    Datasets of float16 to float64 and integers can be coded; a chunk of up to 2^27 values is coded
    alone. HDF5 refuses others when the dataset is made. The fill value that a dataset declares
    comes back exactly, and takes no part in range and bound.

    Args:
        max_error: as in `Quality`; exactly one of the three is given.
        max_error_rel: as in `Quality`, of each chunk.
        step: as in `Quality`.
        effort: as in `encode_chunk`: 1 is the fastest, 9 tries the most.
        missing: values that stand for missing ones beside the dataset's fill value, at most 8: a
            filter does not see attributes such as `missing_value`.

    Raises InputError.
    """

    def __init__(
        self,
        *,
        max_error: float | None = None,
        max_error_rel: float | None = None,
        step: float | None = None,
        effort: int = DEFAULT_EFFORT,
        missing: Sequence[float] = (),
    ) -> None:
        check_effort(effort)
        check_missing(missing)
        if len(missing) > _MAX_MISSING:
            raise InputError(f"{len(missing)} missing values; at most {_MAX_MISSING} are possible")
        quality = Quality(max_error=max_error, max_error_rel=max_error_rel, step=step)
        ((kind, bound),) = quality.to_dict().items()
        numbers = (_VERSION, *_halves(bound), _KINDS.index(kind), effort)
        named = (half for value in missing for half in _halves(value))
        super().__init__(compression=FILTER, compression_opts=(*numbers, *named))


def _halves(number: float) -> tuple[int, ...]:
    """The lower and the upper 32 bits of a float64."""
    return struct.unpack("<II", struct.pack("<d", number))


def _register() -> None:
    address = native.ffi.cast("intptr_t", native.library().H5PLget_plugin_info())
    h5py.h5z.register_filter(int(address))
    known = os.environ.get("HDF5_PLUGIN_PATH", _DEFAULT_PATH)
    if str(native.FOLDER) not in known.split(os.pathsep):
        os.environ["HDF5_PLUGIN_PATH"] = os.pathsep.join((known, str(native.FOLDER)))


_register()
