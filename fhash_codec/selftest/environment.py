"""Where the codec runs: what it reads from the environment, set for a while, and what there is of machine and libraries."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

import fhash_codec.native as codec_native
import fhash_formats.native as formats_native
from fhash_formats.support.threads import usable_threads

__all__ = ["environment", "surroundings"]


def surroundings() -> str:
    """Versions, machine and what is used of it, in a line. Loads torch."""
    from fhash_codec.training.devices import choose_device

    parts = [
        f"fhash {version('fhash')}",
        f"Python {platform.python_version()}",
        f"numpy {version('numpy')}",
        f"torch {version('torch')}",
        f"{platform.system()} {platform.machine()}",
        f"{usable_threads()} processors",
        "native core" if native_code() else "without the native core",
        "CUDA" if choose_device("auto").type == "cuda" else "no CUDA",
    ]
    return ", ".join(parts)


def native_code() -> bool:
    """Whether both native libraries are there: that of the file format and that of the codec."""
    return formats_native.library() is not None and codec_native.library() is not None


@contextmanager
def environment(**variables: str) -> Iterator[None]:
    """Within it these variables of the process have these values: FHASH_NATIVE, FHASH_THREADS. Not for several threads at once."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
