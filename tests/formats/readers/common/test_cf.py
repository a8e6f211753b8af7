"""CF conventions: packed values, axes by attributes and names, and the coordinate of time."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr
from stored_series import VALUES, create_zarr, frames, save_netcdf, write_hdf5

from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf import Column, counts_steps, join_times, packing, real_time
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
    create_zarr(tmp_path / "b.zarr", VALUES, attributes={"_FillValue": "?"})
    with pytest.raises(InputError, match=r"fill value '\?' is not a number"):
        open_series(tmp_path / "b.zarr")


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
