"""MetaImage: types, byte orders, compression, files of values, positions and damaged headers."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_formats import open_series
from fhash_formats.errors import InputError, MissingInputError

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
        ({"ElementType": "MET_STRING"}, "'MET_STRING'; numbers can be read"),
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
