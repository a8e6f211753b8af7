"""Loader of the native library: C++ kernels that are called through ctypes.

A call releases Python's global interpreter lock. The library is a part of the package: it is built
when the package is installed, and without it nothing works. tests/reference decodes the same bits
in numpy.

`PROTOTYPES` lists the exported functions that this package calls, with the types of their
arguments. Every kernel returns an int64: at least 0 for success, below 0 for an error (core.hpp).
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.errors import MissingDependencyError
from fhash_formats.support.threads import ForkLock

__all__ = [
    "ABI_VERSION",
    "ARRAY",
    "FLOAT",
    "FOLDER",
    "INTEGER",
    "PROTOTYPES",
    "REAL",
    "crc32c",
    "library",
    "load_library",
]

ABI_VERSION = 26
"""Number that `fhash_abi_version()` must return; it equals `FHASH_ABI` in core.hpp."""

ARRAY = ctypes.c_void_p
"""Argument type of a pointer: an address, None, a `c_void_p`, or a ctypes array or pointer."""
INTEGER = ctypes.c_int64
"""Argument type of a size, a count or a flag."""
REAL = ctypes.c_double
"""Argument type of a float64 number."""
FLOAT = ctypes.c_float
"""Argument type of a float32 number."""

Prototypes = Mapping[str, tuple[Any, ...]]
"""Argument types of native functions by name; the result of each is an int64."""

_TILE = (ARRAY, ARRAY)
"""Context and tile."""
_STREAM = (*_TILE, ARRAY, ctypes.c_size_t)

_TILES: Prototypes = {
    "fhash_context_create": (ctypes.c_uint64, ctypes.c_int32),
    "fhash_tile_decode": (*_STREAM, ctypes.c_int32, ARRAY, ARRAY, ARRAY),
    "fhash_tile_table": (*_STREAM, ctypes.c_int32, *(ARRAY,) * 4),
    "fhash_tile_uncorrected": (*_STREAM, *(ARRAY,) * 4),
    "fhash_tile_region": (*_STREAM, *(ARRAY,) * 4),
    "fhash_tile_part": (*_TILE, *(ARRAY,) * 4),
    "fhash_tile_fill": (*_TILE, ARRAY, ARRAY, ctypes.c_int32, ARRAY, ARRAY),
    "fhash_tile_forward": (*_TILE, *(ARRAY,) * 3),
    "fhash_tile_foretold": (*_TILE, *(ARRAY,) * 4),
    "fhash_tile_code": (*_TILE, *(ARRAY,) * 8),
    "fhash_plan": (*(ARRAY,) * 4,),
    "fhash_tile_free": (ARRAY,),
    "fhash_tile_bound": (ARRAY,),
    "fhash_tile_encode": (*_TILE, *(ARRAY,) * 4, ctypes.c_size_t, ARRAY, ARRAY),
}
"""Functions of fhash.h and part.cpp, whose result is an int32."""
_RESULTS = {"fhash_context_create": ctypes.c_void_p, "fhash_tile_bound": ctypes.c_size_t}
"""Other results."""

PROTOTYPES: Prototypes = {
    **_TILES,
    "fhash_encode_block": (*(ARRAY,) * 3, INTEGER),
    "fhash_decode_block": (ARRAY, INTEGER, ARRAY, ARRAY),
    "fhash_head_apply": (ARRAY, ARRAY, *(INTEGER,) * 3, *(ARRAY,) * 5, INTEGER, ARRAY),
    "fhash_crc32c": (ARRAY, INTEGER, INTEGER, INTEGER),
    "fhash_between": (ARRAY, ARRAY, INTEGER, ARRAY, INTEGER, ARRAY, ARRAY),
}
"""Functions of this package's library that Python calls."""

_ADVICE = "install the package again (pip install .)"
FOLDER = Path(__file__).parent
"""Folder of libfhash with its header and build files; also that of HDF5's plugin, libfhash."""
_LOCK = ForkLock()
_LOADED: dict[tuple[Path, str, int], ctypes.CDLL] = {}


class _Library(ctypes.CDLL):
    """A library; functions that libfhash does not export are found by `fhash_function`."""

    def __getitem__(self, name: Any) -> Any:
        try:
            return super().__getitem__(name)
        except AttributeError:
            find = super().__getitem__("fhash_function")
            find.restype, find.argtypes = ctypes.c_void_p, (ctypes.c_char_p,)
            address = find(name.encode("ascii"))
            if address is None:
                raise
            return self._FuncPtr(address)


def library() -> ctypes.CDLL:
    """The native library of this package; see `load_library`."""
    return load_library(FOLDER, "libfhash", ABI_VERSION, PROTOTYPES)


def crc32c(data: bytes | memoryview) -> int:
    """CRC-32C (Castagnoli) of some bytes."""
    given = data if isinstance(data, bytes) else np.frombuffer(data, dtype=np.uint8).ctypes.data
    return int(library().fhash_crc32c(given, len(data), 0, 0))


def load_library(
    folder: Path,
    name: str,
    abi_version: int,
    prototypes: Prototypes,
    *,
    version_symbol: str = "fhash_abi_version",
) -> ctypes.CDLL:
    """The native library `name` in a folder, its functions given their argument and result types.

    A library is loaded once. Safe to call from several threads.

    Args:
        folder: folder of the Python package to which the library belongs.
        name: file name of the library without its suffix.
        abi_version: number that the library's function `version_symbol` must return.
        prototypes: argument types of the functions that will be called.
        version_symbol: exported function without arguments that returns the library's ABI number.

    Raises:
        MissingDependencyError: the library is not there, cannot be loaded, lacks a function, or
            was built from other sources (another ABI number).
    """
    key = (folder, name, abi_version)
    if key not in _LOADED:
        with _LOCK:
            if key not in _LOADED:
                path = folder / f"{name}.so"  # on every system: ctypes asks for no other name
                if not path.is_file():
                    raise MissingDependencyError(f"there is no native library {path}: {_ADVICE}")
                _LOADED[key] = _load(path, abi_version, prototypes, version_symbol)
    return _LOADED[key]


def _load(path: Path, abi_version: int, prototypes: Prototypes, version_symbol: str) -> ctypes.CDLL:
    try:
        loaded = _Library(str(path))
        _declare(loaded, version_symbol, ())
        built = getattr(loaded, version_symbol)()
        if built != abi_version:
            raise MissingDependencyError(
                f"the native library {path} has ABI {built}, "
                f"this version of the package needs {abi_version}: {_ADVICE}"
            )
        for function, arguments in prototypes.items():
            _declare(loaded, function, arguments)
    except (OSError, AttributeError) as error:
        raise MissingDependencyError(
            f"the native library {path} cannot be used ({error}): {_ADVICE}"
        ) from error
    return loaded


def _declare(loaded: ctypes.CDLL, name: str, arguments: tuple[Any, ...]) -> None:
    function = getattr(loaded, name)
    function.argtypes = arguments
    function.restype = _RESULTS.get(name, ctypes.c_int32 if name in _TILES else ctypes.c_int64)
