"""Loader of the network's native library: the C++ of training and evaluating the paper's network.

It is a library of its own because it is compiled with contraction into fused multiply-adds, which
would change the bits of a stream elsewhere. It is loaded like that of `fhash_formats.native` and
switched off by the same `FHASH_NATIVE=0`. Whoever calls a function of it also has a way without it.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

from fhash_formats.native import ARRAY, INTEGER, REAL, Prototypes, load_library

__all__ = ["ABI_VERSION", "PROTOTYPES", "library"]

ABI_VERSION = 1
"""Number that `fhash_network_abi_version()` must return, and `FHASH_NETWORK_ABI` in network.cpp."""

PROTOTYPES: Prototypes = {
    # peak.cpp
    "fhash_network_paths": (),
    "fhash_network_fma": (INTEGER, INTEGER),
    "fhash_network_copy": (ARRAY, ARRAY, INTEGER),
    # points.cpp
    "fhash_network_points": (*(ARRAY,) * 4, INTEGER, INTEGER, ARRAY, ARRAY),
    "fhash_network_still": (ARRAY, ARRAY, REAL, INTEGER, ARRAY),
    # train_bricks.cpp
    "fhash_bricks_work": (ARRAY,),
    "fhash_bricks_gaps": (ARRAY, INTEGER, INTEGER),
    "fhash_bricks_touch": (ARRAY,),
    "fhash_bricks_run": (ARRAY, INTEGER, INTEGER),
}
"""Functions of this package's library that Python calls."""

_FOLDER = Path(__file__).parent


def library() -> ctypes.CDLL | None:
    """The native library of this package, or None; see `fhash_formats.native.load_library`."""
    return load_library(
        _FOLDER, "_network", ABI_VERSION, PROTOTYPES, version_symbol="fhash_network_abi_version"
    )
