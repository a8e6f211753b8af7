"""Names that a container may have: none of a data file, which is most often its source."""

from __future__ import annotations

from pathlib import Path

from fhash_formats.errors import InputError

__all__ = ["DATA_SUFFIXES", "check_name"]

DATA_SUFFIX_NAMES = """.npy .npz .h5 .hdf5 .hdf .he5 .nc .nc4 .netcdf .cdf .zarr .raw .vti .vtr .pvd
.pvti .pvtr .series .vtkhdf .nrrd .nhdr .mha .mhd .tif .tiff .vtp .ply"""
DATA_SUFFIXES = frozenset(DATA_SUFFIX_NAMES.split())
"""Suffixes of data files that are read or written. No container may have one of them.

Those that say nothing of their content (.zip, .bin, .dat) are allowed.
"""


def check_name(path: Path) -> None:
    """Raise InputError for a container named like a data file: most often the source itself."""
    if path.suffix.lower() in DATA_SUFFIXES:
        raise InputError(
            f"{path}: a container is not a {path.suffix} file; give it a name that ends in .fhz"
        )
