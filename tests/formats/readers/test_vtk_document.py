"""Stored arrays of VTK files: sizes that do not fit, made by hand; `test_vtk_xml.py` has VTK's."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.readers import vtk_document
from fhash_formats.readers.vtk_document import Document, VtkArrays, parse

VALUES = np.arange(6, dtype="<f4")


def arrays(folder: Path, stored: bytes, compressor: str = "", encoding: str = "raw") -> VtkArrays:
    """A file of one appended array."""
    extra = f' compressor="{compressor}"' if compressor else ""
    head = f'<VTKFile type="ImageData" header_type="UInt32"{extra}>'
    head += '<DataArray type="Float32" Name="u" format="appended" offset="0"/>'
    head += f'<AppendedData encoding="{encoding}">_'
    data = base64.b64encode(stored) if encoding == "base64" else stored
    (folder / "a.vti").write_bytes(head.encode() + data + b"</AppendedData></VTKFile>")
    return VtkArrays(folder / "a.vti", parse(folder / "a.vti"))


def read(found: VtkArrays, count: int = 6) -> np.ndarray:
    (element,) = found.document.root.children
    found.check(element, count)
    return found.read(element, count)


def blocks(*sizes: int, block: int = 16, last: int = 8, data: bytes | None = None) -> bytes:
    """Compressed values with a header that may lie."""
    raw = VALUES.tobytes()
    parts = [zlib.compress(raw[:16]), zlib.compress(raw[16:])]
    header = struct.pack("<3I", 2, block, last)
    stored = sizes or tuple(map(len, parts))
    return header + struct.pack(f"<{len(stored)}I", *stored) + (data or b"".join(parts))


ZLIB = "vtkZLibDataCompressor"


@pytest.mark.parametrize(
    ("stored", "compressor", "message"),
    [
        (struct.pack("<I", 20) + VALUES.tobytes(), "", "has 20 bytes, not 24 for the grid"),
        (struct.pack("<I", 24) + b"123", "", "is cut|cut"),
        (b"", "", "is cut|not 24 for the grid"),
        (blocks(block=2**31), ZLIB, "not 24 for the grid"),
        (blocks(last=17), ZLIB, "not 24 for the grid"),
        (blocks(5, 2**31), ZLIB, "is cut"),
        (blocks(5, 5), ZLIB, "cannot be decompressed"),
        (struct.pack("<3I", 2**32 - 1, 0, 0), ZLIB, "not 24 for the grid"),
    ],
)
def test_sizes_that_do_not_fit(
    tmp_path: Path, stored: bytes, compressor: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        read(arrays(tmp_path, stored, compressor))


def test_blocks_that_promise_more_than_zlib_can_hold(tmp_path: Path) -> None:
    header = struct.pack("<4I", 1, 1032 * 10 + 4, 0, 10)
    with pytest.raises(InputError, match="blocks that hold fewer bytes"):
        read(arrays(tmp_path, header + bytes(10), ZLIB), count=1032 * 10 // 4 + 1)
    header = struct.pack("<4I", 1, 1032 * 10, 0, 10)
    with pytest.raises(InputError, match="cannot be decompressed"):
        read(arrays(tmp_path, header + bytes(10), ZLIB), count=1032 * 10 // 4)


def test_base64_that_is_damaged(tmp_path: Path) -> None:
    found = arrays(tmp_path, struct.pack("<I", 24) + VALUES.tobytes(), encoding="base64")
    data = found.path.read_bytes()
    place = data.index(b">_") + 5
    found.path.write_bytes(data[:place] + b"\xff" + data[place + 1 :])
    with pytest.raises(InputError, match="base64 text is damaged"):
        read(VtkArrays(found.path, parse(found.path)))


def parsed(folder: Path, text: str) -> Document:
    (folder / "a.vti").write_bytes(text.encode())
    return parse(folder / "a.vti")


@pytest.mark.parametrize(
    "inside",
    ["  1 2 3\n", "{} 1 2 3 ", "1 2 3{}", "{}{}\n1 2 3", "<Key><Value>7</Value></Key>1 2 3"],
)
def test_the_text_of_an_array_lies_between_its_keys(tmp_path: Path, inside: str) -> None:
    key = '<InformationKey name="UNITS_LABEL">m/s</InformationKey>'
    text = f"<VTKFile><DataArray Name='a>b'>{inside.replace('{}', key)}</DataArray></VTKFile>"
    (array,) = parsed(tmp_path, text).root.all("DataArray")
    assert array.start is not None
    assert text[array.start : array.stop].split() == ["1", "2", "3"]
    assert {each.note for each in array.all("InformationKey")} <= {"m/s"}


def test_long_text_is_not_kept_and_its_end_is_right(tmp_path: Path) -> None:
    numbers = "\n".join(map(str, range(100_000)))
    text = f"<VTKFile><DataArray>{numbers}</DataArray><DataArray>5</DataArray></VTKFile>"
    first, second = parsed(tmp_path, text).root.children
    assert text[first.start : first.stop] == numbers
    assert text[second.start : second.stop] == "5"
    assert first.note == ""


def test_appended_data_begin_behind_the_underscore(tmp_path: Path) -> None:
    text = '<VTKFile><A/><AppendedData encoding="base64" >\n  _<&\0'
    document = parsed(tmp_path, text)
    assert document.appended == text.index("_") + 1
    assert (document.encoding, document.size) == ("base64", len(text))
    assert [child.name for child in document.root.children] == ["A"]
    closed = parsed(tmp_path, f"{text}\n</AppendedData>\n</VTKFile>")
    assert closed.size == len(text) + 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cut or no XML"),
        ("<VTKFile><A>", "cut or no XML"),
        ("<VTKFile></B>", "cut or no XML"),
        ("no XML", "cut or no XML"),
        ("<VTKFile><AppendedData>", "do not begin with '_'"),
        ("<VTKFile><AppendedData", "cut or no XML"),
        ("<VTKFile><AppendedData>x_", "do not begin with '_'"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><VTKFile>&b;</VTKFile>", "document type"),
    ],
)
def test_what_is_no_such_file(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parsed(tmp_path, text)


def test_the_number_of_elements_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vtk_document, "MAX_ELEMENTS", 10)
    assert len(parsed(tmp_path, f"<V>{'<A/>' * 9}</V>").root.children) == 9
    with pytest.raises(InputError, match="more than 10 elements"):
        parsed(tmp_path, f"<V>{'<A/>' * 10}</V>")
