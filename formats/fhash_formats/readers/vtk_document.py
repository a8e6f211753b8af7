"""VTK XML documents: elements, and the arrays in and behind them."""

from __future__ import annotations

import base64
import importlib
import lzma
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from xml.parsers import expat

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.readers.file_series import naming, refusing
from fhash_formats.readers.stored_bytes import DEFLATE_RATIO, numbers_in_text
from fhash_formats.support.values import DTYPES

CHUNK_BYTES = 2**18
"""Bytes that the parser takes at once."""

MAX_ELEMENTS = 200_000
"""Elements of a file; a file of more is no grid, and would fill the memory."""

MAX_NOTE = 4096
"""Characters kept of an information key, such as the units."""


@dataclass(eq=False)
class Element:
    """One element of the file.

    Attributes:
        name: such as "DataArray".
        attributes: as written.
        children: elements inside.
        note: text of an InformationKey.
        start, stop: bytes of the file that hold the text of a DataArray, 0 without text.
    """

    name: str
    attributes: dict[str, str]
    children: list[Element] = field(default_factory=list)
    note: str = ""
    start: int = 0
    stop: int = 0

    def all(self, name: str) -> Iterator[Element]:
        """Yield the children of a name."""
        return (child for child in self.children if child.name == name)

    def first(self, name: str) -> Element | None:
        """The first child of a name, None without one."""
        return next(self.all(name), None)

    def arrays(self, name: str) -> list[Element]:
        """The arrays in all children of a name."""
        return [each for holder in self.all(name) for each in holder.all("DataArray")]


class _AppendedData(Exception):
    """Parsing has come to the appended data, which begin at a byte."""


class Document:
    """A file, parsed up to its appended data.

    Raises InputError for what is no XML, or ends before its last element.

    Attributes:
        root: its outermost element.
        offsets: of the arrays in the appended data, as written.
        appended: the byte behind the "_" that begins the appended data; None without them.
        encoding: of the appended data, "raw" or "base64".
        size: bytes of the file up to the end of the appended data.
    """

    def __init__(self, path: Path) -> None:
        self.root = Element("", {})
        self.offsets: set[str] = set()
        self.appended: int | None = None
        self.encoding, self.size = "raw", path.stat().st_size
        self._stack: list[Element] = []
        self._count = 0
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._doctype
        with path.open("rb") as file:
            try:
                while chunk := file.read(CHUNK_BYTES):
                    self._parser.Parse(chunk, False)
                self._parser.Parse(b"", True)
            except _AppendedData as found:
                self._find_appended(file, found.args[0])
            except expat.ExpatError as error:
                raise InputError(f"it is cut or no XML: {error}") from error

    def _find_appended(self, file: BinaryIO, start: int) -> None:
        """Find the appended data, whose tag begins at a byte."""
        file.seek(start)
        tag = file.read(MAX_NOTE)
        end = tag.find(b">")
        data = tag.find(b"_", end)
        if end < 0 or data < 0 or tag[end + 1 : data].strip():
            raise InputError("its appended data do not begin with '_'; the file is cut")
        self.appended = start + data + 1
        file.seek(max(self.appended, self.size - MAX_NOTE))
        tail = file.read()
        end = tail.rfind(b"</AppendedData")
        self.size -= len(tail) - end if end >= 0 else 0

    def _doctype(self, *_: Any) -> None:
        raise InputError("it declares a document type, which no VTK file has")

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if self._count > MAX_ELEMENTS:
            raise InputError(f"it has more than {MAX_ELEMENTS} elements")
        if name == "AppendedData":
            self.encoding = attributes.get("encoding", "raw").lower()
            raise _AppendedData(self._parser.CurrentByteIndex)
        element = Element(name, attributes)
        if name == "DataArray":
            self.offsets.add(attributes.get("offset", ""))
        if self._stack:
            self._stack[-1].children.append(element)
            self._close_text()
        else:
            self.root = element
        self._stack.append(element)
        self._parser.CharacterDataHandler = self._text

    def _text(self, text: str) -> None:
        top = self._stack[-1]
        if top.name == "InformationKey":
            top.note = (top.note + text)[:MAX_NOTE]
        elif text.strip() and not top.start:
            top.start = self._parser.CurrentByteIndex
            self._parser.CharacterDataHandler = None  # the place of the first text is enough

    def _end(self, name: str) -> None:
        self._close_text()
        self._stack.pop()
        self._parser.CharacterDataHandler = self._text

    def _close_text(self) -> None:
        """End the text of the innermost element; information keys may stand before and behind."""
        top = self._stack[-1]
        if top.start and not top.stop:
            top.stop = self._parser.CurrentByteIndex


TEXT_BYTES = 2**20
"""Bytes of base64 text that are decoded at once."""

BLANKS = b" \t\r\n"
"""Characters between numbers, and inside base64 text."""


class VtkArrays:
    """Reads the arrays of one parsed file.

    Raises InputError for a byte order, header type or compressor that VTK does not have, and
    MissingDependencyError where lz4 is needed and missing.
    """

    def __init__(self, path: Path, document: Document) -> None:
        self.path, self.document = path, document
        root = document.root.attributes
        order = root.get("byte_order", "LittleEndian")
        header = root.get("header_type", "UInt32")
        if order not in ("LittleEndian", "BigEndian") or header not in ("UInt32", "UInt64"):
            raise InputError(f"its byte order is {order!r} and its header type {header!r}")
        if document.encoding not in ("raw", "base64"):
            raise InputError(f"its appended data are encoded as {document.encoding!r}")
        self.order = "<" if order == "LittleEndian" else ">"
        self.header = np.dtype(self.order + ("u4" if header == "UInt32" else "u8"))
        self.compressor = root.get("compressor", "")
        if self.compressor and self.compressor not in COMPRESSORS:
            known = ", ".join(COMPRESSORS)
            raise InputError(f"its compressor is {self.compressor!r}; known are {known}")
        if self.compressor == LZ4:
            try:
                importlib.import_module("lz4.block")
            except ImportError as error:
                told = "it is compressed with LZ4, which needs lz4: pip install 'fhash[formats]'"
                raise MissingDependencyError(told) from error
        self._offsets: list[int] = []
        if document.appended is not None and document.encoding == "base64":
            self._offsets = sorted(int(each) for each in document.offsets if _is_digits(each))

    def dtype(self, array: Element) -> np.dtype[Any]:
        """The type of an array's values in the file; object for text and other types."""
        kind = DTYPES.get(array.attributes.get("type", "").lower())
        return np.dtype(object) if kind is None else np.dtype(self.order + kind.str[1:])

    def check(self, array: Element, count: int) -> None:
        """Raise InputError unless the sizes in the file are those of `count` values."""
        with self._naming(array), self.path.open("rb") as file:
            if not self._is_ascii(array):
                self._begin(self._stream(file, array), count * self.dtype(array).itemsize)
            elif array.stop - array.start < 2 * count - 1:
                raise InputError(
                    f"it has {array.stop - array.start} bytes of text, not {count} values"
                )

    def read(self, array: Element, count: int) -> npt.NDArray[Any]:
        """The `count` values of an array, (count,) in the byte order of the file."""
        dtype = self.dtype(array)
        with self._naming(array), self.path.open("rb") as file:
            if self._is_ascii(array):
                file.seek(array.start)
                self.check(array, count)
                return numbers_in_text(file, array.stop - array.start, dtype, count)
            stream = self._stream(file, array)
            blocks = self._begin(stream, count * dtype.itemsize)
            if not self.compressor:
                return np.frombuffer(stream.read(count * dtype.itemsize), dtype)
            values = np.empty(count * dtype.itemsize, np.uint8)
            done = 0
            for stored, size in blocks:
                data = stream.read(stored)
                with refusing("it cannot be decompressed"):
                    block = COMPRESSORS[self.compressor](data, size)
                if len(block) != size:
                    raise InputError(f"it has a block of {len(block)} bytes, not {size}")
                values[done : done + size] = np.frombuffer(block, np.uint8)
                done += size
        return values.view(dtype)

    def _naming(self, array: Element) -> AbstractContextManager[None]:
        return naming(f"the array {array.attributes.get('Name', '?')}")

    def _is_ascii(self, array: Element) -> bool:
        return array.attributes.get("format", "ascii").lower() == "ascii"

    def _stream(self, file: BinaryIO, array: Element) -> _Stream:
        """The stored bytes of an array, from the size that precedes them on."""
        place, stop = array.start, array.stop
        text = True
        if array.attributes.get("format", "").lower() == "appended":
            offset = array.attributes.get("offset", "")
            if self.document.appended is None or not _is_digits(offset):
                raise InputError(f"the offset {offset!r} is no place in the appended data")
            place, stop = self.document.appended + int(offset), self.document.size
            text = self.document.encoding == "base64"
            following = [each for each in self._offsets if each > int(offset)]
            if following:
                stop = min(stop, self.document.appended + following[0])
        if not place or place > stop:
            raise InputError("it has no values in the file, which is cut")
        return (_Base64 if text else _Stream)(file, place, stop)

    def _begin(self, stream: _Stream, expected: int) -> list[tuple[int, int]]:
        """Read what precedes the values: (stored, true) sizes of the blocks, if compressed."""
        width, compressed = self.header.itemsize, bool(self.compressor)
        sizes = np.frombuffer(stream.read((3 if compressed else 1) * width), self.header).tolist()
        count, block, last = sizes if compressed else (1, sizes[0], 0)
        total = block * count - (block - last if last else 0)
        if total != expected or last > block:
            raise InputError(f"it has {total} bytes, not {expected} for the grid")
        if not compressed:
            stream.require(total)
            return []
        stored = np.frombuffer(stream.read(count * width), self.header).tolist()
        stream.require(sum(stored))
        blocks = [(size, block) for size in stored]
        if last:
            blocks[-1] = (stored[-1], last)
        if any(true > RATIOS[self.compressor] * size for size, true in blocks):
            raise InputError(f"it has blocks that hold fewer bytes, not {expected} for the grid")
        return blocks


class _Stream:
    """Bytes of a file from `start` to `stop`, in order; InputError where they end too early."""

    def __init__(self, file: BinaryIO, start: int, stop: int) -> None:
        self.file, self.left = file, stop - start
        file.seek(start)

    def require(self, count: int) -> None:
        """Raise InputError unless `count` bytes may follow."""
        if count > self._most():
            raise InputError(f"it is cut: {count} bytes should follow, the file has {self._most()}")

    def read(self, count: int) -> bytes:
        """The next `count` bytes."""
        self.require(count)
        data = self._take(count)
        if len(data) != count:
            raise InputError(f"it is cut: {count} bytes should follow, the file has {len(data)}")
        return data

    def _most(self) -> int:
        """Bytes that may be left."""
        return self.left

    def _take(self, count: int) -> bytes:
        data = self.file.read(count)
        self.left -= len(data)
        return data


class _Base64(_Stream):
    """The same, of bytes in base64; padding may end any group of four characters."""

    def __init__(self, file: BinaryIO, start: int, stop: int) -> None:
        super().__init__(file, start, stop)
        self.ready = bytearray()
        self.text = b""

    def _most(self) -> int:
        return len(self.ready) + (len(self.text) + self.left) * 3 // 4

    def _take(self, count: int) -> bytes:
        while len(self.ready) < count and self._more(count - len(self.ready)):
            pass
        data = bytes(self.ready[:count])
        del self.ready[:count]
        return data

    def _more(self, needed: int) -> bool:
        """Decode further text; False at its end."""
        chunk = self.file.read(min(self.left, TEXT_BYTES, 4 * (needed // 3 + 16)))
        self.left -= len(chunk)
        end = chunk.find(b"<")  # the end of the appended data
        if end >= 0:
            chunk, self.left = chunk[:end], 0
        text = self.text + chunk.translate(None, BLANKS)
        whole = len(text) - len(text) % 4
        self.text = text[whole:]
        for part in re.findall(rb"[^=]+=*", text[:whole]):
            try:
                self.ready += base64.b64decode(part, validate=True)
            except ValueError as error:
                raise InputError(f"its base64 text is damaged: {error}") from error
        return bool(chunk)


def _is_digits(text: str) -> bool:
    return text.isascii() and text.isdigit()


def _inflated(inflating: Any, stored: bytes, size: int) -> bytes:
    """A block of zlib or LZMA, and a byte more where it is longer than it should be."""
    block: bytes = inflating.decompress(stored, size + 1)
    if not inflating.eof:
        raise EOFError("a block is cut")
    return block


ZLIB = "vtkZLibDataCompressor"
LZ4 = "vtkLZ4DataCompressor"
LZMA = "vtkLZMADataCompressor"
LZMA_MEMORY = 1 << 28
"""Bytes that LZMA may take for its dictionary: 64 MiB at its highest level, and some more."""
RATIOS = {ZLIB: DEFLATE_RATIO, LZ4: 255, LZMA: 1 << 16}
"""Factors that no block of a compressor shrinks beyond; that of LZMA is far above its 7,000."""
COMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {
    ZLIB: lambda stored, size: _inflated(zlib.decompressobj(), stored, size),
    LZMA: lambda stored, size: _inflated(lzma.LZMADecompressor(memlimit=LZMA_MEMORY), stored, size),
    LZ4: lambda stored, size: importlib.import_module("lz4.block").decompress(stored, size),
}
"""Functions that give the true bytes of a stored block, at most one more than it should have."""
