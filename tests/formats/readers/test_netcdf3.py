"""Classic NetCDF: the three kinds, records, texts, 64-bit integers, damaged headers."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from fhash_formats.errors import InputError
from fhash_formats.readers import open_series
from fhash_formats.readers.netcdf3 import ClassicStore, read_header

TYPES = ["i1", "S1", ">i2", ">i4", ">f4", ">f8", "u1", ">u2", ">u4", ">i8", ">u8"]


def classic(
    path: Path,
    kind: int,
    dimensions: dict[str, int],
    variables: dict[str, tuple[tuple[str, ...], np.ndarray[Any, Any], dict[str, Any]]],
    *,
    streaming: bool = False,
) -> Path:
    """Write a file as the specification says; a length of 0 is that of the unlimited dimension."""
    wide = 8 if kind == 5 else 4

    def count(n: int) -> bytes:
        return n.to_bytes(wide, "big")

    def padded(data: bytes) -> bytes:
        return data + bytes(-len(data) % 4)

    def name(text: str) -> bytes:
        data = text.encode()
        return count(len(data)) + padded(data)

    def listed(tag: int, members: list[bytes]) -> bytes:
        return (tag if members else 0).to_bytes(4, "big") + count(len(members)) + b"".join(members)

    def number(dtype: np.dtype[Any]) -> int:
        return 1 + TYPES.index(dtype.newbyteorder(">").str.replace("|", ""))

    def attribute(key: str, value: Any) -> bytes:
        if isinstance(value, bytes):
            return name(key) + (2).to_bytes(4, "big") + count(len(value)) + padded(value)
        array = np.atleast_1d(value)
        data = array.astype(array.dtype.newbyteorder(">")).tobytes()
        return name(key) + number(array.dtype).to_bytes(4, "big") + count(len(array)) + padded(data)

    keys = list(dimensions)
    records = max(
        (len(v) for d, v, _ in variables.values() if d and not dimensions[d[0]]), default=0
    )
    blocks = {
        key: value.astype(value.dtype.newbyteorder(">")) for key, (_, value, _) in variables.items()
    }
    recorded = [key for key, (d, _, _) in variables.items() if d and not dimensions[d[0]]]

    def one_record(key: str, i: int) -> bytes:
        data = blocks[key][i : i + 1].tobytes()  # a scalar would be native
        return data if len(recorded) == 1 else padded(data)

    fixed = {key: padded(blocks[key].tobytes()) for key in variables if key not in recorded}
    stated = bytes([255]) * wide if streaming else count(records)

    def header(begins: dict[str, int]) -> bytes:
        described = [
            name(key)
            + count(len(dims))
            + b"".join(count(keys.index(each)) for each in dims)
            + listed(12, [attribute(k, v) for k, v in attributes.items()])
            + number(value.dtype).to_bytes(4, "big")
            + count(len(fixed.get(key) or padded(one_record(key, 0))))
            + begins.get(key, 0).to_bytes(4 if kind == 1 else 8, "big")
            for key, (dims, value, attributes) in variables.items()
        ]
        named = [name(key) + count(length) for key, length in dimensions.items()]
        return (
            b"CDF"
            + bytes([kind])
            + stated
            + listed(10, named)
            + listed(12, [])
            + listed(11, described)
        )

    at, begins, tail = len(header({})), {}, b""
    for key, data in fixed.items():
        begins[key] = at + len(tail)
        tail += data
    start = at + len(tail)
    for key in recorded:
        begins[key] = start
        start += len(one_record(key, 0))
    for i in range(records):
        tail += b"".join(one_record(key, i) for key in recorded)
    path.write_bytes(header(begins) + tail)
    return path


def everything(kind: int) -> dict[str, Any]:
    """Variables of all types of a kind, along the unlimited dimension and not."""
    rng = np.random.default_rng(kind)
    made: dict[str, Any] = {}
    for dtype in TYPES if kind == 5 else TYPES[:6]:
        for dims in (("t", "y", "x"), ("y", "x"), ("t",), ()):
            shape = tuple({"t": 3, "y": 2, "x": 5}[d] for d in dims)
            values = np.frombuffer(rng.bytes(64 * 8), np.dtype(dtype).newbyteorder("="))
            values = values[: int(np.prod(shape))].reshape(shape)
            attribute = b"text" if dtype == "S1" else values.reshape(-1)[:3]
            made[f"v{dtype[-2:]}_{''.join(dims)}"] = (dims, values, {"n": attribute})
    return {k: v for k, v in made.items() if "S1" not in k or v[1].ndim}


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize("kind", [1, 2, 5])
def test_all_types_of_the_three_kinds(tmp_path: Path, kind: int, streaming: bool) -> None:
    variables = everything(kind)
    lengths = {"x": 5, "t": 0, "y": 2}
    path = classic(tmp_path / "a.nc", kind, lengths, variables, streaming=streaming)
    found = xr.open_dataset(ClassicStore(path), engine="store", decode_cf=False)
    assert set(found.variables) == set(variables)
    for key, (dims, values, _) in variables.items():
        assert found[key].dims == dims
        assert found[key].values.astype(values.dtype).tobytes() == values.tobytes(), key
    if kind < 5 and not streaming:  # as a second reader sees it
        with xr.open_dataset(path, engine="scipy", mmap=False, decode_cf=False) as other:
            xr.testing.assert_identical(other, found)


def test_records_of_one_array_alone_are_not_padded(tmp_path: Path) -> None:
    values = np.arange(3 * 2 * 3 * 5, dtype=np.int8).reshape(3, 2, 3, 5)[:, :, :, :5]
    lengths = {"t": 0, "z": 2, "y": 3, "x": 5}
    path = classic(tmp_path / "a.nc", 1, lengths, {"v": (tuple("tzyx"), values, {})})
    with open_series(path) as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), values)
        np.testing.assert_array_equal(series.read(2), values[2])


def test_64_bit_integers_of_cdf5_keep_every_digit_and_their_fill_value(tmp_path: Path) -> None:
    values = 2**60 + np.arange(2 * 3 * 4 * 5).reshape(2, 3, 4, 5)
    values[1, 2, 3, 4] = -(2**62) - 1
    lengths = {"t": 0, "z": 3, "y": 4, "x": 5}
    fill = {"_FillValue": np.int64(-(2**62) - 1)}
    path = classic(tmp_path / "a.nc", 5, lengths, {"v": (tuple("tzyx"), values, fill)})
    with open_series(path, raw_values=True) as series:
        np.testing.assert_array_equal(series.read(1), values[1])
    with open_series(path) as series:
        missing = np.isnan(series.read(1).astype(float))
    assert np.argwhere(missing).tolist() == [[2, 3, 4]]


def test_names_are_utf8_and_texts_that_are_not_are_latin_1(tmp_path: Path) -> None:
    values = np.zeros((2, 3, 4, 5), np.float32)
    attributes = {"units": "\u00b0C".encode("latin-1"), "long_name": "t\u00e9mp".encode()}
    lengths = {"t": 2, "z": 3, "y": 4, "x": 5}
    path = classic(tmp_path / "a.nc", 2, lengths, {"t\u00e9": (tuple("tzyx"), values, attributes)})
    with open_series(path) as series:
        assert series.name == "t\u00e9"
        assert series.attributes == {"units": "\u00b0C", "long_name": "t\u00e9mp"}


@pytest.mark.parametrize("kind", [1, 5])
def test_a_damaged_header_is_one_line_or_another_sound_one(tmp_path: Path, kind: int) -> None:
    values = np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5)
    lengths = {"t": 0, "z": 3, "y": 4, "x": 5}
    path = classic(tmp_path / "a.nc", kind, lengths, {"v": (tuple("tzyx"), values, {"a": b"bc"})})
    sound = path.read_bytes()
    begin = read_header(path).variables["v"].begin
    messages = []
    for at in range(4, begin):
        damaged = bytearray(sound)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        try:
            with open_series(path) as series:
                series.read(0)
        except InputError as error:
            messages.append(str(error))
    assert len(messages) > begin // 4
    assert not [message for message in messages if "\n" in message]


@pytest.mark.parametrize("left", [40, 100, 300, -1])
def test_a_file_that_was_cut_off_says_so(tmp_path: Path, left: int) -> None:
    values = np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5)
    lengths = {"t": 0, "z": 3, "y": 4, "x": 5}
    path = classic(tmp_path / "a.nc", 2, lengths, {"v": (tuple("tzyx"), values, {})})
    os.truncate(path, left % path.stat().st_size)
    with pytest.raises(InputError, match=f"{path} cannot be read as classic NetCDF: ") as caught:
        open_series(path)
    assert "\n" not in str(caught.value)
