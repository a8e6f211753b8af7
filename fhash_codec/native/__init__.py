"""Loader of the codec's native library: the C++ of the ray marcher, of the quality figures,
of the products of lines, of the prices of transforms and of the training of heads.

It is a library beside that of `fhash_formats.native`, loaded in the same way.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

from fhash_formats.native import ARRAY, INTEGER, REAL, Prototypes, load_library

__all__ = ["ABI_VERSION", "PROTOTYPES", "library"]

ABI_VERSION = 9
"""Number that `fhash_codec_abi_version()` must return; it equals `FHASH_CODEC_ABI` in codec.cpp."""

_KINDS = ("f32", "f64")
_SCAN = (ARRAY, INTEGER, INTEGER, REAL, ARRAY)
_ERRORS = (ARRAY, ARRAY, ARRAY, INTEGER, INTEGER, REAL, REAL, REAL, ARRAY)
_HISTOGRAM = (ARRAY, INTEGER, REAL, REAL, REAL, INTEGER, ARRAY)
_SSIM = (ARRAY,) * 7

PROTOTYPES: Prototypes = {
    # march.cpp
    "fhash_march": (ARRAY, INTEGER, INTEGER, INTEGER, ARRAY),
    # march_bricks.cpp
    "fhash_march_bricks": (*(ARRAY,) * 4, *(INTEGER,) * 3, *(ARRAY,) * 3),
    "fhash_march_distance_layers": (ARRAY, ARRAY, INTEGER, INTEGER, ARRAY),
    "fhash_march_distance_rows": (ARRAY, ARRAY, INTEGER, INTEGER, ARRAY),
    "fhash_march_cells": (*(ARRAY,) * 4, INTEGER, ARRAY, INTEGER, INTEGER, ARRAY),
    # march_light.cpp
    "fhash_march_extinction": (
        *(*(ARRAY,) * 3, INTEGER, REAL, REAL, INTEGER, ARRAY),
        *(INTEGER, INTEGER, ARRAY, ARRAY, ARRAY),
    ),
    "fhash_march_sum": (*(ARRAY,) * 3, *(INTEGER,) * 3, ARRAY),
    # march_slopes.cpp
    "fhash_march_smooth_layers": (*(ARRAY,) * 3, *(INTEGER,) * 3, ARRAY, ARRAY),
    "fhash_march_smooth_rows": (*(ARRAY,) * 3, *(INTEGER,) * 3, ARRAY),
    "fhash_march_factors": (*(ARRAY,) * 4, *(INTEGER,) * 3, ARRAY),
    # quality.cpp
    **{f"fhash_scan_{kind}": _SCAN for kind in _KINDS},
    **{f"fhash_errors_{kind}": _ERRORS for kind in _KINDS},
    **{f"fhash_histogram_{kind}": _HISTOGRAM for kind in _KINDS},
    **{f"fhash_ssim_{kind}": _SSIM for kind in _KINDS},
    "fhash_magnitudes": (ARRAY, INTEGER, INTEGER, ARRAY, ARRAY),
    # gram.cpp
    **{f"fhash_gram_{kind}": (*(ARRAY, INTEGER, INTEGER, INTEGER), REAL, ARRAY) for kind in _KINDS},
    # head_inputs.cpp
    "fhash_head_inputs": (
        *(*(ARRAY,) * 4, INTEGER, ARRAY),
        *(*(REAL,) * 4, ARRAY),
    ),
    # train_head.cpp
    "fhash_head_learn": (*(ARRAY,) * 11, *(INTEGER,) * 4),
    "fhash_head_errors": (*(ARRAY,) * 7, INTEGER, ARRAY),
}
"""Functions of this package's library that Python calls."""

_FOLDER = Path(__file__).parent


def library() -> ctypes.CDLL:
    """The native library of this package; see `fhash_formats.native.load_library`."""
    return load_library(
        _FOLDER, "_codec", ABI_VERSION, PROTOTYPES, version_symbol="fhash_codec_abi_version"
    )
