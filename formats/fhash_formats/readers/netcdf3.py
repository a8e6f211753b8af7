"""Classic NetCDF files (NetCDF-3): CDF-1, CDF-2 and CDF-5.

The layout is that of the NetCDF classic format specification
(https://docs.unidata.ucar.edu/netcdf-c/current/file_format_specifications.html): a header with
dimensions, attributes and variables, big-endian; then the arrays, of which those along the
unlimited dimension are interleaved record by record. Names and texts are UTF-8, else Latin-1.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.file_series import Request, Stamp, refusing
from fhash_formats.readers.hdf5 import default_fill
from fhash_formats.readers.stored_bytes import MAX_HEADER
from fhash_formats.readers.variables import Source, Variable, file_source
from fhash_formats.support.values import decoded_text

MAGIC = (b"CDF\x01", b"CDF\x02", b"CDF\x05")
"""First bytes of classic files."""

DIMENSIONS = 10
"""Tag of the list of dimensions in a header; the tag 0 is that of an empty list."""
VARIABLES = 11
"""Tag of the list of variables."""
ATTRIBUTES = 12
"""Tag of a list of attributes."""
TYPES = ("i1", "S1", ">i2", ">i4", ">f4", ">f8", "u1", ">u2", ">u4", ">i8", ">u8")
"""numpy's names of the types, the first with number 1; those from number 7 on are of CDF-5."""
MAX_MEMBERS = 1 << 16
"""Dimensions, variables or attributes of a list; netCDF's own limits are 1024 and 8192."""
MAX_DIMENSIONS = 64
"""Dimensions of a variable, as numpy has them."""
PADDED = 4
"""Bytes to whose multiple names, attributes and arrays are filled up."""


def _read(
    path: Path,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    begin: int,
    strides: tuple[int, ...],
    places: tuple[slice | int, ...],
) -> npt.NDArray[Any]:
    """Values at a range or an index along each dimension, in the machine's byte order.

    The file is open no longer than that.
    """
    if 0 in shape:
        return np.empty(shape, dtype.newbyteorder("="))[places]
    with (
        path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped,
    ):
        stored: npt.NDArray[Any] = np.ndarray(shape, dtype, mapped, begin, strides)
        copied: npt.NDArray[Any] = stored[places].astype(dtype.newbyteorder("="))
        del stored  # the map cannot be closed before
    return copied


class _Bytes:
    """Numbers and names of a header, one after the other."""

    def __init__(self, data: bytes, *, wide: bool) -> None:
        self.data, self.at, self.wide = data, 4, wide

    def take(self, count: int) -> bytes:
        """The next bytes, and their padding passed over."""
        end = self.at + count
        if end > len(self.data):
            raise EOFError("its header is longer than the file")
        taken = self.data[self.at : end]
        self.at = end + -end % PADDED
        return taken

    def integer(self, size: int = 4) -> int:
        return int.from_bytes(self.take(size), "big")

    def count(self) -> int:
        """A count or a length, of 8 bytes in CDF-5."""
        return self.integer(8 if self.wide else 4)

    def members(self, tag: int) -> Iterator[str]:
        """The name of each member of a list, before the rest of the member is read."""
        found, count = self.integer(), self.count()
        if found not in (tag, 0) or (not found and count):
            raise ValueError(f"its header has the tag {found} in place of {tag}")
        if count > MAX_MEMBERS:
            raise ValueError(f"its header has a list of {count}; {MAX_MEMBERS} are possible")
        for _ in range(count):
            yield decoded_text(self.take(self.count()))

    def type(self) -> str:
        number = self.integer()
        if not 1 <= number <= (len(TYPES) if self.wide else 6):
            raise ValueError(f"its header names the unknown type {number}")
        return TYPES[number - 1]

    def attributes(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name in self.members(ATTRIBUTES):
            dtype, count = self.type(), self.count()
            data = self.take(count * np.dtype(dtype).itemsize)
            if dtype == "S1":
                text = data.rstrip(b"\0")
                found[name] = text if name == "_FillValue" else decoded_text(text)
            else:
                numbers = np.frombuffer(data, dtype)
                found[name] = numbers[0] if count == 1 else numbers
        return found


def read_header(path: Path) -> tuple[dict[str, Any], list[Variable]]:
    """Attributes and variables of a classic file.

    Raises ValueError for a header that is damaged or cut off.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        data = file.read(1 << 16)
        while True:  # a header is small, and the file may be large
            try:
                return _parsed(path, data, size)
            except EOFError as error:
                more = file.read(min(15 * len(data), MAX_HEADER - len(data)))
                if not more:
                    raise ValueError(
                        f"its header ends behind its {size} bytes, or {MAX_HEADER}: it is cut"
                    ) from error
            data += more


def _parsed(path: Path, data: bytes, size: int) -> tuple[dict[str, Any], list[Variable]]:
    version = data[3]
    header = _Bytes(data, wide=version == 5)
    records = header.count()
    lengths: dict[str, int | None] = {}
    for name in header.members(DIMENSIONS):
        if name in lengths:
            raise ValueError(f"two of its dimensions are called {name!r:.40}")
        lengths[name] = header.count() or None
    attributes = header.attributes()
    names = list(lengths)
    described = []
    for name in header.members(VARIABLES):
        many = header.count()
        if many > MAX_DIMENSIONS:
            raise ValueError(f"{name!r:.40} has {many} dimensions; {MAX_DIMENSIONS} are possible")
        numbers = [header.count() for _ in range(many)]
        if any(number >= len(names) for number in numbers):
            raise ValueError(f"{name!r:.40} has a dimension that does not exist")
        own, dtype = header.attributes(), header.type()
        header.count()  # the size in bytes, which follows from the shape and may be too large
        begin = header.integer(4 if version == 1 else 8)
        described.append((name, tuple(names[i] for i in numbers), own, dtype, begin))

    along = [each for each in described if each[1] and lengths[each[1][0]] is None]
    sizes = [
        np.dtype(dtype).itemsize * prod(lengths[d] or 0 for d in dims[1:])
        for _, dims, _, dtype, _ in along
    ]
    # one array alone has its records next to each other
    record = sizes[0] if len(sizes) == 1 else sum(n + -n % PADDED for n in sizes)
    if records == (1 << (64 if version == 5 else 32)) - 1:  # whose writer did not know it
        first = min((begin for *_, begin in along), default=size)
        records = max(0, size - first) // record if record else 0
    variables = []
    for name, dims, own, dtype, begin in described:
        if any(lengths[d] is None for d in dims[1:]):
            raise ValueError(f"{name!r:.40} has the unlimited dimension elsewhere than first")
        shape = tuple(records if lengths[d] is None else lengths[d] or 0 for d in dims)
        kind = np.dtype(dtype)
        inner = [kind.itemsize * prod(shape[i + 1 :]) for i in range(len(shape))]
        strides = (record, *inner[1:]) if dims and lengths[dims[0]] is None else tuple(inner)
        end = (
            begin + kind.itemsize + sum((n - 1) * by for n, by in zip(shape, strides, strict=True))
        )
        if end > size and 0 not in shape:
            raise ValueError(
                f"{name!r:.40} ends at byte {end:,}, and the file has {size:,}: it was cut off, or"
                " never written to its end"
            )
        variables.append(
            Variable(
                name=name,
                shape=shape,
                dtype=kind.newbyteorder("="),
                dimensions=dims,
                attributes=own,
                read=partial(_read, path, kind, shape, begin, strides),
                unlimited=[d for d in dims if lengths[d] is None],
            )
        )
    return attributes, variables


def matches(head: bytes, path: Path) -> bool:
    """Whether this is classic NetCDF."""
    return head[:4] in MAGIC


def open_classic(path: Path, request: Request) -> Source:
    """The variables of a classic file."""
    stamp = Stamp.of(path)
    with refusing(f"{path} cannot be read as classic NetCDF"):
        attributes, variables = read_header(path)
    if {"image", "image-min", "image-max"} <= {each.name for each in variables}:
        raise InputError(f"{path} is MINC1; mincconvert -2 makes MINC2 of it, which can be read")
    return file_source(
        path,
        variables,
        groups={"": attributes},
        stamp=stamp,
        naming=True,
        default_fill=default_fill,
    )
