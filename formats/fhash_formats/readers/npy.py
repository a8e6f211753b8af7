"""NumPy's .npy: any byte order, C or Fortran order, never pickles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.readers.common.failures import Stamp, refusing
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.flat import FlatArray
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.roles import assign_axes
from fhash_formats.readers.common.variables import Variable, choose

MAGIC = b"\x93NUMPY"


def matches(head: bytes, path: Path) -> bool:
    """Whether this is .npy, or .npz, which is refused with advice."""
    return head.startswith(MAGIC) or path.suffix.lower() == ".npz"


def open_npy(path: Path, request: Request) -> FileSeries:
    """Open the series in a .npy file.

    Its dimensions are (t, z, y, x) or (z, y, x) unless the request names the axes.
    """
    source, stamp = str(path), Stamp.of(path)
    if path.suffix.lower() == ".npz":
        raise InputError(
            f"{source} is a NumPy archive; save its array alone: numpy.save('array.npy',"
            f" numpy.load('{path.name}')[NAME])"
        )
    request.refuse_var(source)
    with refusing(f"{source} cannot be read as .npy"):
        # opened as a map for its header only: type, shape, order and the offset of the values;
        # Python objects are refused by it
        header = np.load(path, mmap_mode="r", allow_pickle=False)
        shape, dtype, offset = header.shape, header.dtype, int(header.offset)
        fortran = header.flags.f_contiguous and not header.flags.c_contiguous
        del header
    choose(
        source,
        [Variable(name=path.stem, shape=shape, dtype=dtype)],
        None,
        booleans=request.booleans,
    )
    axes = assign_axes(source, shape, [None] * len(shape), [None] * len(shape), request.axes)
    if fortran:
        # the last dimension is the slowest: the same bytes, read as C order with the dimensions
        # reversed
        shape, axes = shape[::-1], axes[::-1]
    array = FlatArray(path, shape, dtype, offset=offset)
    if array.end != stamp.size:
        raise InputError(
            f"{source} has {stamp.size} bytes, its header promises {array.end}; the file is cut or"
            " holds more than one array"
        )
    return FileSeries(
        source=source,
        name=path.stem,
        shape=shape,
        dtype=dtype,
        axes=axes,
        fetch=array.read,
        stamp=stamp,
    )
