"""Classic NetCDF files (NetCDF-3): CDF-1, CDF-2 and CDF-5.

The layout is that of the NetCDF classic format specification
(https://docs.unidata.ucar.edu/netcdf-c/current/file_format_specifications.html): a header with
dimensions, attributes and variables, big-endian; then the arrays, of which those along the
unlimited dimension are interleaved record by record. Names and texts are UTF-8, else Latin-1.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.file_series import Request, Stamp, refusing
from fhash_formats.readers.hdf5 import default_fill
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
STREAMING = 0xFFFFFFFF
"""Number of records in a file whose writer did not know it."""
PADDED = 4
"""Bytes to whose multiple names, attributes and arrays are filled up."""


@dataclass(frozen=True, kw_only=True)
class Header:
    """The header of a classic file.

    Attributes:
        lengths: of each dimension, None for the unlimited one.
        records: length of the unlimited dimension.
        attributes: of the file.
        variables: by name.
    """

    lengths: dict[str, int | None]
    records: int
    attributes: dict[str, Any]
    variables: dict[str, ClassicArray]


class ClassicArray:
    """An array of a classic file, read as it is indexed; the file is open no longer than that.

    Attributes:
        dimensions: their names.
        attributes: numbers as numpy scalars or arrays, texts as str.
    """

    def __init__(
        self,
        path: Path,
        dtype: str,
        dimensions: tuple[str, ...],
        attributes: dict[str, Any],
        shape: tuple[int, ...],
        begin: int,
        record: int | None,
    ) -> None:
        """Describe the array at byte `begin`, its records (if it has any) `record` bytes apart."""
        self.path, self.dimensions, self.attributes = path, dimensions, attributes
        self.dtype, self.shape, self.begin = np.dtype(dtype), shape, begin
        inner = [self.dtype.itemsize * prod(shape[i + 1 :]) for i in range(len(shape))]
        self.strides = tuple(inner if record is None else (record, *inner[1:]))

    @property
    def end(self) -> int:
        """The byte after the last one, padding not counted."""
        if 0 in self.shape:
            return self.begin
        last = sum((n - 1) * stride for n, stride in zip(self.shape, self.strides, strict=True))
        return self.begin + last + self.dtype.itemsize

    def __getitem__(self, key: tuple[int | slice, ...]) -> npt.NDArray[Any]:
        """The stored numbers at integers and slices, big-endian."""
        if 0 in self.shape:
            return np.empty(self.shape, self.dtype)[key]
        with (
            self.path.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped,
        ):
            stored: npt.NDArray[Any] = np.ndarray(
                self.shape, self.dtype, mapped, self.begin, self.strides
            )
            copied: npt.NDArray[Any] = stored[key].copy()
            del stored  # the map cannot be closed before
        return copied

    def native(self, key: tuple[int | slice, ...]) -> npt.NDArray[Any]:
        """The stored numbers at integers and slices, in the machine's byte order."""
        return self[key].astype(self.dtype.newbyteorder("="), copy=False)


class _Bytes:
    """Numbers and names of a header, one after the other."""

    def __init__(self, data: bytes, *, wide: bool) -> None:
        self.data, self.at, self.wide = data, 4, wide

    def take(self, count: int) -> bytes:
        """The next bytes, and their padding passed over."""
        end = self.at + count
        if end > len(self.data):
            raise ValueError("its header is longer than the file")
        taken = self.data[self.at : end]
        self.at = end + -end % PADDED
        return taken

    def integer(self, size: int = 4) -> int:
        return int.from_bytes(self.take(size), "big")

    def count(self) -> int:
        """A count or a length, of 8 bytes in CDF-5."""
        return self.integer(8 if self.wide else 4)

    def name(self) -> str:
        return decoded_text(self.take(self.count()))

    def members(self, tag: int) -> Iterator[str]:
        """The name of each member of a list, before the rest of the member is read."""
        found, count = self.integer(), self.count()
        if found not in (tag, 0) or (not found and count):
            raise ValueError(f"its header has the tag {found} in place of {tag}")
        for _ in range(count):
            yield self.name()

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


def read_header(path: Path) -> Header:
    """The header of a classic file; raises ValueError for one that is damaged or cut off."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
            length = 1 << 16
            while True:  # a header is small, and the file may be large
                try:
                    return _parsed(path, mapped[:length], size)
                except ValueError:
                    if length >= size:
                        raise
                length *= 16


def _parsed(path: Path, data: bytes, size: int) -> Header:
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
        numbers = [header.count() for _ in range(header.count())]
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
    if records == (2**64 - 1 if version == 5 else STREAMING):
        first = min((begin for *_, begin in along), default=size)
        records = max(0, size - first) // record if record else 0
    variables = {}
    for name, dims, own, dtype, begin in described:
        recorded = bool(dims) and lengths[dims[0]] is None
        if any(lengths[d] is None for d in dims[1:]):
            raise ValueError(f"{name!r:.40} has the unlimited dimension elsewhere than first")
        shape = tuple(records if lengths[d] is None else lengths[d] or 0 for d in dims)
        array = ClassicArray(path, dtype, dims, own, shape, begin, record if recorded else None)
        if array.end > size:
            raise ValueError(
                f"{name!r:.40} ends at byte {array.end:,}, and the file has {size:,}: it was cut"
                " off, or never written to its end"
            )
        variables[name] = array
    return Header(lengths=lengths, records=records, attributes=attributes, variables=variables)


def matches(head: bytes, path: Path) -> bool:
    """Whether this is classic NetCDF."""
    return head[:4] in MAGIC


def open_classic(path: Path, request: Request) -> Source:
    """The variables of a classic file."""
    stamp = Stamp.of(path)
    with refusing(f"{path} cannot be read as classic NetCDF"):
        header = read_header(path)
    if {"image", "image-min", "image-max"} <= header.variables.keys():
        raise InputError(f"{path} is MINC1; mincconvert -2 makes MINC2 of it, which can be read")
    variables = [
        Variable(
            name=name,
            shape=array.shape,
            dtype=array.dtype.newbyteorder("="),
            dimensions=array.dimensions,
            attributes=array.attributes,
            read=array.native,
        )
        for name, array in header.variables.items()
    ]
    return file_source(
        path,
        variables,
        groups={"": header.attributes},
        stamp=stamp,
        naming=True,
        default_fill=default_fill,
    )
