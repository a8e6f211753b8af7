"""VTK XML documents: elements, and the arrays in and behind them."""

from __future__ import annotations

import base64
import importlib
import lzma
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from xml.parsers import expat

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.readers.stored_bytes import DEFLATE_RATIO, numbers_of_words

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
        start, stop: bytes of the file that hold the text of a DataArray; start is None without
            text.
    """

    name: str
    attributes: dict[str, str]
    children: list[Element] = field(default_factory=list)
    note: str = ""
    start: int | None = None
    stop: int = 0

    def all(self, name: str) -> Iterator[Element]:
        """Yield the children of a name."""
        return (child for child in self.children if child.name == name)

    def first(self, name: str) -> Element | None:
        """The first child of a name, None without one."""
        return next(self.all(name), None)


@dataclass(frozen=True, kw_only=True)
class Document:
    """A parsed file.

    Attributes:
        root: its outermost element.
        appended: the byte behind the "_" that begins the appended data; None without them.
        encoding: of the appended data, "raw" or "base64".
        size: bytes of the file up to the end of the appended data.
    """

    root: Element
    appended: int | None
    encoding: str
    size: int


class _AppendedData(Exception):
    """Parsing has come to the appended data."""


class _Builder:
    """Builds the tree of elements from the parser's events."""

    def __init__(self) -> None:
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._begin
        self.parser.EndElementHandler = self._end
        self.parser.StartDoctypeDeclHandler = self._doctype
        self.stack: list[Element] = []
        self.root: Element | None = None
        self.appended_tag: int | None = None
        self.encoding = "raw"
        self.count = 0

    def _doctype(self, *_: Any) -> None:
        raise InputError("it declares a document type, which no VTK file has")

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        self.count += 1
        if self.count > MAX_ELEMENTS:
            raise InputError(f"it has more than {MAX_ELEMENTS} elements")
        if name == "AppendedData":
            self.appended_tag = self.parser.CurrentByteIndex
            self.encoding = attributes.get("encoding", "raw").lower()
            raise _AppendedData
        element = Element(name, attributes)
        if self.stack:
            self.stack[-1].children.append(element)
            self._close_text()
        elif self.root is None:
            self.root = element
        self.stack.append(element)
        self.parser.CharacterDataHandler = self._text

    def _text(self, text: str) -> None:
        top = self.stack[-1]
        if top.name == "InformationKey":
            top.note = (top.note + text)[:MAX_NOTE]
        elif text.strip() and top.start is None:
            top.start = self.parser.CurrentByteIndex
            self.parser.CharacterDataHandler = None  # the place of the first text is enough

    def _end(self, name: str) -> None:
        self._close_text()
        self.stack.pop()
        self.parser.CharacterDataHandler = self._text

    def _close_text(self) -> None:
        """End the text of the innermost element; information keys may stand before and behind."""
        top = self.stack[-1]
        if top.start is not None and not top.stop:
            top.stop = self.parser.CurrentByteIndex


def parse(path: Path) -> Document:
    """Parse a file up to its appended data.

    Raises InputError for what is no XML, or ends before its last element.
    """
    builder = _Builder()
    size = path.stat().st_size
    with path.open("rb") as file:
        try:
            while chunk := file.read(CHUNK_BYTES):
                builder.parser.Parse(chunk, False)
            builder.parser.Parse(b"", True)
        except _AppendedData:
            pass
        except expat.ExpatError as error:
            raise InputError(f"it is cut or no XML: {error}") from error
        appended = None
        if builder.appended_tag is not None:
            file.seek(builder.appended_tag)
            tag = file.read(MAX_NOTE)
            end = tag.find(b">")
            data = tag.find(b"_", end)
            if end < 0 or data < 0 or tag[end + 1 : data].strip():
                raise InputError("its appended data do not begin with '_'; the file is cut")
            appended = builder.appended_tag + data + 1
            file.seek(max(appended, size - MAX_NOTE))
            tail = file.read()
            end = tail.rfind(b"</AppendedData")
            size -= len(tail) - end if end >= 0 else 0
    if builder.root is None:
        raise InputError("it holds no element")
    return Document(root=builder.root, appended=appended, encoding=builder.encoding, size=size)


TYPES = {
    "Int8": "i1",
    "UInt8": "u1",
    "Int16": "i2",
    "UInt16": "u2",
    "Int32": "i4",
    "UInt32": "u4",
    "Int64": "i8",
    "UInt64": "u8",
    "Float32": "f4",
    "Float64": "f8",
}
"""Number types of arrays by their name in the file."""

HEADERS = {"UInt32": "u4", "UInt64": "u8"}
"""Number types of the sizes that precede binary values."""

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
        if order not in ("LittleEndian", "BigEndian") or header not in HEADERS:
            raise InputError(f"its byte order is {order!r} and its header type {header!r}")
        if document.encoding not in ("raw", "base64"):
            raise InputError(f"its appended data are encoded as {document.encoding!r}")
        self.order = "<" if order == "LittleEndian" else ">"
        self.header = np.dtype(self.order + HEADERS[header])
        self.inflate = _compressor(root.get("compressor", ""))
        self._offsets: list[int] = []
        if document.appended is not None and document.encoding == "base64":
            self._offsets = sorted(_offsets(document.root))

    def dtype(self, array: Element) -> np.dtype[Any]:
        """The type of an array's values in the file; object for text and other types."""
        kind = TYPES.get(array.attributes.get("type", ""))
        return np.dtype(object) if kind is None else np.dtype(self.order + kind)

    def check(self, array: Element, count: int) -> None:
        """Raise InputError unless the sizes in the file are those of `count` values."""
        if self._is_ascii(array):
            if _text_bytes(array) < 2 * count - 1:
                raise self._wrong(array, f"{_text_bytes(array)} bytes of text", f"{count} values")
            return
        with self.path.open("rb") as file:
            self._begin(array, self._stream(file, array), count * self.dtype(array).itemsize)

    def read(self, array: Element, count: int) -> npt.NDArray[Any]:
        """The `count` values of an array, (count,) in the byte order of the file."""
        dtype = self.dtype(array)
        if self._is_ascii(array):
            return self._ascii(array, count, dtype)
        with self.path.open("rb") as file:
            stream = self._stream(file, array)
            blocks = self._begin(array, stream, count * dtype.itemsize)
            if blocks is None:
                return np.frombuffer(stream.read(count * dtype.itemsize), dtype)
            values = np.empty(count * dtype.itemsize, np.uint8)
            done = 0
            for stored, size in blocks:
                values[done : done + size] = np.frombuffer(
                    self._block(array, stream.read(stored), size), np.uint8
                )
                done += size
        return values.view(dtype)

    def _is_ascii(self, array: Element) -> bool:
        return array.attributes.get("format", "ascii").lower() == "ascii"

    def _ascii(self, array: Element, count: int, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
        with self.path.open("rb") as file:
            file.seek(array.start or 0)
            words = file.read(_text_bytes(array)).split()
        if len(words) != count:
            raise self._wrong(array, f"{len(words)} values", str(count))
        try:
            return numbers_of_words(words, dtype)
        except ValueError as error:
            raise InputError(f"{self._name(array)}: {error}") from error

    def _stream(self, file: BinaryIO, array: Element) -> _Stream:
        """The stored bytes of an array, from the size that precedes them on."""
        place, stop = array.start, array.stop
        text = True
        if array.attributes.get("format", "").lower() == "appended":
            offset = array.attributes.get("offset", "")
            if self.document.appended is None or not (offset.isascii() and offset.isdigit()):
                raise self._wrong(array, f"the offset {offset!r}", "a place in the appended data")
            place, stop = self.document.appended + int(offset), self.document.size
            text = self.document.encoding == "base64"
            following = [each for each in self._offsets if each > int(offset)]
            if following:
                stop = min(stop, self.document.appended + following[0])
        if place is None or place > stop:
            raise self._wrong(array, "no values in the file", "values; the file is cut")
        return (_Base64 if text else _Stream)(file, place, stop)

    def _begin(
        self, array: Element, stream: _Stream, expected: int
    ) -> list[tuple[int, int]] | None:
        """Read what precedes the values: (stored, true) sizes of the blocks, None without them."""
        width = self.header.itemsize
        try:
            if self.inflate is None:
                size = int(np.frombuffer(stream.read(width), self.header)[0])
                if size != expected:
                    raise self._wrong(array, f"{size} bytes", f"{expected} for the grid")
                stream.require(size)
                return None
            count, block, last = (
                int(n) for n in np.frombuffer(stream.read(3 * width), self.header)
            )
            total = block * count - (block - last if last else 0)
            if total != expected or last > block:
                raise self._wrong(array, f"{total} bytes", f"{expected} for the grid")
            stream.require(count * width)
            stored = np.frombuffer(stream.read(count * width), self.header).astype(object)
            stream.require(int(sum(stored)))
        except EOFError as error:
            raise InputError(f"{self._name(array)} is cut: {error}") from error
        true = [block] * count
        if last:
            true[-1] = last
        blocks = [(int(size), whole) for size, whole in zip(stored, true, strict=True)]
        if self.inflate is _inflate_zlib and any(w > DEFLATE_RATIO * n for n, w in blocks):
            raise self._wrong(array, "blocks that hold fewer bytes", f"{expected} for the grid")
        return blocks

    def _block(self, array: Element, stored: bytes, size: int) -> bytes:
        assert self.inflate is not None
        try:
            block = self.inflate(stored, size)
        except (zlib.error, lzma.LZMAError, EOFError, ValueError, RuntimeError) as error:
            raise InputError(f"{self._name(array)} cannot be decompressed: {error}") from error
        if len(block) != size:
            raise self._wrong(array, f"a block of {len(block)} bytes", str(size))
        return block

    def _name(self, array: Element) -> str:
        return f"the array {array.attributes.get('Name', '?')}"

    def _wrong(self, array: Element, found: str, needed: str) -> InputError:
        return InputError(f"{self._name(array)} has {found}, not {needed}")


class _Stream:
    """Bytes of a file from `start` to `stop`, read in order.

    `read` raises EOFError where they end too early.
    """

    def __init__(self, file: BinaryIO, start: int, stop: int) -> None:
        self.file, self.left = file, stop - start
        file.seek(start)

    def require(self, count: int) -> None:
        """Raise EOFError unless `count` bytes may follow."""
        if count > self.left:
            raise EOFError(f"{count} bytes should follow, the file has {self.left}")

    def read(self, count: int) -> bytes:
        """The next `count` bytes."""
        self.require(count)
        data = self.file.read(count)
        self.left -= len(data)
        if len(data) != count:
            raise EOFError(f"{count} bytes should follow, the file has {len(data)}")
        return data


class _Base64(_Stream):
    """The same, of bytes in base64; padding may end any group of four characters."""

    def __init__(self, file: BinaryIO, start: int, stop: int) -> None:
        super().__init__(file, start, stop)
        self.ready = bytearray()
        self.text = b""

    def require(self, count: int) -> None:
        """Raise EOFError unless `count` bytes may follow."""
        if count > len(self.ready) + (len(self.text) + self.left) * 3 // 4:
            raise EOFError(f"{count} bytes should follow, and the text is shorter")

    def read(self, count: int) -> bytes:
        """The next `count` bytes."""
        self.require(count)
        while len(self.ready) < count and self._more(count - len(self.ready)):
            pass
        if len(self.ready) < count:
            raise EOFError(f"{count} bytes should follow, the text has {len(self.ready)}")
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


def _text_bytes(array: Element) -> int:
    return 0 if array.start is None else array.stop - array.start


def _offsets(element: Element) -> set[int]:
    """Offsets of all appended arrays in and below an element."""
    found, waiting = set(), [element]
    while waiting:
        each = waiting.pop()
        waiting += each.children
        offset = each.attributes.get("offset", "")
        if each.name == "DataArray" and offset.isascii() and offset.isdigit():
            found.add(int(offset))
    return found


def _inflate_zlib(stored: bytes, size: int) -> bytes:
    inflating = zlib.decompressobj()
    block = inflating.decompress(stored, size + 1)
    if not inflating.eof:
        raise EOFError("a block is cut")
    return block


def _inflate_lzma(stored: bytes, size: int) -> bytes:
    inflating = lzma.LZMADecompressor()
    block = inflating.decompress(stored, size + 1)
    if not inflating.eof:
        raise EOFError("a block is cut")
    return block


def _inflate_lz4(stored: bytes, size: int) -> bytes:
    block: bytes = importlib.import_module("lz4.block").decompress(stored, uncompressed_size=size)
    return block


def _compressor(name: str) -> Callable[[bytes, int], bytes] | None:
    """The function (stored block, size) -> values of a compressor; None where the file has none."""
    if not name:
        return None
    if name == "vtkLZ4DataCompressor":
        try:
            importlib.import_module("lz4.block")
        except ImportError as error:
            raise MissingDependencyError(
                "it is compressed with LZ4, which needs lz4: pip install 'fhash[formats]'"
            ) from error
        return _inflate_lz4
    known = {"vtkZLibDataCompressor": _inflate_zlib, "vtkLZMADataCompressor": _inflate_lzma}
    if name not in known:
        raise InputError(f"its compressor is {name!r}; known are {', '.join(known)} and LZ4's")
    return known[name]
