"""Loader of the network's native library: the C++ of training and evaluating the paper's network.

It is a library of its own because it is compiled with contraction into fused multiply-adds, which
would change the bits of a stream elsewhere. It is loaded like that of `fhash_formats.native`.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

from fhash_formats.native import ARRAY, INTEGER, REAL, Prototypes, load_library

__all__ = ["ABI_VERSION", "PATHS", "PROTOTYPES", "best_path", "library", "machine_paths"]

ABI_VERSION = 5
"""Number that `fhash_network_abi_version()` must return, and `FHASH_NETWORK_ABI` in network.cpp."""

PROTOTYPES: Prototypes = {
    # peak.cpp
    "fhash_network_paths": (),
    "fhash_network_fma": (INTEGER, INTEGER),
    "fhash_network_copy": (ARRAY, ARRAY, INTEGER),
    # points.cpp
    "fhash_network_points": (*(ARRAY,) * 4, INTEGER, INTEGER, *(ARRAY,) * 3),
    "fhash_network_still": (ARRAY, ARRAY, REAL, INTEGER, ARRAY),
    # train_bricks.cpp
    "fhash_bricks_work": (ARRAY,),
    "fhash_bricks_gaps": (ARRAY, INTEGER, INTEGER),
    "fhash_bricks_touch": (ARRAY,),
    "fhash_bricks_run": (ARRAY, INTEGER, INTEGER),
}
"""Functions of this package's library that Python calls."""

PATHS = {"x86-64-v4": 4, "x86-64-v3": 2, "baseline": 1}
"""Instructions that the kernels are compiled for, the fastest first, with their bits."""

_FOLDER = Path(__file__).parent


def library() -> ctypes.CDLL:
    """The native library of this package; see `fhash_formats.native.load_library`."""
    return load_library(
        _FOLDER, "_network", ABI_VERSION, PROTOTYPES, version_symbol="fhash_network_abi_version"
    )


def machine_paths() -> list[str]:
    """Return the names of the instructions that the kernels can use here, the fastest first."""
    bits = library().fhash_network_paths()
    return [name for name, bit in PATHS.items() if bits & bit]


def best_path(native: ctypes.CDLL) -> int:
    """Return the path with the widest vectors that this machine has, a bit; 0 for none."""
    return 1 << int(native.fhash_network_paths()).bit_length() >> 1
