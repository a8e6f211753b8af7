"""Loader of the network's native library: the C++ of training and evaluating the paper's network.

It is a library of its own because it is compiled with contraction into fused multiply-adds, which
would change the bits of a stream elsewhere. It is loaded like that of `fhash_formats.native`; `ffi`
knows what network.h declares.
"""

from __future__ import annotations

from pathlib import Path

from fhash_codec.native.network.declarations import ffi
from fhash_formats.native import Library, load_library, pointer

__all__ = [
    "ABI_VERSION",
    "PATHS",
    "Library",
    "best_path",
    "ffi",
    "library",
    "machine_paths",
    "pointer",
]

ABI_VERSION = 5
"""Number that `fhash_network_abi_version()` must return, and `FHASH_NETWORK_ABI` in network.cpp."""

PATHS = {"x86-64-v4": 4, "x86-64-v3": 2, "baseline": 1}
"""Instructions that the kernels are compiled for, the fastest first, with their bits."""

_FOLDER = Path(__file__).parent


def library() -> Library:
    """The native library of this package; see `fhash_formats.native.load_library`."""
    return load_library(
        _FOLDER, "_network", ABI_VERSION, ffi, version_symbol="fhash_network_abi_version"
    )


def machine_paths() -> list[str]:
    """Return the names of the instructions that the kernels can use here, the fastest first."""
    bits = library().fhash_network_paths()
    return [name for name, bit in PATHS.items() if bits & bit]


def best_path(native: Library) -> int:
    """Return the path with the widest vectors that this machine has, a bit; 0 for none."""
    return 1 << int(native.fhash_network_paths()).bit_length() >> 1
