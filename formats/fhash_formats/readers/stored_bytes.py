"""Values in flat files: plain, compressed, in text, in many files; positions on a lattice."""

from __future__ import annotations

import bz2
import re
import zlib
from collections.abc import Callable, Sequence
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.readers.variables import Variable, positions
from fhash_formats.series import AXIS_NAMES

BLOCK_BYTES = 8 * 2**20
"""Bytes read at once where the requested values are scattered, as with time fastest."""

SHORTEST_RUN = 16 * 2**10
"""Bytes below which a run of values is not worth a read of its own."""


class FlatArray:
    """An array of `shape` (slowest dimension first) and `dtype` from byte `offset` of a file on.

    It is read with seek and read: a memory map would kill the process if the file were cut
    meanwhile.
    """

    def __init__(
        self, path: Path, shape: tuple[int, ...], dtype: np.dtype[Any], *, offset: int = 0
    ) -> None:
        self.path, self.shape, self.dtype, self.offset = path, shape, dtype, offset

    @property
    def end(self) -> int:
        """The byte after the last value, which is the expected size of the file."""
        return self.offset + prod(self.shape) * self.dtype.itemsize

    def read(self, places: Sequence[slice | int]) -> npt.NDArray[Any]:
        """Values at a range or an index along each dimension.

        Raises InputError where the file ends too early.
        """
        if any(isinstance(each, int) for each in places):
            whole = [slice(each, each + 1) if isinstance(each, int) else each for each in places]
            kept = tuple(0 if isinstance(each, int) else slice(None) for each in places)
            return self.read(whole)[kept]
        ranges = tuple(
            slice(*each.indices(length)[:2])
            for each, length in zip(places, self.shape, strict=True)
            if isinstance(each, slice)
        )
        parts = [
            place
            for place, (part, length) in enumerate(zip(ranges, self.shape, strict=True))
            if part != slice(0, length)
        ]
        if len(parts) > 1:
            return self._read_box(ranges, parts[0])
        place = parts[0] if parts else 0
        part = ranges[place]
        rows, inner = prod(self.shape[:place]), prod(self.shape[place + 1 :])
        result = np.empty((rows, (part.stop - part.start) * inner), self.dtype)
        with self.path.open("rb") as file:
            self._fill(file, result, self.shape[place] * inner, part.start * inner)
        return result.reshape(*self.shape[:place], part.stop - part.start, *self.shape[place + 1 :])

    def _read_box(self, ranges: tuple[slice, ...], place: int) -> npt.NDArray[Any]:
        """Values in ranges of which several are parts; `place` is the slowest of these.

        Whatever lies behind an index along it is an array of its own.
        """
        inner = self.shape[place + 1 :]
        bytes_inside = prod(inner) * self.dtype.itemsize
        slow = [range(part.start, part.stop) for part in ranges[: place + 1]]
        result = np.empty([len(part) for part in slow] + _lengths(ranges[place + 1 :]), self.dtype)
        strides = [prod(self.shape[deeper + 1 : place + 1]) for deeper in range(place + 1)]
        for where in np.ndindex(*(len(part) for part in slow)):
            number = sum(
                part[index] * stride
                for part, index, stride in zip(slow, where, strides, strict=True)
            )
            offset = self.offset + number * bytes_inside
            array = FlatArray(self.path, inner, self.dtype, offset=offset)
            result[where] = array.read(ranges[place + 1 :])
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
        file.seek(self.offset + start * self.dtype.itemsize)
        _read_whole(self.path, file, into.view(np.uint8).data, f", {self.end} are needed")


def _read_whole(path: Path, file: BinaryIO, view: memoryview, told: str) -> None:
    """Fill a view from a file; raises InputError, with more that is told, where it ends."""
    done = 0
    while done < len(view):
        count = file.readinto(view[done:])  # type: ignore[attr-defined]
        if not count:
            raise InputError(f"{path} ends after {file.tell()} bytes{told}")
        done += count


def _lengths(ranges: tuple[slice, ...]) -> list[int]:
    return [part.stop - part.start for part in ranges]


INFLATED_BYTES = 2**20
"""Bytes that are decompressed at once where they are only skipped."""

STORED_BYTES = 2**18
"""Stored bytes that are read at once."""

DEFLATE_RATIO = 1032
"""Largest factor by which zlib and gzip can shrink data."""

BZIP2_RATIO = 2_000_000
"""Factor above the largest by which bzip2 can shrink data: 46 MB of zeros to 40 bytes."""

MAX_FILES = 1 << 20
"""Files of one array."""

NUMBERED = re.compile(r"([^%\s]*%0?[0-9]{0,2})[du]([^%\s]*)")
"""A pattern of C for the names of files; a wider number would be a name of gigabytes."""

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
        self._count = -1 if stop is None else stop - start
        count = size // dtype.itemsize
        if path.stat().st_size - start < 2 * count - 1:
            raise InputError(f"{path} is too short for {count} numbers; it is cut")
        self._values: npt.NDArray[np.uint8] | None = None

    def readinto(self, place: int, view: memoryview) -> None:
        """Fill a view with the bytes from `place` on."""
        if self._values is None:
            self._values = self._parsed()
        view[:] = self._values[place : place + len(view)].data

    def close(self) -> None:
        """Forget the values."""
        self._values = None

    def _parsed(self) -> npt.NDArray[np.uint8]:
        with self.path.open("rb") as file:
            file.seek(self.start)
            words = file.read(self._count).replace(b",", b" ").split()
        count = self.size // self.dtype.itemsize
        if len(words) != count:
            raise InputError(f"{self.path} holds {len(words)} numbers, {count} are needed")
        try:
            values = numbers_of_words(words, self.dtype)
        except ValueError as error:
            raise InputError(f"{self.path}: {error}") from error
        return values.view(np.uint8)


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


def in_files(
    files: Sequence[Path], size: int, open_part: Callable[[Path, int], StoredBytes]
) -> StoredBytes:
    """Values that are spread evenly over one or several files.

    Args:
        files: at least one, in the order of their values.
        size: bytes of all values.
        open_part: opens one file, given the bytes of the values in it.

    Raises MissingInputError for a file that is not there, and InputError where the values cannot be
    divided among the files.
    """
    for file in files:
        if not file.is_file():
            raise MissingInputError(f"its values are in {file}, which is not there")
    if size % len(files):
        raise InputError(f"its {size} bytes cannot be divided among {len(files)} files")
    parts = [open_part(file, size // len(files)) for file in files]
    return parts[0] if len(parts) == 1 else ManyFiles(parts)


def numbered_files(folder: Path, form: str, words: Sequence[str], most: int) -> list[Path]:
    """Files of a pattern of C such as `slice_%03d.raw`, numbered from, to and by three words.

    most: files that there can be. Raises InputError for other patterns, and MissingInputError for
    the first file that is not there.
    """
    match = NUMBERED.fullmatch(form)
    if match is None or not all(re.fullmatch(r"-?[0-9]{1,9}", word) for word in words):
        raise InputError(
            f"its pattern of files is {' '.join([form, *words])[:80]!r}; a name with one %d or %03d"
            " (two digits at most), the first number, the last and the stride are needed"
        )
    first, last, stride = map(int, words)
    if stride == 0 or not 0 <= (last - first) // stride < min(most, MAX_FILES):
        raise InputError(
            f"its pattern of files is {' '.join([form, *words])!r}; 1 to {min(most, MAX_FILES)}"
            " numbers are possible here"
        )
    files = []
    for number in range(first, last + (1 if stride > 0 else -1), stride):
        files.append(folder / (f"{match[1]}d{match[2]}" % number))
        if not files[-1].is_file():
            raise MissingInputError(f"its values are in {files[-1]}, which is not there")
    return files


class StoredArray(FlatArray):
    """An array of `shape` (slowest dimension first) and `dtype`, from a stored byte `offset` on."""

    def __init__(
        self,
        path: Path,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        stored: StoredBytes,
        *,
        offset: int = 0,
    ) -> None:
        super().__init__(path, shape, dtype, offset=offset)
        self.stored = stored

    def _read(self, file: BinaryIO, into: npt.NDArray[Any], start: int) -> None:
        place = self.offset + start * self.dtype.itemsize
        self.stored.readinto(place, into.view(np.uint8).data)


def numbers_of(text: str, count: int) -> npt.NDArray[np.float64]:
    """So many numbers of a line, in any notation; raises InputError for another text."""
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (count,):
        raise InputError(f"{text[:60]!r} stands where {count} numbers are needed")
    return numbers


def numbers_of_words(words: Sequence[bytes], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Numbers of a type from their texts; raises ValueError for other text and for larger ones."""
    if max(map(len, words), default=0) > LONGEST_NUMBER:
        raise ValueError("text stands where numbers are needed")
    if dtype.kind == "f":
        return np.array(words, dtype=f"S{LONGEST_NUMBER}").astype(dtype)
    limits, numbers = np.iinfo(dtype), [int(word) for word in words]
    if numbers and not limits.min <= min(numbers) <= max(numbers) <= limits.max:
        raise ValueError(f"a number is beyond the type {dtype.name}")
    return np.array(numbers, dtype)


class _Inflate:
    """Decompression of zlib or gzip, whichever the data begin with.

    The members of one gzip file follow each other.
    """

    def __init__(self) -> None:
        self.inner = zlib.decompressobj(wbits=47)
        self.gzip: bool | None = None
        self.complete = False

    def __call__(self, stored: bytes, limit: int) -> tuple[bytes, bytes, bool]:
        if self.gzip is None and stored:
            self.gzip = stored[:1] == GZIP[:1]
        if self.complete and stored:
            if not self.gzip or stored[:1] != GZIP[:1]:
                return b"", b"", True  # what follows belongs to nothing
            self.inner, self.complete = zlib.decompressobj(wbits=47), False
        if self.complete:
            return b"", b"", False
        data = self.inner.decompress(stored, limit)
        self.complete = self.inner.eof
        rest = self.inner.unused_data if self.complete else self.inner.unconsumed_tail
        return data, rest, self.complete and not self.gzip


class _Bunzip:
    """Decompression of bzip2."""

    def __init__(self) -> None:
        self.inner = bz2.BZ2Decompressor()
        self.complete = False

    def __call__(self, stored: bytes, limit: int) -> tuple[bytes, bytes, bool]:
        data = self.inner.decompress(stored, limit)
        self.complete = self.inner.eof
        return data, b"", self.complete


KINDS: dict[str, Callable[[], Any]] = {"deflate": _Inflate, "bzip2": _Bunzip}
"""Decompressors: (stored bytes, limit) -> (true bytes, stored bytes left, whether it ended)."""


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
        self._file: BinaryIO | None = None
        self._begin()

    def readinto(self, place: int, view: memoryview) -> None:
        """Fill a view with the true bytes from `place` on; raises InputError where they end."""
        try:
            self._fill(place, view)
        except BaseException:
            self.close()
            raise

    def _fill(self, place: int, view: memoryview) -> None:
        if place < self._place or self._file is None:
            self._begin()
        while self._place < place:
            self._need(min(INFLATED_BYTES, place - self._place))
        done = 0
        while done < len(view):
            data = self._need(min(INFLATED_BYTES, len(view) - done))
            view[done : done + len(data)] = data
            done += len(data)
        # One byte more reads the checksum behind the last one.
        if self._place == self.size and not self._next.complete and self._some(1):
            raise InputError(
                f"{self.path} cannot be decompressed: it holds more than the {self.size} bytes"
                " that its header promises"
            )

    def close(self) -> None:
        """Close the file; a further read opens it again."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _begin(self) -> None:
        self.close()
        self._next = KINDS[self.kind]()
        self._place, self._stored, self._ended = 0, b"", False

    def _need(self, limit: int) -> bytes:
        """The next true bytes, at least one and at most `limit`."""
        if self._file is None:
            self._file = self.path.open("rb")
            self._file.seek(self.start)
        data = self._some(limit)
        if data:
            self._place += len(data)
            return data
        raise InputError(
            f"{self.path} ends after {self._place} decompressed bytes, {self.size} are needed"
        )

    def _some(self, limit: int) -> bytes:
        """The next true bytes; none where they end.

        Raises InputError for a stream that is damaged, or cut before its checksum.
        """
        assert self._file is not None
        while not self._ended:
            hungry = getattr(self._next.inner, "needs_input", True)
            stored = self._stored or (self._file.read(STORED_BYTES) if hungry else b"")
            try:
                data, self._stored, self._ended = self._next(stored, limit)
            except (zlib.error, OSError, EOFError) as error:
                raise InputError(f"{self.path} cannot be decompressed: {error}") from error
            if data:
                return bytes(data)
            if hungry and not stored:
                if not self._next.complete:
                    raise InputError(f"{self.path} is cut after {self._place} decompressed bytes")
                break
        return b""


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

    `first` is the index of the first position; a half stands for the centre of a cell. Raises
    InputError for an origin or a spacing that is not finite, and for a spacing of 0.
    """
    if not np.isfinite([origin, spacing]).all() or (spacing == 0 and count > 1):
        raise InputError(
            f"the grid has the origin {origin} and the spacing {spacing} along {axis}; both must be"
            " finite, and the spacing not 0"
        )
    values = origin + (first + np.arange(count, dtype=np.float64)) * spacing
    return positions(AXIS_NAMES[axis], values, {"units": units} if units else {})


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
