"""Values in flat files: plain, compressed, in text, in many files; positions on a lattice."""

from __future__ import annotations

import bz2
import re
import zlib
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, Protocol, Self

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.file_series import naming, require_length
from fhash_formats.readers.variables import Variable, by_ranges, positions
from fhash_formats.series import AXIS_NAMES
from fhash_formats.support.values import decoded_text, is_number

TYPE_NAMES = {
    "i1": "signed char|int8|int8_t|met_char",
    "u1": "uchar|unsigned char|uint8|uint8_t|met_uchar",
    "i2": "short|short int|signed short|signed short int|int16|int16_t|met_short",
    "u2": "ushort|unsigned short|unsigned short int|uint16|uint16_t|met_ushort",
    "i4": "int|signed int|int32|int32_t|met_int|met_long",
    "u4": "uint|unsigned int|uint32|uint32_t|met_uint|met_ulong",
    "i8": "longlong|long long|long long int|signed long long|signed long long int|int64|int64_t"
    "|met_long_long",
    "u8": "ulonglong|unsigned long long|unsigned long long int|uint64|uint64_t|met_ulong_long",
    "f4": "float|float32|met_float",
    "f8": "double|float64|met_double",
}
TYPES = {name: short for short, names in TYPE_NAMES.items() for name in names.split("|")}
"""Number types by their names in headers; MetaIO's long has four bytes on every machine."""

MAX_HEADER = 64 * 2**20
"""Bytes of the longest header; own ones list every coordinate."""

MAX_LINE = 1 << 16
"""Bytes of the longest line of a header but for those that list coordinates."""


class Header:
    """The header of a file, through which readers of this project take it.

    It has MAX_HEADER bytes at most, and its lines MAX_LINE, so that no header fills the memory.
    Raises InputError for a longer one. It is a context that closes the file.
    """

    def __init__(self, path: Path, start: int = 0) -> None:
        self.file: BinaryIO = path.open("rb")
        self.file.seek(start)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.file.close()

    def line(self, most: int = MAX_LINE) -> bytes:
        """The next line with its end; b"" behind the last."""
        line = self.file.readline(most + 1)
        if len(line) > most or self.file.tell() > MAX_HEADER + most:
            raise InputError(
                f"its header is longer than {MAX_HEADER} bytes, or has a line of more than {most}"
            )
        return line

    def words(self) -> list[str]:
        """The words of the next line that has any; none at the end."""
        while line := self.line():
            if words := decoded_text(line).split():
                return words
        return []


def count_of(text: str, what: str, most: int, least: int = 0) -> int:
    """A whole number of a header, which counts something; InputError for others and larger ones."""
    if not re.fullmatch(r"[-+]?[0-9]{1,18}", text) or not least <= int(text) <= most:
        raise InputError(f"it has {text[:40]!r} {what}; {least} to {most} are possible here")
    return int(text)


BLOCK_BYTES = 8 * 2**20
"""Bytes read at once where the requested values are scattered, as with time fastest."""

SHORTEST_RUN = 16 * 2**10
"""Bytes below which a run of values is not worth a read of its own."""


class FlatArray:
    """An array of `shape` (slowest dimension first) and `dtype` from byte `offset` of a file on.

    It is read with seek and read: a memory map would kill the process if the file were cut
    meanwhile. stored: the bytes, where they are not simply those of the file.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        *,
        offset: int = 0,
        stored: StoredBytes | None = None,
    ) -> None:
        self.path, self.shape, self.dtype, self.offset = path, shape, dtype, offset
        self.stored = stored

    @property
    def end(self) -> int:
        """The byte after the last value, which is the expected size of the file."""
        return self.offset + prod(self.shape) * self.dtype.itemsize

    def read(self, places: Sequence[slice | int]) -> npt.NDArray[Any]:
        """Values at a range or an index along each dimension.

        Raises InputError where the file ends too early.
        """
        return by_ranges(self.shape, self._box)(tuple(places))

    def variable(self, name: str, dimensions: Sequence[str | None] = ()) -> Variable:
        """The array as a variable."""
        return Variable(
            name=name,
            shape=self.shape,
            dtype=self.dtype,
            dimensions=tuple(dimensions),
            read=self.read,
        )

    def _box(self, ranges: list[range]) -> npt.NDArray[Any]:
        """Values in ranges; whatever lies behind an index along the slowest of several parts is an
        array of its own."""
        parts = [n for n, length in enumerate(self.shape) if len(ranges[n]) != length]
        place = parts[0] if parts else 0
        outer, inner = self.shape[: place + 1], self.shape[place + 1 :]
        result = np.empty([len(part) for part in ranges], self.dtype)
        if len(parts) > 1:
            for where in np.ndindex(*result.shape[: place + 1]):
                index = [part[n] for part, n in zip(ranges, where, strict=False)]
                number = int(np.ravel_multi_index(index, outer))
                offset = self.offset + number * prod(inner) * self.dtype.itemsize
                array = FlatArray(self.path, inner, self.dtype, offset=offset, stored=self.stored)
                result[where] = array._box(ranges[place + 1 :])
            return result
        rows = result.reshape(prod(outer[:-1]), len(ranges[place]) * prod(inner))
        with self.path.open("rb") as file:
            self._fill(file, rows, outer[-1] * prod(inner), ranges[place].start * prod(inner))
        return result

    def _fill(self, file: BinaryIO, result: npt.NDArray[Any], stride: int, first: int) -> None:
        """Fill each row of the result from `first` on in each `stride` values of the file."""
        rows, run = result.shape
        item = self.dtype.itemsize
        if rows == 1 or run * item >= SHORTEST_RUN or stride * item > BLOCK_BYTES:
            for row in range(rows):
                self._read(file, result[row], row * stride + first)
            return
        together = max(1, BLOCK_BYTES // (stride * item))
        for row in range(0, rows, together):
            count = min(together, rows - row)
            block = np.empty(count * stride, self.dtype)
            self._read(file, block, row * stride)
            result[row : row + count] = block.reshape(count, stride)[:, first : first + run]

    def _read(self, file: BinaryIO, into: npt.NDArray[Any], start: int) -> None:
        place, view = self.offset + start * self.dtype.itemsize, into.view(np.uint8).data
        if self.stored is not None:
            self.stored.readinto(place, view)
            return
        file.seek(place)
        _read_whole(self.path, file, view, f", {self.end} are needed")


def _read_whole(path: Path, file: BinaryIO, view: memoryview, told: str) -> None:
    """Fill a view from a file; raises InputError, with more that is told, where it ends."""
    done = 0
    while done < len(view):
        count = file.readinto(view[done:])  # type: ignore[attr-defined]
        if not count:
            raise InputError(f"{path} ends after {file.tell()} bytes{told}")
        done += count


INFLATED_BYTES = 2**20
"""Bytes that are decompressed at once where they are only skipped."""

STORED_BYTES = 2**18
"""Stored bytes that are read at once."""

DEFLATE_RATIO = 1032
"""Largest factor by which zlib and gzip can shrink data."""

BZIP2_RATIO = 2_000_000
"""Factor above the largest by which bzip2 can shrink data: 46 MB of zeros to 40 bytes."""

GZIP = b"\x1f\x8b"
"""First bytes of a gzip member; zlib begins with others."""

LONGEST_NUMBER = 64
"""Characters of the longest number in text."""


class StoredBytes(Protocol):
    """The bytes of an array, wherever they are."""

    size: int

    def readinto(self, place: int, view: memoryview) -> None:
        """Fill a view with the bytes from `place` on; raises InputError where they end."""

    def close(self) -> None:
        """Close the files; a further read opens them again."""


class PlainFile:
    """`size` bytes of a file from byte `start` on; raises InputError where the file is shorter."""

    def __init__(self, path: Path, *, start: int, size: int) -> None:
        self.path, self.start, self.size = path, start, size
        stored = path.stat().st_size
        if start < 0 or stored < start + size:
            raise InputError(
                f"{path} has {stored} bytes, its header promises {start + size}; it is cut or its"
                " header is wrong"
            )

    def readinto(self, place: int, view: memoryview) -> None:
        """Fill a view with the bytes from `place` on."""
        with self.path.open("rb") as file:
            file.seek(self.start + place)
            _read_whole(self.path, file, view, "; it is cut")

    def close(self) -> None:
        """Close nothing: each read opens the file for itself."""


class NumbersInText:
    """Values of a type that a file holds as text, from byte `start` on, to `stop` or its end."""

    def __init__(
        self, path: Path, dtype: np.dtype[Any], *, start: int, size: int, stop: int | None = None
    ) -> None:
        self.path, self.dtype, self.start, self.size = path, dtype, start, size
        self._stop = path.stat().st_size if stop is None else stop
        count = size // dtype.itemsize
        if self._stop - start < 2 * count - 1:
            raise InputError(f"{path} is too short for {count} numbers; it is cut")
        self._values: npt.NDArray[np.uint8] | None = None

    def readinto(self, place: int, view: memoryview) -> None:
        """Fill a view with the bytes from `place` on."""
        if self._values is None:
            count = self.size // self.dtype.itemsize
            with self.path.open("rb") as file, naming(str(self.path)):
                file.seek(self.start)
                found = numbers_in_text(file, self._stop - self.start, self.dtype, count)
            self._values = found.view(np.uint8)
        view[:] = self._values[place : place + len(view)].data

    def close(self) -> None:
        """Forget the values."""
        self._values = None


class ManyFiles:
    """Bytes of files that follow each other, each with the same number of them."""

    def __init__(self, parts: Sequence[StoredBytes]) -> None:
        self.parts, self.each = parts, parts[0].size
        self.size = self.each * len(parts)
        self._open = 0

    def readinto(self, place: int, view: memoryview) -> None:
        """Fill a view with the bytes from `place` on."""
        done = 0
        while done < len(view):
            number, inside = divmod(place + done, self.each)
            if number != self._open:
                self.parts[self._open].close()
                self._open = number
            count = min(len(view) - done, self.each - inside)
            self.parts[number].readinto(inside, view[done : done + count])
            done += count

    def close(self) -> None:
        """Close the file that is open."""
        self.parts[self._open].close()


def numbers_of(text: str, count: int) -> npt.NDArray[np.float64]:
    """So many numbers of a line, in any notation; raises InputError for another text."""
    words = text.split()
    if len(words) != count or not all(map(is_number, words)):
        raise InputError(f"{text[:60]!r} stands where {count} numbers are needed")
    return np.array([float(word) for word in words])


def numbers_in_text(
    file: BinaryIO, length: int, dtype: np.dtype[Any], count: int
) -> npt.NDArray[Any]:
    """The `count` numbers in the next bytes of a file, between blanks or commas.

    Raises InputError for another count, and ValueError for other text. The words of a part are held
    at once, which take far more bytes than their numbers.
    """
    values, found, rest = np.empty(count, dtype), 0, b""
    while block := file.read(min(length, INFLATED_BYTES)):
        length -= len(block)
        words = (rest + block).replace(b",", b" ").split()
        open_end = length > 0 and block[-1:] not in b", \t\r\n\v\f"
        rest = words.pop() if open_end and words else b""
        if len(rest) > LONGEST_NUMBER:
            raise ValueError("text stands where numbers are needed")
        if found + len(words) <= count:
            values[found : found + len(words)] = numbers_of_words(words, dtype)
        found += len(words)
    if found != count or rest:  # a rest is that of a file which was cut meanwhile
        raise InputError(f"it holds {found} numbers, {count} are needed; it is cut or no such grid")
    return values


def numbers_of_words(words: Sequence[bytes], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Numbers of a type from their texts; raises ValueError for other text and for larger ones."""
    if max(map(len, words), default=0) > LONGEST_NUMBER:
        raise ValueError("text stands where numbers are needed")
    if dtype.kind == "f":
        try:
            return np.array(words, dtype=f"S{LONGEST_NUMBER}").astype(dtype)
        except ValueError as error:
            raise ValueError(f"{error}; it is cut, or has text in place of numbers") from error
    limits, numbers = np.iinfo(dtype), [int(word) for word in words]
    if numbers and not limits.min <= min(numbers) <= max(numbers) <= limits.max:
        raise ValueError(f"a number is beyond the type {dtype.name}")
    return np.array(numbers, dtype)


def _inflated(path: Path, kind: str, start: int) -> Generator[bytes]:
    """The true bytes of a file that is compressed from byte `start` on, some at a time.

    The members of one gzip file follow each other; what follows else belongs to nothing. Raises
    InputError for a stream that is damaged, or cut before its checksum.
    """
    done = 0
    with path.open("rb") as file:
        file.seek(start)
        stored = file.read(STORED_BYTES)
        while True:
            inner: Any = KINDS[kind]()
            members = kind == "deflate" and stored[:1] == GZIP[:1]
            while not inner.eof:
                hungry = getattr(inner, "needs_input", True)
                stored = stored or (file.read(STORED_BYTES) if hungry else b"")
                ended = hungry and not stored
                try:
                    data = inner.decompress(stored, INFLATED_BYTES)
                except (zlib.error, OSError, EOFError) as error:
                    raise InputError(f"{path} cannot be decompressed: {error}") from error
                stored = getattr(inner, "unconsumed_tail", b"")
                done += len(data)
                if data:
                    yield data
                elif ended and not inner.eof:
                    raise InputError(f"{path} is cut after {done} decompressed bytes")
            stored = inner.unused_data or file.read(STORED_BYTES)
            if not members or stored[:1] != GZIP[:1]:
                return


KINDS: dict[str, Callable[[], Any]] = {
    "deflate": lambda: zlib.decompressobj(wbits=47),
    "bzip2": bz2.BZ2Decompressor,
}
"""Decompressors; that of zlib takes gzip, too."""


class CompressedFile:
    """The true bytes of a file that is compressed from byte `start` on.

    Args:
        path: of the file.
        kind: a key of KINDS.
        start: first compressed byte.
        size: true bytes that are needed; raises InputError where so few stored bytes cannot hold
            them.
    """

    def __init__(self, path: Path, kind: str, *, start: int, size: int) -> None:
        self.path, self.kind, self.start, self.size = path, kind, start, size
        stored = path.stat().st_size - start
        if size > (DEFLATE_RATIO if kind == "deflate" else BZIP2_RATIO) * stored:
            raise InputError(
                f"{path} promises {size} bytes, which its {stored} compressed ones cannot hold; it"
                " is cut or damaged"
            )
        self._chunks: Generator[bytes] | None = None
        self._place, self._rest = 0, memoryview(b"")

    def readinto(self, place: int, view: memoryview) -> None:
        """Fill a view with the true bytes from `place` on; raises InputError where they end."""
        if place < self._place:
            self.close()
        if self._chunks is None:
            self._chunks = _inflated(self.path, self.kind, self.start)
        try:
            while self._place < place:
                self._next(self._chunks, place - self._place)
            done = 0
            while done < len(view):
                data = self._next(self._chunks, len(view) - done)
                view[done : done + len(data)] = data
                done += len(data)
            # the end of the stream is read, too, for its checksum
            if self._place == self.size and (self._rest or next(self._chunks, b"")):
                raise InputError(
                    f"{self.path} cannot be decompressed: it holds more than the {self.size} bytes"
                    " that its header promises"
                )
        except BaseException:
            self.close()
            raise

    def _next(self, chunks: Iterator[bytes], most: int) -> memoryview:
        """The next true bytes, at least one."""
        rest = self._rest or memoryview(next(chunks, b""))
        if not rest:
            raise InputError(
                f"{self.path} ends after {self._place} decompressed bytes, {self.size} are needed"
            )
        data, self._rest = rest[:most], rest[most:]
        self._place += len(data)
        return data

    def close(self) -> None:
        """Close the file; a further read opens it again."""
        if self._chunks is not None:
            self._chunks.close()
        self._chunks, self._place, self._rest = None, 0, memoryview(b"")


IDENTITY_TOLERANCE = 1e-9
"""Largest difference from 1 or 0 of a direction that still is that of an axis."""


def lattice(
    axis: str,
    origin: float,
    spacing: float,
    count: int,
    *,
    first: float = 0,
    units: str = "",
) -> Variable:
    """The positions of an even axis: origin + (first + i) * spacing for i below `count`.

    `first` is the index of the first position; a half stands for the centre of a cell. They are
    computed when they are read. Raises InputError for an origin or a spacing that is not finite,
    for a spacing of 0, and for more than MAX_AXIS positions.
    """
    require_length(axis, count)
    if not np.isfinite([origin, spacing]).all() or (spacing == 0 and count > 1):
        raise InputError(
            f"the grid has the origin {origin} and the spacing {spacing} along {axis}; both must be"
            " finite, and the spacing not 0"
        )

    def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        values: npt.NDArray[Any] = origin + (first + np.arange(count, dtype=np.float64)) * spacing
        return values[places]

    made = positions(AXIS_NAMES[axis], np.empty(0), {"units": units} if units else {})
    return replace(made, shape=(count,), read=read)


def axis_steps(directions: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The signed steps (n,) of axis vectors (n, n), one a row, each along its own axis.

    Raises InputError for vectors that are turned: the positions would not belong to one axis each.
    """
    steps: npt.NDArray[np.float64] = np.diagonal(directions)
    others = np.abs(directions - np.diag(steps))
    if not np.isfinite(directions).all() or others.max() > IDENTITY_TOLERANCE * np.abs(steps).max():
        raise InputError(
            "the grid is turned against the axes (its direction is not the identity), and only"
            " grids along x, y and z can be read; resample it first"
        )
    return steps
