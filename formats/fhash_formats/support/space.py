"""Room on disks: whether an output of known size fits, before hours go into it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from fhash_formats.errors import OutputError

__all__ = ["check_space"]


def check_space(path: str | Path, needed: int) -> None:
    """Raise OutputError where the disk of an output has less than `needed` bytes free.

    A folder that does not exist or cannot be asked is not refused here: writing says what is wrong.
    """
    folder = Path(os.path.realpath(path)).parent
    try:
        free = shutil.disk_usage(folder).free
    except OSError:
        return
    if free < needed:
        raise OutputError(
            f"{path}: up to {_size(needed)} are needed, and the disk of {folder} has"
            f" {_size(free)} free; make room, or choose another folder"
        )


def _size(count: int) -> str:
    """Bytes for people, in decimal units."""
    value, unit = float(count), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 999.5:
            break
        value, unit = value / 1000, larger
    return f"{value:.3g} {unit}"
