"""The real time among the coordinates of a dimension, and in files of every format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr

from fhash_formats.readers import open_series
from fhash_formats.readers.common.cf import Column, counts_steps, real_time

VALUES = np.random.default_rng(0).normal(size=(4, 2, 3, 5)).astype("f4")
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
            file["u"], file["step"], file[name] = VALUES, np.arange(4), HOURS
            file[name].attrs["units"] = "hours"
            file["step"].make_scale("step")
            file["u"].dims[0].attach_scale(file["step"])
    else:
        coords = {"step": np.arange(4), name: ("step", HOURS, {"units": "hours"})}
        data = xr.Dataset({"u": (("step", "z", "y", "x"), VALUES)}, coords=coords)
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
    data = xr.Dataset({"u": (("record", "z", "y", "x"), VALUES)}, coords=coords)
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with open_series(tmp_path / "a.nc") as series:
        assert series.shape == VALUES.shape
        assert series.coords["t"].values.tolist() == HOURS
