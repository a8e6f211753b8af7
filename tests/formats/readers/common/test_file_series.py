"""Errors of readers on one line, and sources that change while they are read."""

from __future__ import annotations

import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr
from stored_series import VALUES

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.readers.common.file_series import (
    DTYPES,
    LONGEST_MESSAGE,
    FileSeries,
    FolderStamp,
    RawLayout,
    Request,
    Stamp,
    condense,
    parse_axes,
    parse_dtype,
    parse_shape,
    refusing,
)
from fhash_formats.readers.registry import open_series


def test_a_message_is_one_line_of_bounded_length() -> None:
    assert condense(ValueError("two\n  lines")) == "two lines"
    assert condense(ValueError("")) == "ValueError"
    assert len(condense(ValueError("long " * 1000))) == LONGEST_MESSAGE


def test_errors_of_libraries_become_input_errors_and_ours_pass() -> None:
    refused = pytest.raises(InputError, match="a cannot be read: KeyError")
    with refused as caught, refusing("a cannot be read"):
        raise KeyError
    assert isinstance(caught.value.__cause__, KeyError)
    for error in (MissingInputError("gone"), MemoryError(), KeyboardInterrupt()):
        with pytest.raises(type(error)) as passed, refusing("a"):
            raise error
        assert passed.value is error


def test_a_stamp_tells_a_file_that_changed(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    stamp = Stamp.of(path)
    stamp.check()
    os.utime(path, ns=(1, 1))
    with pytest.raises(InputError, match=r"changed.*same size, written again"):
        stamp.check()
    path.write_bytes(b"123")
    with pytest.raises(InputError, match="5 bytes before, 3 now"):
        stamp.check()
    path.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        stamp.check()


def test_a_stamp_of_a_folder_tells_any_change_below_it(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    file = tmp_path / "inner" / "a"
    file.write_bytes(b"12345")
    stamp = FolderStamp.of(tmp_path)
    assert (stamp.files, stamp.size) == (1, 5)
    stamp.check()
    os.utime(file, ns=(1, 1))
    with pytest.raises(InputError, match="something in it was written again"):
        stamp.check()
    (tmp_path / "b").write_bytes(b"6")
    with pytest.raises(InputError, match="1 files and 5 bytes before, 2 and 6 now"):
        stamp.check()


Save = Callable[[Path, np.ndarray, tuple[int, ...]], None]


def write_chunked_hdf5(path: Path, values: np.ndarray, chunks: tuple[int, ...]) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("v", data=values, chunks=chunks, compression="gzip")


def write_chunked_netcdf(path: Path, values: np.ndarray, chunks: tuple[int, ...]) -> None:
    dataset = xr.Dataset({"v": (("time", "lev", "lat", "lon"), values)})
    dataset.to_netcdf(path, engine="h5netcdf", encoding={"v": {"chunksizes": chunks, "zlib": True}})


def write_chunked_zarr(path: Path, values: np.ndarray, chunks: tuple[int, ...]) -> None:
    zarr.create_array(path, shape=values.shape, dtype=values.dtype, chunks=chunks)[...] = values


formats = pytest.mark.parametrize(
    ("suffix", "save"),
    [(".h5", write_chunked_hdf5), (".nc", write_chunked_netcdf), (".zarr", write_chunked_zarr)],
)


@formats
def test_one_frame_is_read_at_a_time(tmp_path: Path, suffix: str, save: Save) -> None:
    values = np.random.default_rng(0).random((40, 16, 32, 32), np.float32)
    save(tmp_path / f"a{suffix}", values, (1, 16, 32, 32))
    with open_series(tmp_path / f"a{suffix}") as series:
        series.read(0)
        tracemalloc.start()
        for step in (3, 30):
            series.read(step)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 6 * values[0].nbytes  # stored, decompressed, and in the order asked for


@formats
@pytest.mark.parametrize(("limit", "held"), [(2**20, 3), (1000, 2), (1, None)])
def test_a_chunk_of_many_steps_is_kept_as_far_as_it_fits(
    tmp_path: Path,
    suffix: str,
    save: Save,
    limit: int,
    held: int | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fhash_formats.readers.common.file_series.SLAB_BYTES", limit)
    values = np.random.default_rng(0).normal(size=(4, 3, 5, 6)).astype(np.float32)
    save(tmp_path / f"a{suffix}", values, (3, 3, 5, 6))
    with open_series(tmp_path / f"a{suffix}") as series:
        assert isinstance(series, FileSeries)
        for step in (1, 0, 3, 2):
            np.testing.assert_array_equal(series.read(step), values[step])
            assert (series._slab is None) == (held is None)
        series.read(1)
        assert series._slab is None or series._slab[1].shape[0] == held


def test_a_chunk_of_many_steps_is_decompressed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=VALUES, chunks=(3, 3, 5, 6), compression="gzip")
    asked = []
    original = h5py.Dataset.__getitem__
    monkeypatch.setattr(
        h5py.Dataset, "__getitem__", lambda self, args: asked.append(args) or original(self, args)
    )
    with open_series(tmp_path / "a.h5") as series:
        asked.clear()
        frames = list(series.frames())
    assert [ranges[0] for ranges in asked] == [slice(0, 3), slice(3, 4)]
    np.testing.assert_array_equal(np.stack(frames), VALUES)


def test_time_as_the_fastest_axis_reads_many_steps_at_once(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ascontiguousarray(VALUES.transpose(1, 2, 3, 0)))
    with open_series(tmp_path / "a.npy", axes="z,y,x,t") as series:
        np.testing.assert_array_equal(series.read(2), VALUES[2])
        assert series._slab is not None
        assert series._slab[1].shape == VALUES.shape


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"shape": {"x": 1, "y": 2}}, "name three or four of t, z, y, x"),
        ({"shape": {"x": 1, "y": 2, "w": 3}}, "names x, y, w"),
        ({"shape": {}}, "names no axis"),
        ({"shape": {"x": 1, "y": 2, "z": 0}}, "z=0; a length is at least 1"),
        ({"dtype": "c8"}, "'c8' is not a number type"),
        ({"endian": "middle"}, "byte order 'middle'; allowed: little, big"),
    ],
)
def test_impossible_layouts_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        RawLayout(**values)


def test_parse_shape() -> None:
    assert parse_shape("x=64,y=64, z=32,t=10") == {"x": 64, "y": 64, "z": 32, "t": 10}
    assert list(parse_shape("t=1,x=2,y=3")) == ["t", "x", "y"]


@pytest.mark.parametrize(
    "text", ["", "64,64,32", "x=64,x=3", "w=1", "x=-1", "x=1.5", "x=\u00b2", "x", "x=1,,y=2"]
)
def test_parse_shape_refuses(text: str) -> None:
    with pytest.raises(InputError, match=r"write each axis once, such as x=64,y=64,z=32,t=10"):
        parse_shape(text)


@pytest.mark.parametrize("axes", ["", "t,z,y,w", "t,z,y,y", "tzyx", "time,z,y,x"])
def test_axes_that_mean_nothing(axes: str) -> None:
    with pytest.raises(InputError, match="name the file's dimensions in their order"):
        parse_axes(axes)


def test_axes_in_any_case() -> None:
    assert parse_axes("T,Z,y, X") == ("t", "z", "y", "x")


@pytest.mark.parametrize(("name", "short"), DTYPES.items())
def test_a_number_type_has_a_long_and_a_short_name(name: str, short: str) -> None:
    assert parse_dtype(name) == parse_dtype(short.upper()) == np.dtype(short)
    assert parse_dtype(name).name == name


def test_a_variable_is_refused_where_there_is_none() -> None:
    Request().refuse_var("a.npy")
    with pytest.raises(InputError, match="--var v cannot be used"):
        Request(var="v").refuse_var("a.npy")
