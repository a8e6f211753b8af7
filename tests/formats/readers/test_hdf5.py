"""HDF5: the dataset, its axes and attributes; frames equal the stored array; every refusal."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from stored_series import (
    VALUES,
    assert_frames,
    write_hdf5,
)

from fhash_formats import open_series
from fhash_formats.errors import InputError


@pytest.mark.parametrize("dtype", ["f4", ">f4", "f8", ">f8", "f2", "u1", ">u2", "i4", ">i8", "u8"])
@pytest.mark.parametrize("chunks", [None, (1, 3, 5, 6), (2, 2, 3, 4), (4, 3, 5, 6)])
def test_every_frame_of_every_type_and_chunking(
    tmp_path: Path, dtype: str, chunks: tuple[int, ...] | None
) -> None:
    values = (VALUES * 50 + 100).astype(dtype)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset(
            "v",
            data=values,
            chunks=chunks,
            compression="gzip" if chunks else None,
            shuffle=bool(chunks),
        )
    assert_frames(tmp_path / "a.h5", values)


@pytest.mark.parametrize("order", list(itertools.permutations("tzyx"))[::3])
@pytest.mark.parametrize("chunked", [False, True])
def test_any_order_of_axes(tmp_path: Path, order: tuple[str, ...], chunked: bool) -> None:
    stored = VALUES.transpose(["tzyx".index(axis) for axis in order])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=stored, chunks=(2, 2, 2, 2) if chunked else None)
    assert_frames(tmp_path / "a.h5", VALUES, axes=",".join(order))


@pytest.mark.parametrize(
    ("axes", "shape"),
    [
        ("t,y,x", (4, 1, 5, 6)),
        ("x,y,t", (6, 1, 5, 4)),
        ("z,y,x", (1, 4, 5, 6)),
        ("t,z,x", (4, 5, 1, 6)),
    ],
)
def test_axes_left_out_have_length_1(tmp_path: Path, axes: str, shape: tuple[int, ...]) -> None:
    path = write_hdf5(tmp_path / "a.h5", v=VALUES[:, 0])
    with open_series(path, axes=axes) as series:
        assert series.shape == shape
        letters = [axis for axis in "tzyx" if axis in axes]
        expected = (
            VALUES[:, 0].transpose([axes.split(",").index(axis) for axis in letters]).reshape(shape)
        )
        np.testing.assert_array_equal(np.stack(list(series.frames())), expected)


def test_3_dimensions_are_one_step(tmp_path: Path) -> None:
    with open_series(write_hdf5(tmp_path / "a.h5", v=VALUES[0])) as series:
        assert series.shape == (1, 3, 5, 6)
        np.testing.assert_array_equal(series.read(0), VALUES[0])


def test_attributes_and_units(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("group/sub/speed", data=VALUES)
        dataset.attrs["units"] = np.bytes_(b"m/s")
        dataset.attrs["level"] = np.float32(0.5)
        dataset.attrs["odd"] = np.nan
        dataset.attrs["sizes"] = np.arange(3)
        dataset.attrs["note"] = "caf\u00e9"
        dataset.attrs["link"] = dataset.ref
        dataset.attrs["pair"] = np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f4")])
        dataset.attrs["none"] = h5py.Empty("f4")
    with open_series(tmp_path / "a.h5") as series:
        assert (series.name, series.units) == ("speed", "m/s")
        assert series.attributes == {
            "units": "m/s",
            "level": 0.5,
            "odd": "NaN",
            "sizes": [0, 1, 2],
            "note": "caf\u00e9",
        }


def test_coordinates_from_dimension_scales(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("v", data=VALUES.transpose(3, 2, 1, 0))
        for place, (name, length) in enumerate((("lon", 6), ("lat", 5), ("lev", 3), ("when", 4))):
            file[name] = np.arange(length) * 0.5 + place
            file[name].make_scale(name)
            dataset.dims[place].attach_scale(file[name])
        file["when"].attrs["units"] = "days since 2000-01-01"
    with open_series(tmp_path / "a.h5") as series:
        assert series.shape == VALUES.shape
        assert [series.coords[axis].name for axis in "tzyx"] == ["when", "lev", "lat", "lon"]
        np.testing.assert_array_equal(series.coords["t"].values, np.arange(4) * 0.5 + 3)
        assert series.coords["t"].attributes == {"units": "days since 2000-01-01"}
        np.testing.assert_array_equal(series.read(2), VALUES[2])


def test_fill_values_and_packing_mean_nothing_in_plain_hdf5(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = VALUES
        file["v"].attrs["_FillValue"] = VALUES[0, 0, 0, 0]
        file["v"].attrs["scale_factor"] = 2.0
    with pytest.warns(
        UserWarning,
        match="v has the attributes scale_factor, _FillValue; its values are read as they stand",
    ):
        assert_frames(tmp_path / "a.h5", VALUES)


def test_a_user_block_before_the_signature(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.dat", "w", userblock_size=1024) as file:
        file["v"] = VALUES
    assert_frames(tmp_path / "a.dat", VALUES)


@pytest.mark.parametrize("keep", [20, 600, 1500])
def test_a_truncated_file_is_one_line(tmp_path: Path, keep: int) -> None:
    path = write_hdf5(tmp_path / "a.h5", v=VALUES)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match="cannot be read as HDF5") as caught:
        open_series(path)
    assert "\n" not in str(caught.value)


def test_a_damaged_chunk_names_the_step(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("v", data=VALUES, chunks=(1, 3, 5, 6), compression="gzip")
        place = dataset.id.get_chunk_info_by_coord((2, 0, 0, 0))
    damaged = bytearray(path.read_bytes())
    damaged[place.byte_offset + 4 : place.byte_offset + 40] = bytes(36)
    path.write_bytes(damaged)
    with open_series(path) as series:
        np.testing.assert_array_equal(series.read(1), VALUES[1])
        with pytest.raises(InputError, match="step 2 of v cannot be read") as caught:
            series.read(2)
        assert "\n" not in str(caught.value)


def test_a_file_that_changes_is_refused(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "a.h5", v=VALUES)
    with open_series(path) as series:
        series.read(0)
        os.utime(path, ns=(1, 1))
        with pytest.raises(InputError, match="changed while it was being read"):
            series.read(1)
    with open_series(path) as series:
        os.truncate(path, path.stat().st_size - 10)
        with pytest.raises(InputError, match=r"changed while it was being read.*bytes before"):
            series.read(0)


def test_a_closed_series_is_refused(tmp_path: Path) -> None:
    series = open_series(write_hdf5(tmp_path / "a.h5", v=VALUES))
    series.close()
    with pytest.raises(InputError, match="step 0 of v cannot be read"):
        series.read(0)


def test_packing_in_plain_hdf5_is_warned_of(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = np.arange(24, dtype="i2").reshape(2, 3, 4)
        file["v"].attrs.update(
            {"scale_factor": 0.5, "missing_value": np.int16(3), "add_offset": 0.0}
        )
    with pytest.warns(
        UserWarning,
        match=r"^v has the attributes scale_factor, missing_value; .*"
        r" a file named \.nc is unpacked$",
    ):
        open_series(tmp_path / "a.h5").close()
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["v"].attrs.update(
            {"scale_factor": 1, "missing_value": np.nan, "_FillValue": np.array([np.nan])}
        )
    open_series(tmp_path / "a.h5").close()
