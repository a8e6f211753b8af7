"""Coordinates beside an array: found by name, kept without loss."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from stored_series import (
    VALUES,
    create_zarr,
    write_hdf5,
)

from fhash_formats import open_series
from fhash_formats.errors import InputError

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
