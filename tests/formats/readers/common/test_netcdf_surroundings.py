"""All that belongs to a variable of a NetCDF file is read as stored, also from outer groups."""

from __future__ import annotations

from pathlib import Path

import h5netcdf
import numpy as np
import pytest

from fhash_formats import open_series


@pytest.fixture
def grouped(tmp_path: Path) -> Path:
    """A packed variable in a group, whose dimensions and coordinates are at the top."""
    path = tmp_path / "grouped.nc"
    with h5netcdf.File(path, "w") as root:
        root.attrs["title"] = "top"
        root.dimensions = {"time": 3, "lat": 4, "lon": 5, "bnds": 2}
        time = root.create_variable("time", ("time",), "i4", data=np.array([0, 6, 18], "i4"))
        time.attrs["units"] = "hours since 2000-01-01"
        time.attrs["bounds"] = "time_bnds"
        bounds = np.arange(6.0).reshape(3, 2)
        root.create_variable("time_bnds", ("time", "bnds"), "f8", data=bounds)
        lat = np.array([10, 20, 30, 40], "i2")
        packed = root.create_variable("lat", ("lat",), "i2", data=lat)
        packed.attrs["scale_factor"] = 0.5
        group = root.create_group("inner")
        group.attrs["title"] = "inner"
        values = np.arange(60, dtype="i2").reshape(3, 4, 5)
        density = group.create_variable("rho", ("time", "lat", "lon"), "i2", data=values)
        density.attrs["scale_factor"] = np.float32(0.5)
        density.attrs["units"] = "kg"
    return path


def test_a_variable_of_a_group_finds_what_is_around_it(grouped: Path) -> None:
    with open_series(grouped) as series:
        metadata = series.metadata
        assert series.coords["y"].values.tolist() == [5, 10, 15, 20]
    assert metadata.dimensions == {"time": "t", "lat": "y", "lon": "x"}
    assert [each.name for each in metadata.variables] == ["time", "lat", "time_bnds"]
    assert metadata.named("lat").values.tolist() == [10, 20, 30, 40]
    assert metadata.named("lat").values.dtype == np.int16
    assert metadata.named("time").attributes["bounds"] == "time_bnds"
    assert metadata.attributes == {"title": "inner"}
    assert metadata.variable_attributes == {"scale_factor": np.float32(0.5), "units": "kg"}
    assert (metadata.stored, metadata.file) == ("int16", "grouped.nc")


def test_steps_are_cut(grouped: Path) -> None:
    with open_series(grouped, steps=slice(2, None, -2)) as series:
        assert series.metadata.named("time").values.tolist() == [18, 0]
        assert series.metadata.named("time_bnds").values.tolist() == [[4, 5], [0, 1]]


def test_numbers_as_stored_have_no_packing(grouped: Path) -> None:
    with open_series(grouped, raw_values=True) as series:
        assert series.metadata.variable_attributes == {}
        assert series.metadata.stored is None
