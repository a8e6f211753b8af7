"""NumPy's .npy: any byte order, C or Fortran order, never pickles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.readers.common.failures import Stamp, refusing
from fhash_formats.readers.common.fields import expand, reading
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.flat import FlatArray
from fhash_formats.readers.common.layout import Dimension, arrange
from fhash_formats.readers.common.listing import Listed, listing
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.variables import Variable, choose

MAGIC = b"\x93NUMPY"


def matches(head: bytes, path: Path) -> bool:
    """Whether this is .npy, or .npz, which is refused with advice."""
    return head.startswith(MAGIC) or path.suffix.lower() == ".npz"


class _Npy:
    """The header of a .npy file: its variables, one for each field of a structured array."""

    def __init__(self, path: Path, request: Request) -> None:
        self.source, self.stamp = str(path), Stamp.of(path)
        if path.suffix.lower() == ".npz":
            raise InputError(
                f"{self.source} is a NumPy archive; save its array alone: numpy.save('array.npy',"
                f" numpy.load('{path.name}')[NAME])"
            )
        with refusing(f"{self.source} cannot be read as .npy"):
            # opened as a map for its header only: type, shape, order and the offset of the values;
            # Python objects are refused by it
            header = np.load(path, mmap_mode="r", allow_pickle=False)
            self.shape, dtype, offset = header.shape, header.dtype, int(header.offset)
            self.fortran = header.flags.f_contiguous and not header.flags.c_contiguous
            del header
        # Fortran's order: the same bytes, read as C order with the dimensions reversed
        stored = self.shape[::-1] if self.fortran else self.shape
        self.array = FlatArray(path, stored, dtype, offset=offset)
        if self.array.end != self.stamp.size:
            raise InputError(
                f"{self.source} has {self.stamp.size} bytes, its header promises"
                f" {self.array.end}; the file is cut or holds more than one array"
            )
        whole = Variable(name=path.stem, shape=self.shape, dtype=dtype)
        self.variables = expand([whole])
        if self.variables == [whole]:
            request.refuse_var(self.source)

    def dimensions(self, variable: Variable) -> list[Dimension]:
        """The dimensions of a variable; none has a name."""
        return [Dimension(name=None, length=length) for length in variable.shape]

    def read(self, ranges: tuple[slice, ...]) -> Any:
        """Values of the stored array in ranges of its dimensions."""
        if self.fortran:
            return self.array.read(ranges[::-1]).transpose()
        return self.array.read(ranges)


def open_npy(path: Path, request: Request) -> FileSeries:
    """Open the series in a .npy file.

    Its dimensions are (t, z, y, x) or (z, y, x) unless the request names the axes.
    """
    found = _Npy(path, request)
    variable = choose(
        found.source,
        found.variables,
        request.var,
        booleans=request.booleans,
        selected=len(request.select),
    )
    layout = arrange(found.source, variable.name, found.dimensions(variable), request)
    stored = len(found.shape)
    return FileSeries(
        source=found.source,
        name=variable.name,
        shape=layout.shape,
        dtype=variable.dtype,
        axes=layout.axes,
        fetch=layout.fetch(reading(found.read, variable, stored)),
        stamp=found.stamp,
        attributes=layout.attributes(),
        # time as the fastest dimension: all steps are read together
        chunks=layout.chunks(variable.shape) if found.fortran else None,
    )


def list_npy(path: Path, request: Request) -> list[Listed]:
    """The variables of a .npy file."""
    found = _Npy(path, request)
    return listing(found.source, found.variables, found.dimensions, request)
