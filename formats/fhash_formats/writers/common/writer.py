"""The contract of a writer: one small file per format makes one `Writer`, and `registry` lists them.

A writer never sees more than one frame. `open` writes what comes before the values and gives a function that is called
with (step, frame) once per step, in order; when the block ends it writes what comes after them. It writes to temporary
paths and cleans nothing up: `atomic` turns them into outputs, or removes them if anything fails.
Frames arrive checked: (z, y, x), C-contiguous, of `region.dtype`, as many as the region has steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fhash_formats.support.slabs import slab_shape
from fhash_formats.writers.common.region import Region

Frame = npt.NDArray[Any]
Put = Callable[[int, Frame], None]

CHUNK_BYTES = 16 * 2**20


@dataclass(frozen=True, kw_only=True)
class Writer:
    """One format.

    Attributes:
        name: for messages.
        suffixes: of the outputs it writes, lower case with the dot.
        outputs: (path, region) -> every path that is going to be written, in the order in which they take their names;
            raises InputError where the format cannot hold the region.
        open: (region, outputs, temporaries) -> context manager giving the function that takes the frames; the
            temporaries stand for the outputs one by one.
        directory: whether the output is a directory.
        module: optional library that must be installed, "" for none.
    """

    name: str
    suffixes: tuple[str, ...]
    outputs: Callable[[Path, Region], list[Path]]
    open: Callable[[Region, Sequence[Path], Sequence[Path]], AbstractContextManager[Put]]
    directory: bool = False
    module: str = ""


def one_output(path: Path, region: Region) -> list[Path]:
    """The outputs of a format that writes just the path it is given."""
    return [path]


def little_endian(dtype: np.dtype[Any], *, half: bool = False) -> np.dtype[Any]:
    """The type in which values are stored: little-endian; float16 becomes float32, exactly, unless the format has `half`."""
    stored = np.dtype(np.float32) if dtype == np.float16 and not half else dtype
    return stored.newbyteorder("<")


def write_frame(handle: BinaryIO, frame: Frame, dtype: np.dtype[Any]) -> None:
    """The values of a frame (z, y, x), x fastest, in `dtype`; converted one z at a time, so that no second frame is made."""
    for plane in frame:
        handle.write(np.ascontiguousarray(plane, dtype=dtype).data)


def chunk_shape(region: Region) -> tuple[int, int, int, int]:
    """Chunks (1, z, y, x): one frame, or where a frame is above 16 MiB equal slabs of it along z, then y, then x.

    One step is read with one access, and no reader has to hold a huge chunk for a small region.
    """
    z, y, x = slab_shape(region.shape[1:], region.dtype.itemsize, CHUNK_BYTES)
    return 1, z, y, x
