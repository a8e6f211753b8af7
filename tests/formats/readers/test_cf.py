"""CF conventions: packed values, axes by attributes and names, and the coordinate of time."""

from __future__ import annotations

import os
import tracemalloc
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr
from stored_series import VALUES, create_zarr, frames, save_netcdf, write_hdf5

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.readers.belonging import join_times
from fhash_formats.readers.cf import Column, counts_steps, packing, real_time
from fhash_formats.readers.file_series import (
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
from fhash_formats.readers.layout import Dimension, arrange, shared_roles
from fhash_formats.readers.registry import open_series
from fhash_formats.series import Coordinate


def test_unsigned_values_stored_as_signed(tmp_path: Path) -> None:
    values = np.array([0, 1, 127, 128, 254, 255], np.uint8).reshape(1, 2, 3)
    attributes = {"_Unsigned": "true", "_FillValue": -1, "missing_value": 300}
    create_zarr(tmp_path / "a.zarr", values.view(np.int8), attributes=attributes)
    np.testing.assert_array_equal(
        frames(tmp_path / "a.zarr")[0], np.where(values == 255, np.nan, values.astype("f4"))
    )


def test_bad_packing_attributes_are_refused(tmp_path: Path) -> None:
    create_zarr(tmp_path / "a.zarr", VALUES, attributes={"scale_factor": "two"})
    with pytest.raises(InputError, match="scale_factor is 'two', not a number"):
        open_series(tmp_path / "a.zarr")
    for text in ("?", "\u00e9"):
        create_zarr(tmp_path / f"{text}.zarr", VALUES, name="v", attributes={"_FillValue": text})
        with pytest.raises(InputError, match=r"fill value '.' is not a number"):
            open_series(tmp_path / f"{text}.zarr")


@pytest.mark.parametrize(
    ("stored", "attributes", "expected"),
    [
        ("i2", {}, "i2"),
        (">i2", {}, "i2"),
        ("i2", {"_FillValue": -9}, "f4"),
        ("i4", {"_FillValue": -9}, "f8"),
        ("f4", {"_FillValue": -9}, "f4"),
        ("f4", {"scale_factor": 2}, "f8"),
        ("u1", {"add_offset": 0.5}, "f8"),
        ("i1", {"_Unsigned": "true"}, "u1"),
    ],
)
def test_the_type_of_the_values_holds_every_stored_number(
    stored: str, attributes: dict[str, Any], expected: str
) -> None:
    made = packing("a", np.dtype(stored), attributes)
    values = made.unpack(np.array([1, 2], stored))
    assert made.dtype == values.dtype == np.dtype(expected)


def test_scale_offset_and_every_fill_value_are_used() -> None:
    attributes = {"_FillValue": 1, "missing_value": [2, 300], "scale_factor": 0.5, "add_offset": 7}
    made = packing("a", np.dtype("u1"), attributes, fill_value=3)
    np.testing.assert_array_equal(
        made.unpack(np.array([0, 1, 2, 3, 4], "u1")), [7, np.nan, np.nan, np.nan, 9]
    )


@pytest.mark.parametrize("stored", ["f4", ">f4"])
def test_floats_are_scaled_too_where_the_scale_is_of_their_type(stored: str) -> None:
    attributes = {"_FillValue": np.float32(9), "scale_factor": np.float32(3)}
    made = packing("a", np.dtype(stored), attributes)
    values = made.unpack(np.array([1, 9, 3], stored))
    np.testing.assert_array_equal(values, np.array([3, np.nan, 9], "f4"), strict=True)


@pytest.mark.parametrize("written", ["NaN", "AAAAAAAA+H8=", float("nan")])
def test_a_fill_value_of_nan_marks_itself(written: object) -> None:
    assert packing("a", np.dtype("f4"), {"_FillValue": written}).fills == ()


DIMS = ["time", "z", "y", "x"]


def test_coordinates_beside_the_dataset_then_in_the_root(tmp_path: Path) -> None:
    times = np.array([347921.1, 347921.2, 347921.3, 347999.0])
    path = write_hdf5(
        tmp_path / "a.h5",
        run__v=VALUES,
        time=times,
        run__x1v=np.arange(6.0) * 2,
        x2v=np.zeros(9),
        lev=np.arange(3),
        x=np.arange(5),
    )
    with open_series(path) as series:
        np.testing.assert_array_equal(series.coords["t"].values, times)
        assert series.coords["x"].name == "x1v"
        np.testing.assert_array_equal(series.coords["z"].values, [0, 1, 2])
        np.testing.assert_array_equal(
            series.coords["y"].values, np.arange(5)
        )  # x2v has another length
        assert series.coords["y"].name == "y"
        assert all(series.coords[axis].values.dtype == np.float64 for axis in "tzyx")


def test_a_length_alone_is_no_meaning(tmp_path: Path) -> None:
    with open_series(
        write_hdf5(tmp_path / "a.h5", v=VALUES, weights=np.arange(4) + 10.0)
    ) as series:
        np.testing.assert_array_equal(series.coords["t"].values, np.arange(4))


def test_a_coordinate_that_contradicts_the_assumed_order_is_refused(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "a.h5", v=VALUES.transpose(3, 2, 1, 0), time=np.arange(4.0))
    with pytest.raises(InputError, match=r"time has 4 values.*--axes"):
        open_series(path)
    with open_series(path, axes="x,y,z,t") as series:
        np.testing.assert_array_equal(series.read(3), VALUES[3])


def test_integers_that_floats_cannot_tell_apart_are_refused_as_coordinates(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "a.h5", v=VALUES, time=2**60 + np.arange(4))
    with pytest.raises(InputError, match="time has values that 64-bit floats cannot tell apart"):
        open_series(path)


def test_conventional_coordinates_where_dimensions_have_no_names(tmp_path: Path) -> None:
    create_zarr(tmp_path / "a.zarr", VALUES, name="v")
    create_zarr(tmp_path / "a.zarr", np.arange(4.0) * 5, name="time")
    with open_series(tmp_path / "a.zarr") as series:
        np.testing.assert_array_equal(series.coords["t"].values, [0, 5, 10, 15])
    create_zarr(tmp_path / "b.zarr", VALUES.T, name="v")
    create_zarr(tmp_path / "b.zarr", np.arange(4.0) * 5, name="time")
    with pytest.raises(InputError, match=r"time has 4 values.*--axes"):
        open_series(tmp_path / "b.zarr")


@pytest.mark.parametrize("unit", ["s", "ns"])
def test_dates_are_counted_from_the_first(tmp_path: Path, unit: str) -> None:
    dates = np.array(
        [
            "2020-01-01T00:00:00",
            "2020-01-01T06:00:00",
            "2020-01-02T00:00:00",
            "2020-01-03T00:00:00",
        ],
        f"M8[{unit}]",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the type has no specification yet
        create_zarr(tmp_path / "a.zarr", VALUES, name="v", dimension_names=DIMS)
        create_zarr(tmp_path / "a.zarr", dates, name="time", dimension_names=["time"])
    with open_series(tmp_path / "a.zarr") as series:
        ticks = 1 if unit == "s" else 10**9
        np.testing.assert_array_equal(
            series.coords["t"].values, np.array([0, 6, 24, 48]) * 3600.0 * ticks
        )
        assert (
            series.coords["t"]
            .attributes["units"]
            .startswith("seconds since 2020" if unit == "s" else "nanoseconds since 2020")
        )


def roles(path: Path, sizes: str, **coords: Any) -> str:
    """Axes of a variable's dimensions a, b, c, d, as letters in file order.

    The dimensions have different lengths, which tell them apart.
    """
    values = VALUES[tuple(slice(None) if at < len(sizes) else 0 for at in range(4))]
    save_netcdf(
        path,
        xr.Dataset(
            {"v": (tuple(sizes), values)}, coords={name: coord for name, coord in coords.items()}
        ),
    )
    with open_series(path) as series:
        return "".join("tzyx"[series.shape.index(length)] for length in values.shape)


def along(dimension: str, **attributes: str) -> tuple[str, np.ndarray, dict[str, str]]:
    return dimension, np.arange(float(VALUES.shape["abcd".index(dimension)])), attributes


@pytest.mark.parametrize(
    ("coords", "expected"),
    [
        ({}, "tzyx"),
        (
            {
                "a": along("a", axis="X"),
                "b": along("b", axis="Y"),
                "c": along("c", axis="Z"),
                "d": along("d", axis="T"),
            },
            "xyzt",
        ),
        (
            {
                "a": along("a", standard_name="projection_x_coordinate"),
                "b": along("b", standard_name="latitude"),
                "c": along("c", standard_name="atmosphere_hybrid_height_coordinate"),
                "d": along("d", standard_name="time"),
            },
            "xyzt",
        ),
        (
            {
                "a": along("a", units="degrees_east"),
                "b": along("b", units="hours since 2000-01-01"),
                "c": along("c", units="hPa"),
            },
            "xtzy",
        ),
        ({"a": along("a", positive="down"), "b": along("b", axis="T")}, None),
        (
            {
                "a": along("a", positive="down"),
                "b": along("b", axis="T"),
                "c": along("c", axis="Y"),
            },
            "ztyx",
        ),
        (
            {"when": along("d", axis="T"), "c": along("c", axis="Z"), "b": along("b", axis="Y")},
            "xyzt",
        ),
    ],
)
def test_axes_by_cf_attributes(
    tmp_path: Path, coords: dict[str, Any], expected: str | None
) -> None:
    if expected is None:
        with pytest.raises(InputError, match=r"not clear.*--axes"):
            roles(tmp_path / "a.nc", "abcd", **coords)
    else:
        assert roles(tmp_path / "a.nc", "abcd", **coords) == expected


@pytest.mark.parametrize(
    ("dims", "shape"),
    [
        (("time", "lat", "lon"), (4, 1, 3, 5)),
        (("lev", "lat", "lon"), (1, 4, 3, 5)),
        (("lon", "lat", "time_0"), (5, 1, 3, 4)),
        (("time", "z", "x"), (4, 3, 1, 5)),
        (("sheet", "south_north", "west_east"), (1, 4, 3, 5)),
    ],
)
def test_three_dimensions_by_name(
    tmp_path: Path, dims: tuple[str, ...], shape: tuple[int, ...]
) -> None:
    path = save_netcdf(tmp_path / "a.nc", xr.Dataset({"v": (dims, VALUES[:, :, :, 0])}))
    with open_series(path) as series:
        assert series.shape == shape


def test_two_dimensions_of_one_meaning_are_refused(tmp_path: Path) -> None:
    path = save_netcdf(
        tmp_path / "a.nc", xr.Dataset({"v": (("time", "lev", "height", "lon"), VALUES)})
    )
    with pytest.raises(
        InputError,
        match=r"two dimensions of \(time=4, lev=3, height=5, lon=6\) mean the same axis.*--axes",
    ):
        open_series(path)
    np.testing.assert_array_equal(frames(path, axes="t,z,y,x"), VALUES)


def part(name: str, values: list[float], units: str, **more: str) -> tuple[Path, Coordinate]:
    attributes = {"units": units, **more}
    return Path(name), Coordinate(name="time", values=np.array(values), attributes=attributes)


def test_other_attributes_do_not_matter() -> None:
    parts = [part("a", [0, 1], "s", history="one"), part("b", [2, 3], "s", history="two")]
    joined = join_times("*", parts)
    assert joined.values.tolist() == [0, 1, 2, 3]
    assert joined.attributes == {"units": "s", "history": "one"}


def test_each_time_is_rounded_once() -> None:
    parts = [
        part("a", [0.5], "hours since 1850-01-01"),
        part("b", [1 / 3], "days since 2001-02-10", calendar="standard"),
    ]
    days = 55192  # from 1850-01-01 to 2001-02-10
    assert join_times("*", parts).values.tolist() == [0.5, days * 24 + 8]


@pytest.mark.parametrize(("nanoseconds", "kept"), [(10, False), (10**9, True)])
def test_a_loss_is_refused(nanoseconds: int, kept: bool) -> None:
    parts = [
        part("a", [55192.0], "days since 1850-01-01"),
        part("b", [nanoseconds, 2 * nanoseconds], "nanoseconds since 2001-02-10T01:00"),
    ]
    if kept:
        assert np.diff(join_times("*", parts).values)[1] == pytest.approx(1 / 86400, rel=1e-6)
        return
    with pytest.raises(InputError, match="too close to be counted in the units of a"):
        join_times("*", parts)


def test_times_that_are_not_finite() -> None:
    good, bad = (part("a", [value], "days since 1850-01-01") for value in (0, np.nan))
    other = part("b", [np.nan], "days since 1851-01-01")
    with pytest.raises(InputError, match="b are not all finite"):
        join_times("*", [good, other])
    with pytest.raises(InputError, match="do not increase"):
        join_times("*", [bad, part("b", [1], "days since 1850-01-01")])


STEPPED = np.random.default_rng(0).normal(size=(4, 2, 3, 5)).astype("f4")
HOURS = [0.0, 3.0, 6.0, 12.0]


def column(name: str, values: list[float], **attributes: Any) -> Column:
    array = np.array(values)
    return Column(name=name, length=array.size, read=lambda: array, attributes=attributes)


STEPS = column("step", [0, 1, 2, 3])
LEAD = column("leadtime", HOURS, units="hours")
PERIOD = column("fp", HOURS, standard_name="forecast_period", units="h")
DATES = column("when", HOURS, units="hours since 2001-01-01")
START = column(
    "init", [0, 0, 0, 0], units="h since 2001-01-01", standard_name="forecast_reference_time"
)
DELTA = column("dt", [3.0, 3.0, 6.0, 6.0], units="hours")
PLAIN = column("time", [0.0, 0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("named", "others", "found"),
    [
        (STEPS, [LEAD], LEAD),
        (STEPS, [PERIOD], PERIOD),
        (STEPS, [DELTA], STEPS),
        (STEPS, [START, LEAD, DATES], DATES),
        (STEPS, [START, LEAD], LEAD),
        (STEPS, [], STEPS),
        (None, [PLAIN], PLAIN),
        (None, [STEPS], None),
        (LEAD, [DATES], LEAD),
        (PLAIN, [DATES], PLAIN),
        (column("step", [0, 1, 2, 3], units="hours"), [DATES], "named"),
    ],
)
def test_time_comes_before_numbers_of_steps(
    named: Column | None, others: list[Column], found: Any
) -> None:
    assert real_time(named, others) is (named if found == "named" else found)


@pytest.mark.parametrize(
    ("values", "steps"),
    [([0, 1, 2], True), ([1, 2, 3], True), ([2, 3, 4], False), ([0, 2, 4], False), ([0.0], True)],
)
def test_numbers_of_steps(values: list[float], steps: bool) -> None:
    assert counts_steps(np.array(values)) is steps


@pytest.mark.parametrize("name", ["leadtime", "forecast_period", "valid_time"])
@pytest.mark.parametrize("suffix", [".nc", ".zarr", ".h5"])
def test_files_with_numbers_of_steps_and_a_time(tmp_path: Path, suffix: str, name: str) -> None:
    path = tmp_path / f"a{suffix}"
    if suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["u"], file["step"], file[name] = STEPPED, np.arange(4), HOURS
            file[name].attrs["units"] = "hours"
            file["step"].make_scale("step")
            file["u"].dims[0].attach_scale(file["step"])
    else:
        coords = {"step": np.arange(4), name: ("step", HOURS, {"units": "hours"})}
        data = xr.Dataset({"u": (("step", "z", "y", "x"), STEPPED)}, coords=coords)
        if suffix == ".nc":
            data.to_netcdf(path, engine="h5netcdf")
        else:
            data.to_zarr(path, zarr_format=2, consolidated=False)
            assert zarr.open_group(path)
    with open_series(path) as series:
        assert (series.coords["t"].name, series.coords["t"].values.tolist()) == (name, HOURS)
        assert series.coords["t"].attributes["units"] == "hours"


def test_time_on_a_dimension_of_another_name(tmp_path: Path) -> None:
    coords = {"time": ("record", HOURS, {"units": "hours since 2001-01-01"})}
    data = xr.Dataset({"u": (("record", "z", "y", "x"), STEPPED)}, coords=coords)
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with open_series(tmp_path / "a.nc") as series:
        assert series.shape == STEPPED.shape
        assert series.coords["t"].values.tolist() == HOURS


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
    with pytest.raises(InputError, match="was removed while it was being read"):
        stamp.check()


def test_a_stamp_of_a_folder_tells_any_change_below_it(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    file = tmp_path / "inner" / "a"
    file.write_bytes(b"12345")
    stamp = FolderStamp.of(tmp_path)
    assert (stamp.files, stamp.size) == (1, 5)
    stamp.check()
    os.utime(file, ns=(1, 1))
    with pytest.raises(InputError, match="same size, written again"):
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
    monkeypatch.setattr("fhash_formats.readers.file_series.SLAB_BYTES", limit)
    values = np.random.default_rng(0).normal(size=(4, 3, 5, 6)).astype(np.float32)
    save(tmp_path / f"a{suffix}", values, (3, 3, 5, 6))
    with open_series(tmp_path / f"a{suffix}") as series:
        assert isinstance(series, FileSeries)
        for step in (1, 0, 3, 2):
            np.testing.assert_array_equal(series.read(step), values[step])
            assert (series._held_slab is None) == (held is None)
        series.read(1)
        assert series._held_slab is None or series._held_slab[1].shape[0] == held


def test_time_as_the_fastest_axis_reads_many_steps_at_once(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ascontiguousarray(VALUES.transpose(1, 2, 3, 0)))
    with open_series(tmp_path / "a.npy", axes="z,y,x,t") as series:
        np.testing.assert_array_equal(series.read(2), VALUES[2])
        assert series._held_slab is not None
        assert series._held_slab[1].shape == VALUES.shape


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


@pytest.mark.parametrize(("name", "short"), DTYPES.items())
def test_a_number_type_has_a_long_and_a_short_name(name: str, short: str) -> None:
    assert parse_dtype(name) == parse_dtype(short.upper()) == np.dtype(short)
    assert parse_dtype(name).name == name


def test_a_variable_is_refused_where_there_is_none() -> None:
    Request().refuse_var("a.npy")
    with pytest.raises(InputError, match="--var v cannot be used"):
        Request(var="v").refuse_var("a.npy")


def dims(text: str) -> list[Dimension]:
    """Dimensions such as "member=5 time=4:t 8"; a letter after a colon is what the file says."""
    found = []
    for word in text.split():
        rest, _, role = word.partition(":")
        name, _, length = rest.rpartition("=")
        found.append(Dimension(name=name or None, length=int(length), role=role or None))
    return found


def axes(text: str, *select: tuple[str, str], given: str | None = None) -> str:
    """Axis of each dimension as a letter, "." for one that is selected."""
    request = Request(select=select, axes=tuple(given) if given is not None else None)
    layout = arrange("a", "v", dims(text), request)
    letters = iter(layout.axes)
    return "".join(
        "." if place in layout.picked else next(letters) for place in range(len(layout.dimensions))
    )


@pytest.mark.parametrize(
    ("text", "select", "expected"),
    [
        ("4 11 12 13", [], "tzyx"),
        ("11 12 13", [], "zyx"),
        ("member=5 time=4:t lev=3:z lat=8:y lon=9:x", [("member", "1")], ".tzyx"),
        ("time=4:t number=5 lat=8:y lon=9:x", [("number", "0")], "t.yx"),
        ("time=4:t foo=5 lat=8:y lon=9:x", [], "tzyx"),
        ("member=1 time=4:t lat=8:y lon=9:x", [], ".tyx"),
        ("run=1 time=4:t lev=3:z lat=8:y lon=9:x", [], ".tzyx"),
        ("4 11 12 13 3", [("4", "2")], "tzyx."),
        ("4 11 12 13 3", [("dim0", "-1"), ("dim4", "2")], ".zyx."),
        ("4 11 12", [("dim0", "2")], ".yx"),
        ("time=4:t lev=3:z lat=8:y lon=9:x", [("lev", "0")], "t.yx"),
        ("init=2:t lead=4:t lev=3:z lat=8:y lon=9:x", [("init", "0")], ".tzyx"),
        ("x=9:x y=9:y z=9:z time=20", [], "xyzt"),
    ],
)
def test_axes_and_selections(text: str, select: Sequence[tuple[str, str]], expected: str) -> None:
    assert axes(text, *select) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("member=5 time=4:t lev=3:z lat=8:y lon=9:x", "--select member=0 .member has 5"),
        ("time=4:t member=5 lat=8:y lon=9:x", "--select member=0"),
        ("time=4:t lev=3:z lat=8:y lon=9:x foo=2", "--select foo=0"),
        ("init=2:t lead=4:t lev=3:z lat=8:y lon=9:x", "--select init=0"),
        ("5 4 11 12 13", "--select dim0=0"),
        ("4 11 12 13 3", "--select dim4=0"),
        ("2 4 11 12 13 3", "--select dim5=0 --select dim0=0"),
        ("1 4 11 12 13", "--select dim0=0"),
    ],
)
def test_further_dimensions_must_be_selected(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        axes(text)


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("16 24 24 3", ["--axes t,z,y,x", "--select dim3=0"]),
        ("24 24 3", ["--axes z,y,x", "--select dim2=0"]),
        ("z=16:z y=24:y x=24:x c=3", ["--axes z,y,x,t", "--select c=0"]),
        ("time=4:t y=24:y x=24:x c=3", ["--axes t,y,x,z", "--select c=0"]),
    ],
)
def test_both_readings_of_a_short_last_dimension(text: str, options: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        axes(text)
    for option in options:
        assert option in str(caught.value)
        word, _, value = option.partition(" ")
        if word == "--axes":
            assert axes(text, given=value.replace(",", "")) == value.replace(",", "")
        else:
            name, _, index = value.partition("=")
            assert axes(text, (name, index)).endswith(".")


def test_positions_along_the_last_dimension_answer_the_question() -> None:
    *others, last = dims("16 24 24 3")
    column = Column(name="x", length=3, read=lambda: np.arange(3.0), attributes={})
    known = Dimension(name=None, length=last.length, column=column)
    assert arrange("a", "v", [*others, known], Request()).axes == ("t", "z", "y", "x")


def test_who_selects_time_is_still_asked_about_components() -> None:
    with pytest.raises(InputError, match="--select dim4=0"):
        axes("5 16 24 24 3", ("dim0", "1"))
    assert axes("5 16 24 24 3", ("dim0", "1"), ("dim4", "1")) == ".zyx."


@pytest.mark.parametrize(
    ("text", "select", "words"),
    [
        ("4 5 6", [("dim3", "0")], "no dimension 'dim3'; its dimensions are dim0=4"),
        ("4 5 6", [("member", "0")], "no dimension 'member'"),
        ("4 5 6", [("dim0", "4")], r"outside the indices 0\.\.3"),
        ("4 5 6", [("dim0", "-5")], r"outside the indices 0\.\.3"),
        ("4 5 6", [("dim0", "a")], r"no index 0\.\.3"),
        ("4 5 6", [("dim0", "1"), ("-3", "1")], "a second time"),
        ("4 5 6", [("dim0", "1"), ("dim1", "1")], "at least 2 are needed"),
    ],
)
def test_selections_that_do_not_fit(
    text: str, select: Sequence[tuple[str, str]], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        axes(text, *select)


def test_a_selection_fetches_only_what_is_selected() -> None:
    values = np.arange(2 * 3 * 4 * 5 * 6).reshape(2, 3, 4, 5, 6)
    layout = arrange("a", "v", dims("2 3 4 5 6"), Request(select=(("dim1", "1"), ("dim4", "5"))))
    asked = []

    def read(ranges: tuple[slice, ...]) -> np.ndarray:
        asked.append(ranges)
        return values[ranges]

    got = layout.fetch(read)((slice(0, 1), slice(0, 4), slice(0, 5)))
    np.testing.assert_array_equal(got, values[:1, 1, :, :, 5])
    assert asked == [(slice(0, 1), slice(1, 2), slice(0, 4), slice(0, 5), slice(5, 6))]
    assert layout.chunks((1, 2, 3, 4, 5)) == (1, 3, 4)
    assert layout.attributes() == {"selection": "dim1=1, dim4=5"}


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        (["run=7 level=5:z lat=20:y lon=24:x", "run=7 lat=20:y lon=24:x"], {"run": "t"}),
        (["run=7 lat=20:y lon=24:x"], {}),
        (["a=7 b=5 lat=20:y lon=24:x", "b=5 lat=20:y lon=24:x"], {"a": "t", "b": "z"}),
        (["a=7 b=5 c=20 d=24", "b=5 a=7 d=24 c=20"], {"a": "t", "b": "z", "c": "y", "d": "x"}),
        (["member=4 run=7 lat=20:y lon=24:x"], {}),
        (["one=1 run=7 level=5:z lat=20:y lon=24:x"], {"run": "t"}),
        (["run=9 a=20 b=24 c=3"], {}),  # the last may be components
        (["a=9:z run=20:z b=24 c=30"], {}),
    ],
)
def test_a_dimension_has_one_role_in_a_file(arrays: list[str], expected: dict[str, str]) -> None:
    assert shared_roles(map(dims, arrays)) == expected
