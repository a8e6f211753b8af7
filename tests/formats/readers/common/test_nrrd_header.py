"""The header of NRRD: fields in any spelling, key/value pairs, vectors and bad lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from fhash_formats.errors import InputError
from fhash_formats.readers.common.nrrd_header import (
    directions_of,
    dtype_of,
    number_of,
    read_header,
    sizes_of,
    vectors,
    whole,
    words_of,
)


def header(folder: Path, *lines: str) -> tuple[dict[str, str], dict[str, str], int]:
    (folder / "a.nrrd").write_text("\n".join(["NRRD0005", *lines]) + "\n\nvalues")
    return read_header(folder / "a.nrrd")


def test_fields_pairs_and_the_end(tmp_path: Path) -> None:
    lines = ("Data File: a b.raw", "datafile: c.raw", "# no: field", "key:=a:=b", "axismins: 1 2")
    fields, pairs, end = header(tmp_path, *lines)
    assert fields == {"data file": "c.raw", "axis mins": "1 2"}
    assert pairs == {"key": "a:=b"}
    assert (tmp_path / "a.nrrd").read_bytes()[end:] == b"values"


def test_lines_of_windows(tmp_path: Path) -> None:
    (tmp_path / "a.nrrd").write_bytes(b"NRRD0004\r\nsizes: 1 2\r\n\r\nvalues")
    fields, _, end = read_header(tmp_path / "a.nrrd")
    assert (fields["sizes"], end) == ("1 2", 24)


@pytest.mark.parametrize("first", ["NRRD0006", "NRRD", "NRRD00.01", "nrrd0001"])
def test_other_versions(tmp_path: Path, first: str) -> None:
    (tmp_path / "a.nrrd").write_text(f"{first}\n\n")
    with pytest.raises(InputError, match="NRRD0001 to NRRD0005 can be read"):
        read_header(tmp_path / "a.nrrd")


def test_numbers_of_fields() -> None:
    assert sizes_of({"sizes": "3 4", "dimension": "2"}) == (3, 4)
    assert words_of({}, "kinds", 2, "domain") == ["domain", "domain"]
    assert dtype_of({"type": "unsigned  Short int", "endian": "BIG"}).str == ">u2"
    assert vectors("none (1,-2e3) (nan,nan)") == [None, (1, -2000), None]
    assert directions_of({}, 3) is None
    assert (whole({"byte skip": "-1"}, "byte skip"), whole({}, "line skip")) == (-1, 0)
    assert number_of("-inf") == -float("inf")
    for wrong in (
        lambda: whole({"byte skip": "-2"}, "byte skip"),
        lambda: vectors("(1,x)"),
        lambda: directions_of({"space directions": "(1,0)"}, 2),
        lambda: dtype_of({"type": "string"}),
        lambda: sizes_of({}),
        lambda: number_of("x"),
    ):
        with pytest.raises(InputError):
            wrong()
