"""Loader of the codec's native library: the C++ of the ray marcher, of the quality figures,
of the products of lines, of the prices of transforms and of the training of heads.

It is a library beside that of `fhash_formats.native`, loaded in the same way; `ffi` knows what
codec.h declares.
"""

from __future__ import annotations

from pathlib import Path

from fhash_codec.native.declarations import ffi
from fhash_formats.native import Library, load_library, pointer

__all__ = ["ABI_VERSION", "Library", "ffi", "library", "pointer"]

ABI_VERSION = 9
"""Number that `fhash_codec_abi_version()` must return; it equals `FHASH_CODEC_ABI` in codec.cpp."""

_FOLDER = Path(__file__).parent


def library() -> Library:
    """The native library of this package; see `fhash_formats.native.load_library`."""
    return load_library(
        _FOLDER, "_codec", ABI_VERSION, ffi, version_symbol="fhash_codec_abi_version"
    )
