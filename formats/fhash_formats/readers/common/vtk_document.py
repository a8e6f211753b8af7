"""Structure of a VTK XML file: its elements, and where the bytes of each array lie.

Appended raw bytes are no XML, so reading stops where they begin. The text of arrays is not kept,
only its place. Format: "VTK XML formats", docs.vtk.org.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from fhash_formats.errors import InputError

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
