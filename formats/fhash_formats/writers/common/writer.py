"""The contract of a writer: each format is one `Writer`, and `registry` lists them.

A writer sees one frame at a time. `open` writes what precedes the values, and gives for each
variable a function that is called with (step, frame) once per step, in order, one variable after
the other; at the end of the block it writes what follows the values. It writes to temporary paths
and cleans nothing up: `support.atomic` turns them into outputs, or removes them if anything fails.
Frames arrive checked: (z, y, x), C-contiguous, of `region.dtype`, as many as the region has steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fhash_formats.support.slabs import slab_shape
from fhash_formats.writers.common.region import Region

Frame = npt.NDArray[Any]
Put = Callable[[int, Frame], None]
Open = Callable[
    [Sequence[Region], Sequence[Path], Sequence[Path]], AbstractContextManager[Sequence[Put]]
]
OpenOne = Callable[[Region, Sequence[Path], Sequence[Path]], AbstractContextManager[Put]]

CHUNK_BYTES = 16 * 2**20


@dataclass(frozen=True, kw_only=True)
class Writer:
    """One format.

    Attributes:
        name: name for messages.
        suffixes: suffixes of its outputs, lower case with the dot.
        outputs: (path, region) -> every path that will be written, in the order in which they take
            their names; raises InputError where the format cannot hold the region.
        open: (regions, outputs, temporaries) -> context manager that gives the functions for the
            frames; the temporaries stand for the outputs one by one. Safe names of regions differ.
        directory: whether the output is a directory.
        several: whether an output holds several variables; `outputs` then depends on none.
    """

    name: str
    suffixes: tuple[str, ...]
    outputs: Callable[[Path, Region], list[Path]]
    open: Open
    directory: bool = False
    several: bool = False


def of_one(open_one: OpenOne) -> Open:
    """The `open` of a format whose outputs hold one variable."""

    @contextmanager
    def opened(
        regions: Sequence[Region], outputs: Sequence[Path], temporaries: Sequence[Path]
    ) -> Iterator[Sequence[Put]]:
        (region,) = regions
        with open_one(region, outputs, temporaries) as put:
            yield [put]

    return opened


def one_output(path: Path, region: Region) -> list[Path]:
    """The outputs of a format that writes only the path it is given."""
    return [path]


def little_endian(dtype: np.dtype[Any], *, half: bool = False) -> np.dtype[Any]:
    """The type in which values are stored: little-endian.

    float16 becomes float32, exactly, unless the format has half precision (`half`).
    """
    stored = np.dtype(np.float32) if dtype == np.float16 and not half else dtype
    return stored.newbyteorder("<")


def write_frame(handle: BinaryIO, frame: Frame, dtype: np.dtype[Any]) -> None:
    """Write the values of a frame (z, y, x) in `dtype`, x fastest.

    They are converted one z at a time, so that there is no second frame in memory.
    """
    for plane in frame:
        handle.write(np.ascontiguousarray(plane, dtype=dtype).data)


def chunk_shape(region: Region) -> tuple[int, int, int, int]:
    """Shape of chunks (1, z, y, x).

    A chunk is one frame; frames above 16 MiB are cut into equal slabs along z, then y, then x. So
    one access reads one step, and no reader has to hold a huge chunk for a small region.
    """
    z, y, x = slab_shape(region.shape[1:], region.dtype.itemsize, CHUNK_BYTES)
    return 1, z, y, x
