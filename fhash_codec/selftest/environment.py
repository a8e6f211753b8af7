"""The environment of the codec: variables that are set for a while, and a description of machine
and libraries."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

from fhash_codec.devices import choose_device, has_torch
from fhash_formats.support.threads import usable_threads

__all__ = ["describe_machine", "environment"]


def describe_machine() -> str:
    """Versions, machine and the parts of it that are used, in one line. Loads torch if it can."""
    facts = [
        f"fhash {version('fhash')}",
        f"Python {platform.python_version()}",
        f"numpy {version('numpy')}",
        f"torch {version('torch')}" if has_torch() else "no torch",
        f"{platform.system()} {platform.machine()}",
        f"{usable_threads()} processors",
        "CUDA" if has_torch() and choose_device("auto").type == "cuda" else "no CUDA",
    ]
    return ", ".join(facts)


@contextmanager
def environment(**variables: str) -> Iterator[None]:
    """Sets environment variables of this process, such as FHASH_THREADS, within a `with`
    block.

    Not for several threads at once: the environment belongs to the process.
    """
    previous = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
