"""Writer of NumPy's .npy: the header, then the frames one by one; C order, (t, z, y, x)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from numpy.lib import format as npy_format

from fhash_formats.writers.common.region import Region
from fhash_formats.writers.common.writer import (
    Frame,
    Put,
    Writer,
    little_endian,
    of_one,
    one_output,
    write_frame,
)


@contextmanager
def _open(region: Region, outputs: Sequence[Path], temporaries: Sequence[Path]) -> Iterator[Put]:
    dtype = little_endian(region.dtype, half=True)
    header = {
        "descr": npy_format.dtype_to_descr(dtype),
        "fortran_order": False,
        "shape": region.shape,
    }
    with temporaries[0].open("xb") as handle:
        npy_format.write_array_header_1_0(handle, header)

        def put(step: int, frame: Frame) -> None:
            write_frame(handle, frame, dtype)

        yield put


NPY = Writer(name="NumPy", suffixes=(".npy",), outputs=one_output, open=of_one(_open))
