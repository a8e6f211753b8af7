"""The header of NRRD: fields in any spelling, key/value pairs, vectors and bad lines."""

from __future__ import annotations

import bz2
import gzip
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.readers.images import (
    directions_of,
    dtype_of,
    read_header,
    sizes_of,
    vectors,
    whole,
    words_of,
)
from fhash_formats.readers.registry import open_series


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
    assert sizes_of({"sizes": "3 4"}, "sizes") == (3, 4)
    assert words_of({}, "kinds", 2, "domain") == ["domain", "domain"]
    assert dtype_of({"type": "unsigned  Short int", "endian": "BIG"}).str == ">u2"
    assert vectors("none (1,-2e3) (nan,nan)") == [None, (1, -2000), None]
    assert directions_of({}, 3) is None
    assert (whole({"byte skip": "-1"}, "byte skip"), whole({}, "line skip")) == (-1, 0)
    for wrong in (
        lambda: whole({"byte skip": "-2"}, "byte skip"),
        lambda: vectors("(1,x)"),
        lambda: directions_of({"space directions": "(1,0)"}, 2),
        lambda: dtype_of({"type": "string"}),
        lambda: sizes_of({}, "sizes"),
    ):
        with pytest.raises(InputError):
            wrong()


RNG = np.random.default_rng(0)
VALUES = (RNG.normal(size=(3, 5, 6)) * 100).astype("f4")
TYPES = {
    "i1": "MET_CHAR",
    "u1": "MET_UCHAR",
    "i2": "MET_SHORT",
    "u2": "MET_USHORT",
    "i4": "MET_INT",
    "u4": "MET_UINT",
    "i8": "MET_LONG_LONG",
    "u8": "MET_ULONG_LONG",
    "f4": "MET_FLOAT",
    "f8": "MET_DOUBLE",
}


def write(path: Path, values: np.ndarray, *, data: str = "LOCAL", **fields: object) -> Path:
    """A header with the values behind it, or in the file named `data`."""
    sizes = values.shape[: values.ndim - (1 if "ElementNumberOfChannels" in fields else 0)]
    lines = {
        "ObjectType": "Image",
        "NDims": len(sizes),
        "DimSize": " ".join(map(str, reversed(sizes))),
        "ElementType": TYPES[values.dtype.str[1:]],
        "BinaryDataByteOrderMSB": values.dtype.byteorder == ">",
        **fields,
        "ElementDataFile": data,
    }
    text = "".join(f"{key} = {value}\n" for key, value in lines.items() if value is not None)
    stored = values.tobytes()
    stored = zlib.compress(stored) if fields.get("CompressedData") else stored
    path.write_bytes(text.encode() + (stored if data == "LOCAL" else b""))
    if data != "LOCAL" and " " not in data and "LIST" not in data:
        (path.parent / data).write_bytes(stored)
    return path


def frames(path: Path, **options: Any) -> np.ndarray:
    with open_series(path, **options) as series:
        return np.stack(list(series.frames()))


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("data", ["LOCAL", "values.raw"])
@pytest.mark.parametrize("dtype", [*(f"<{kind}" for kind in TYPES), ">i2", ">f8"])
def test_types_and_files(tmp_path: Path, dtype: str, data: str, compressed: bool) -> None:
    values = np.abs(VALUES).astype(dtype)
    path = write(tmp_path / "a.mhd", values, data=data, CompressedData=compressed)
    with open_series(path) as series:
        assert (series.name, series.dtype) == ("a", values.dtype.newbyteorder("="))
        np.testing.assert_array_equal(series.read(0), values)
        if data != "LOCAL":
            assert tmp_path / data in series.files


def test_positions(tmp_path: Path) -> None:
    fields = {
        "ElementSpacing": "0.5 1 2",
        "Offset": "1 2 3",
        "TransformMatrix": "1 0 0 0 -1 0 0 0 1",
    }
    with open_series(write(tmp_path / "a.mha", VALUES, **fields)) as series:
        assert series.coords["x"].values.tolist() == [1, 1.5, 2, 2.5, 3, 3.5]
        assert series.coords["y"].values.tolist() == [2, 1, 0, -1, -2]
        assert series.coords["z"].values.tolist() == [3, 5, 7]


def test_the_fourth_dimension_is_time(tmp_path: Path) -> None:
    values = np.stack([VALUES, VALUES + 1, VALUES + 2])
    path = write(tmp_path / "a.mha", values, ElementSpacing="1 1 1 0.25", CompressedData=True)
    with open_series(path) as series:
        assert series.coords["t"].values.tolist() == [0, 0.25, 0.5]
        for step in (2, 0, 1):
            np.testing.assert_array_equal(series.read(step), values[step])


def test_a_plane_has_one_z(tmp_path: Path) -> None:
    np.testing.assert_array_equal(frames(write(tmp_path / "a.mha", VALUES[0])), VALUES[None, :1])


def test_channels_are_variables(tmp_path: Path) -> None:
    vector = RNG.normal(size=(3, 5, 6, 2))
    path = write(tmp_path / "a.mha", vector, ElementNumberOfChannels=2)
    np.testing.assert_array_equal(frames(path, var="a.1")[0], vector[..., 1])
    with pytest.raises(InputError, match=r"a\.0 .*a\.1 .*choose one with --var"):
        open_series(path)


def test_slices_in_files_of_their_own(tmp_path: Path) -> None:
    for number, plane in enumerate(VALUES, 1):
        (tmp_path / f"s{number:03}.raw").write_bytes(plane.tobytes())
    path = write(tmp_path / "a.mhd", VALUES, data="s%03d.raw 1 3 1")
    np.testing.assert_array_equal(frames(path)[0], VALUES)
    path = write(tmp_path / "b.mhd", VALUES, data="LIST")
    path.write_text(path.read_text() + "s003.raw\ns002.raw\ns001.raw\n")
    np.testing.assert_array_equal(frames(path)[0], VALUES[::-1])
    (tmp_path / "s002.raw").unlink()
    with pytest.raises(MissingInputError, match=r"s002\.raw, which is not there"):
        open_series(path)


def test_text_and_bytes_that_are_skipped(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mhd", VALUES.astype("i2"), data="v.txt", BinaryData=False)
    (tmp_path / "v.txt").write_text(" ".join(map(str, VALUES.astype("i2").ravel())))
    np.testing.assert_array_equal(frames(path)[0], VALUES.astype("i2"))
    path = write(tmp_path / "b.mhd", VALUES, data="v.raw", HeaderSize=-1)
    (tmp_path / "v.raw").write_bytes(b"x" * 31 + VALUES.tobytes())
    np.testing.assert_array_equal(frames(path)[0], VALUES)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"TransformMatrix": "0 1 0 1 0 0 0 0 1"}, "turned against the axes"),
        ({"ElementSpacing": "1 1"}, "3 numbers are needed"),
        ({"ElementSpacing": "1 0 1"}, "spacing not 0"),
        ({"DimSize": "6 5 0"}, "whole numbers above 0"),
        ({"DimSize": "6 5 30000000"}, "its header promises"),
        ({"DimSize": "60000 60000 60000", "CompressedData": True}, "ones cannot hold"),
        ({"NDims": 4}, "NDims = 4 and DimSize = 6 5 3"),
        ({"ElementType": "MET_STRING"}, "'MET_STRING', which has no numbers"),
        ({"ObjectType": "Tube"}, "'Tube'; Image can be read"),
        ({"ElementNumberOfChannels": "many"}, "ElementNumberOfChannels is 'many'"),
        ({"data": "%d.raw 1 x 1"}, "its pattern of files is"),
        ({"data": "LIST"}, "its list of files is empty"),
    ],
)
def test_unsuitable_headers(tmp_path: Path, fields: dict[str, Any], message: str) -> None:
    path = write(tmp_path / "a.mha", VALUES, **fields)
    with pytest.raises(InputError, match=message) as caught:
        open_series(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("compressed", [False, True])
def test_cut_files_are_refused(tmp_path: Path, compressed: bool) -> None:
    path = write(tmp_path / "a.mha", VALUES, CompressedData=compressed)
    whole = path.read_bytes()
    for length in (20, whole.index(b"LOCAL"), len(whole) - 20):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError) as caught:
            frames(path)
        assert str(path) in str(caught.value)


VALUES_NRRD = RNG.normal(size=(4, 3, 5, 6)).astype("f4")
PACK: dict[str, Callable[[bytes], bytes]] = {
    "raw": bytes,
    "gzip": gzip.compress,
    "gz": lambda data: gzip.compress(data[:100]) + gzip.compress(data[100:]),
    "bzip2": bz2.compress,
}


def write_nrrd(
    path: Path, values: np.ndarray, *lines: str, encoding: str = "raw", data: str = ""
) -> Path:
    """A file with the values in it, or in the file named `data` beside it."""
    kind = {"f4": "float", "f8": "double", "u1": "uchar", "i2": "short"}[values.dtype.str[1:]]
    sizes = " ".join(map(str, reversed(values.shape)))
    header = [
        "NRRD0004",
        "# a remark",
        f"type: {kind}",
        f"dimension: {values.ndim}",
        f"sizes: {sizes}",
        f"endian: {'big' if values.dtype.byteorder == '>' else 'little'}",
        f"encoding: {encoding}",
        *lines,
        *([f"data file: {data}"] if data else []),
    ]
    stored = (
        "\n".join(map(repr, values.ravel().tolist())).encode()
        if encoding == "text"
        else PACK[encoding](values.tobytes())
    )
    head = ("\n".join(header) + "\n\n").encode()
    path.write_bytes(head if data else head + stored)
    if data:
        (path.parent / data).write_bytes(stored)
    return path


@pytest.mark.parametrize("data", ["", "values.bin"])
@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", "u1", ">i2"])
@pytest.mark.parametrize("encoding", ["raw", "gzip", "gz", "bzip2", "text"])
def test_encodings_and_types(tmp_path: Path, encoding: str, dtype: str, data: str) -> None:
    values = (
        (VALUES_NRRD * 20).astype("u1").astype(dtype)
        if dtype == "u1"
        else VALUES_NRRD.astype(dtype)
    )
    path = write_nrrd(tmp_path / "a.nrrd", values, encoding=encoding, data=data)
    with open_series(path) as series:
        assert series.shape == values.shape
        assert series.dtype == values.dtype.newbyteorder("=")
        for step in (2, 0, 3, 3, 1):  # also backwards through what is compressed
            np.testing.assert_array_equal(series.read(step), values[step])
        if data:
            assert tmp_path / data in series.files


def test_positions_and_units(tmp_path: Path) -> None:
    lines = (
        "kinds: space space space time",
        "space dimension: 3",
        "space directions: (0.5,0,0) (0,-1,0) (0,0,2) none",
        "space origin: (1,2,3)",
        'space units: "mm" "mm" "mm"',
        "sample units: m/s",
        "content: wind",
    )
    with open_series(write_nrrd(tmp_path / "a.nrrd", VALUES_NRRD, *lines)) as series:
        assert (series.name, series.units) == ("wind", "m/s")
        assert series.coords["x"].values.tolist() == [1, 1.5, 2, 2.5, 3, 3.5]
        assert series.coords["y"].values.tolist() == [2, 1, 0, -1, -2]
        assert series.coords["z"].values.tolist() == [3, 5, 7]
        assert series.coords["t"].values.tolist() == [0, 1, 2, 3]
        assert series.coords["x"].attributes == {"units": "mm"}
    path = write_nrrd(
        tmp_path / "b.nrrd", VALUES_NRRD, "spacings: 1 2 4 0.25", "axis mins: 0 0 8 nan"
    )
    with open_series(path) as series:
        assert series.coords["z"].values.tolist() == [8, 12, 16]
        assert series.coords["t"].values.tolist() == [0, 0.25, 0.5, 0.75]


@pytest.mark.parametrize(
    ("kinds", "order"),
    [
        ("time domain domain domain", (3, 0, 1, 2)),
        ("domain domain domain time", (0, 1, 2, 3)),
        ("domain domain domain list", (0, 1, 2, 3)),
        ("domain time domain domain", (2, 0, 1, 3)),
    ],
)
def test_time_is_where_the_kinds_say(
    tmp_path: Path, kinds: str, order: tuple[int, int, int, int]
) -> None:
    # the slowest dimension is the last of the kinds
    stored = np.ascontiguousarray(VALUES_NRRD.transpose(np.argsort(order)))
    path = write_nrrd(tmp_path / "a.nrrd", stored, f"kinds: {kinds}")
    np.testing.assert_array_equal(frames(path), stored.transpose(order))


def test_components_are_variables(tmp_path: Path) -> None:
    vector = RNG.normal(size=(2, 5, 6, 3))
    path = write_nrrd(
        tmp_path / "a.nrrd",
        vector,
        "kinds: vector domain domain domain",
        "space dimension: 3",
        "space directions: none (1,0,0) (0,1,0) (0,0,1)",
    )
    np.testing.assert_array_equal(frames(path, var="a.y")[0], vector[..., 1])
    np.testing.assert_array_equal(frames(path, var="a.2")[0], vector[..., 2])
    with pytest.raises(InputError, match=r"a\.x .*a\.y .*a\.z .*choose one with --var"):
        open_series(path)


def test_many_data_files(tmp_path: Path) -> None:
    for step, frame in enumerate(VALUES_NRRD):
        (tmp_path / f"part{step:02}.raw").write_bytes(frame.tobytes())
    write_nrrd(tmp_path / "a.nhdr", VALUES_NRRD, data="part%02d.raw 0 3 1 3")
    np.testing.assert_array_equal(frames(tmp_path / "a.nhdr"), VALUES_NRRD)
    names = "\n".join(f"part{step:02}.raw" for step in (3, 2, 1, 0))
    write_nrrd(tmp_path / "b.nhdr", VALUES_NRRD, data="LIST")
    text = (tmp_path / "b.nhdr").read_text()
    (tmp_path / "b.nhdr").write_text(text.rstrip("\n") + f"\n{names}\n")
    np.testing.assert_array_equal(frames(tmp_path / "b.nhdr"), VALUES_NRRD[::-1])
    (tmp_path / "part02.raw").unlink()
    with pytest.raises(MissingInputError, match=r"part02\.raw, which is not there"):
        open_series(tmp_path / "a.nhdr")


def test_bytes_and_lines_that_are_skipped(tmp_path: Path) -> None:
    path = write_nrrd(tmp_path / "a.nhdr", VALUES_NRRD, "byte skip: -1", data="v.raw")
    (tmp_path / "v.raw").write_bytes(b"x" * 77 + VALUES_NRRD.tobytes())
    np.testing.assert_array_equal(frames(path), VALUES_NRRD)
    path = write_nrrd(
        tmp_path / "b.nhdr", VALUES_NRRD, "line skip: 2", "byte skip: 3", data="w.raw"
    )
    (tmp_path / "w.raw").write_bytes(b"one\ntwo\n123" + VALUES_NRRD.tobytes())
    np.testing.assert_array_equal(frames(path), VALUES_NRRD)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("kinds: RGB-color domain domain domain", r"colours \(RGB-color\)"),
        ("kinds: vector list domain domain", "two of its dimensions hold components"),
        ("kinds: domain domain", "its kinds are 2, its dimensions 4"),
        ("space directions: (0,1,0) (1,0,0) (0,0,1) none", "turned against the axes"),
        ("space directions: (1,0,0)", "space directions are 1"),
        ("sizes: 6 5 3 99999999999", "has .* bytes, its header promises"),
        ("sizes: 6 5 -3 4", "whole numbers above 0"),
        ("sizes: 6 5 3", "3 sizes and the dimension '4'"),
        ("type: block", "'block', which has no numbers"),
        ("encoding: hex", "'hex'; raw, gzip, bzip2 and text can be read"),
        ("endian: middle", "byte order is 'middle'"),
        ("spacings: a b c d", "'a b c d' stands where 4 numbers are needed"),
        ("byte skip: x", "its byte skip is 'x'"),
        ("no colon", "the line 'no colon'"),
    ],
)
def test_unsuitable_headers_nrrd(tmp_path: Path, line: str, message: str) -> None:
    path = write_nrrd(tmp_path / "a.nrrd", VALUES_NRRD, line)
    with pytest.raises(InputError, match=message) as caught:
        open_series(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2", "text"])
def test_cut_files_are_refused_nrrd(tmp_path: Path, encoding: str) -> None:
    path = write_nrrd(tmp_path / "a.nrrd", VALUES_NRRD, encoding=encoding)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError) as caught, open_series(path) as series:
        list(series.frames())
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_compressed_sizes_are_checked_before_memory_is_taken(tmp_path: Path) -> None:
    path = write_nrrd(
        tmp_path / "a.nrrd", VALUES_NRRD, "sizes: 60000 60000 60000 4", encoding="gzip"
    )
    with pytest.raises(InputError, match="compressed ones cannot hold"):
        open_series(path)


def test_damaged_compressed_values_are_refused(tmp_path: Path) -> None:
    path = write_nrrd(tmp_path / "a.nrrd", VALUES_NRRD, encoding="gzip")
    data = bytearray(path.read_bytes())
    data[-400:-390] = bytes(10)
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="cannot be decompressed"):
        frames(path)


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2", "ascii"])
@pytest.mark.parametrize("suffix", [".nrrd", ".nhdr"])
@pytest.mark.filterwarnings("ignore:datetime.datetime.utcnow")  # of pynrrd
def test_files_of_pynrrd(tmp_path: Path, suffix: str, encoding: str) -> None:
    nrrd = pytest.importorskip("nrrd")
    path = tmp_path / f"a{suffix}"
    values = (VALUES_NRRD * 100).astype("i2")
    header = {"encoding": encoding, "kinds": ["domain"] * 3 + ["time"]}
    nrrd.write(str(path), values.transpose(3, 2, 1, 0), header, detached_header=suffix == ".nhdr")
    np.testing.assert_array_equal(frames(path), values)


@pytest.mark.parametrize(
    ("sizes", "pattern"),
    [
        ("4 4 4", "f%0999999999d.raw 1 4 1"),
        ("4 4 4", "f%999d.raw 1 4 1"),
        ("4 4 4", "f%d%d.raw 1 4 1"),
        ("4 4 4", "f%s%d.raw 1 4 1"),
        ("1000000 1000000 1000000", "f%d.raw 1 999999999 1"),
        ("4 4 4", f"f%d.raw 1 {'9' * 5000} 1"),
        ("4 4 4", "f%d.raw 1 5000 1"),
    ],
)
def test_patterns_are_bounded(tmp_path: Path, sizes: str, pattern: str) -> None:
    header = "NRRD0004\ntype: float\ndimension: 3\nencoding: raw\nendian: little\n"
    (tmp_path / "a.nhdr").write_text(f"{header}sizes: {sizes}\ndata file: {pattern}\n\n")
    (tmp_path / "a.mhd").write_text(
        f"NDims = 3\nDimSize = {sizes}\nElementType = MET_FLOAT\nElementDataFile = {pattern}\n"
    )
    for name in ("a.nhdr", "a.mhd"):
        tracemalloc.start()
        with pytest.raises(InputError, match="its pattern of files is"):
            open_series(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
        tracemalloc.stop()


def test_a_list_of_numbered_files_ends_at_the_first_that_is_not_there(tmp_path: Path) -> None:
    header = "NRRD0004\ntype: float\ndimension: 3\nencoding: raw\nendian: little\n"
    (tmp_path / "a.nhdr").write_text(
        f"{header}sizes: 1000 1000 1000\ndata file: f%d.raw 1 1000000 1\n\n"
    )
    (tmp_path / "f1.raw").write_bytes(b"1")
    with pytest.raises(MissingInputError, match=r"f2\.raw, which is not there"):
        open_series(tmp_path / "a.nhdr")


def test_sizes_are_bounded(tmp_path: Path) -> None:
    header = "NRRD0004\ntype: float\nencoding: bzip2\nendian: little\n"
    (tmp_path / "a.nrrd").write_text(f"{header}dimension: 20\nsizes: {'2 ' * 20}\n\n")
    with pytest.raises(InputError, match="20 sizes"):
        open_series(tmp_path / "a.nrrd")
    (tmp_path / "b.nrrd").write_text(f"{header}dimension: 3\nsizes: 4000000 4000000 4000\n\nBZh9")
    with pytest.raises(InputError, match="cannot hold"):
        open_series(tmp_path / "b.nrrd")
