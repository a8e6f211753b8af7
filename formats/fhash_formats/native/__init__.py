"""The native kernels: one shared library of C++ sources, called through ctypes, which lets go of the interpreter lock.

Whatever the library computes has a portable twin in numpy with the same bits, so it is a matter of speed only: where no compiler was at
hand when the package was installed, or where the environment says `FHASH_NATIVE=0`, `library()` is None and the twins do the work.
"""

from __future__ import annotations

import ctypes
import os
import threading
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from fhash_formats.errors import MissingDependencyError

__all__ = ["ABI_VERSION", "library"]

ABI_VERSION = 6
"""The number that `fhash_abi_version()` must return; `FHASH_ABI` in core.hpp is its twin."""

_HERE = Path(__file__).parent
_LOCK = threading.Lock()
_LOADED: dict[Path, ctypes.CDLL | None] = {}


def library() -> ctypes.CDLL | None:
    """The loaded native library, or None where it was not built or the environment says `FHASH_NATIVE=0`.

    The library is loaded once; the environment is read at each call. Safe to call from several threads.

    Raises MissingDependencyError where a library is there but cannot be loaded or was built from other sources (another ABI number).
    """
    if os.environ.get("FHASH_NATIVE") == "0":
        return None
    if _HERE not in _LOADED:
        with _LOCK:
            if _HERE not in _LOADED:
                _LOADED[_HERE] = _load(_HERE)
    return _LOADED[_HERE]


def _load(folder: Path) -> ctypes.CDLL | None:
    path = next(
        (
            folder / f"_core{suffix}"
            for suffix in EXTENSION_SUFFIXES
            if (folder / f"_core{suffix}").is_file()
        ),
        None,
    )
    if path is None:
        return None
    advice = "install the package again (pip install .), or set FHASH_NATIVE=0 to do without"
    try:
        loaded = ctypes.CDLL(str(path))
        version = loaded.fhash_abi_version
    except (OSError, AttributeError) as error:
        raise MissingDependencyError(
            f"the native library {path} cannot be used ({error}): {advice}"
        ) from error
    version.argtypes = []
    version.restype = ctypes.c_int64
    if version() != ABI_VERSION:
        raise MissingDependencyError(
            f"the native library {path} has ABI {version()}, this version of the package needs {ABI_VERSION}: {advice}"
        )
    return loaded
