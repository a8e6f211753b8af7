"""Loader of the native library: C++ kernels that are called through cffi.

A call releases Python's global interpreter lock. The library is a part of the package: it is built
when the package is installed, and without it nothing works. tests/reference decodes the same bits
in numpy.

`ffi` knows the functions and structures of fhash.h and functions.h. Every kernel returns an int64:
at least 0 for success, below 0 for an error (core.hpp). Arrays are given as `pointer(array)`, and
sizes and other few numbers as a tuple or a list; cffi refuses a pointer to another type.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import MissingDependencyError
from fhash_formats.support.threads import ForkLock

try:
    from fhash_formats.native.declarations import ffi
except ModuleNotFoundError as error:
    raise MissingDependencyError(
        f"the native library was not built ({error}): install the package again (pip install .)"
    ) from error

__all__ = [
    "ABI_VERSION",
    "FOLDER",
    "Library",
    "crc32c",
    "ffi",
    "library",
    "load_library",
    "pointer",
]

ABI_VERSION = 28
"""Number that `fhash_abi_version()` must return; it equals `FHASH_ABI` in core.hpp."""
FOLDER = Path(__file__).parent
"""Folder of libfhash with its header and build files; also that of HDF5's plugin, libfhash."""

_ADVICE = "install the package again (pip install .)"
_LOCK = ForkLock()
_LOADED: dict[tuple[Path, str, int], Library] = {}
_TYPES = {
    np.dtype(name): ffi.typeof(f"{kind}[]")
    for name, kind in {
        **{
            f"{sign}int{bits}": f"{sign}int{bits}_t"
            for sign in ("", "u")
            for bits in (8, 16, 32, 64)
        },
        **{"float32": "float", "float64": "double", "bool": "uint8_t", "float16": "uint16_t"},
    }.items()
}
"""Types of C of arrays."""


class Library:
    """Functions of a loaded library by their names; those that are not exported are found, too."""

    def __init__(self, ffi: Any, path: Path) -> None:
        self._ffi, self._exported = ffi, ffi.dlopen(str(path))

    def __getattr__(self, name: str) -> Any:
        try:
            function = getattr(self._exported, name)
        except AttributeError:
            # A type of the function's name stands for it (setup.py).
            address = self._exported.fhash_function(name.encode("ascii"))
            if not address:
                raise
            function = self._ffi.cast(f"{name} *", address)
        setattr(self, name, function)
        return function


def library() -> Library:
    """The native library of this package; see `load_library`."""
    return load_library(FOLDER, "libfhash", ABI_VERSION, ffi)


def pointer(array: npt.NDArray[Any] | None) -> Any:
    """The numbers of a contiguous array, as a function of C takes them; NULL for None.

    Whoever keeps the pointer keeps the array.
    """
    return ffi.NULL if array is None else ffi.from_buffer(_TYPES[array.dtype], array)


def crc32c(data: bytes | memoryview) -> int:
    """CRC-32C (Castagnoli) of some bytes."""
    return int(library().fhash_crc32c(ffi.from_buffer(data), len(data), 0, 0))


def load_library(
    folder: Path,
    name: str,
    abi_version: int,
    ffi: Any,
    *,
    version_symbol: str = "fhash_abi_version",
) -> Library:
    """The native library `name` in a folder.

    A library is loaded once. Safe to call from several threads.

    Args:
        folder: folder of the Python package to which the library belongs.
        name: file name of the library without its suffix.
        abi_version: number that the library's function `version_symbol` must return.
        ffi: declarations of its functions.
        version_symbol: function without arguments that returns the library's ABI number.

    Raises:
        MissingDependencyError: the library is not there, cannot be loaded, lacks that function, or
            was built from other sources (another ABI number).
    """
    key = (folder, name, abi_version)
    if key not in _LOADED:
        with _LOCK:
            if key not in _LOADED:
                path = folder / f"{name}.so"  # on every system: cffi asks for no other name
                if not path.is_file():
                    raise MissingDependencyError(f"there is no native library {path}: {_ADVICE}")
                _LOADED[key] = _load(path, abi_version, ffi, version_symbol)
    return _LOADED[key]


def _load(path: Path, abi_version: int, ffi: Any, version_symbol: str) -> Library:
    try:
        loaded = Library(ffi, path)
        built = getattr(loaded, version_symbol)()
    except (OSError, AttributeError) as error:
        raise MissingDependencyError(
            f"the native library {path} cannot be used ({error}): {_ADVICE}"
        ) from error
    if built != abi_version:
        raise MissingDependencyError(
            f"the native library {path} has ABI {built}, "
            f"this version of the package needs {abi_version}: {_ADVICE}"
        )
    return loaded
