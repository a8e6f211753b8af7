"""The structure of VTK XML files: places of text, appended data, hostile XML."""

from __future__ import annotations

from pathlib import Path

import pytest

from fhash_formats.errors import InputError
from fhash_formats.readers.common import vtk_document
from fhash_formats.readers.common.vtk_document import Document, parse


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
