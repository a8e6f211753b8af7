"""Many files give what they have in common, and what they have along time one after the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fhash_formats import open_series
from fhash_formats.errors import FhashWarning


def part(number: int, *, units: str = "days since 2000-01-01", **more: object) -> xr.Dataset:
    days = np.array([2 * number, 2 * number + 1], dtype="i4")
    return xr.Dataset(
        {
            "u": (("time", "lat", "lon"), np.full((2, 3, 4), float(number))),
            "time_bnds": (("time", "bnds"), np.stack([days, days + 1], axis=1)),
        },
        {
            "time": ("time", days, {"units": units, "bounds": "time_bnds"}),
            "month": ("time", np.array(["a", f"b{number}"], dtype=object)),
            "lat": ("lat", np.arange(3, dtype="f4")),
            "height": ((), 2.0),
            "run": ((), number),
        },
        {"title": "parts", "tracking_id": f"id {number}", "history": f"made {number}", **more},
    )


def written(folder: Path, *parts: xr.Dataset) -> str:
    for number, dataset in enumerate(parts):
        dataset.to_netcdf(folder / f"part_{number}.nc", engine="h5netcdf")
    return str(folder / "part_*.nc")


def test_parts_are_joined_along_time(tmp_path: Path) -> None:
    pattern = written(tmp_path, part(0), part(1), part(2))
    with open_series(pattern, var="u") as series:
        with pytest.warns(FhashWarning, match=r":tracking_id .*run .*$"):
            metadata = series.metadata
        assert series.read(5)[0, 0, 0] == 2
    assert metadata.dimensions == {"time": "t", "lat": "y", "lon": "x"}
    found = {each.name: each for each in metadata.variables}
    assert set(found) == {"time", "time_bnds", "month", "lat", "height"}
    assert found["time"].values.tolist() == [0, 1, 2, 3, 4, 5]
    assert found["time"].values.dtype == np.int32
    assert found["time_bnds"].values[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert found["month"].values.tolist() == ["a", "b0", "a", "b1", "a", "b2"]
    assert metadata.attributes == {"title": "parts", "history": "made 0"}
    assert (metadata.file, metadata.digest) == ("part_*.nc", None)


def test_bounds_of_other_units_are_left_out(tmp_path: Path) -> None:
    pattern = written(tmp_path, part(0), part(0, units="days since 2000-01-03"))
    with open_series(pattern, var="u") as series, pytest.warns(FhashWarning, match="time_bnds"):
        metadata = series.metadata
    assert metadata.named("time_bnds") is None
    assert metadata.named("time").values.tolist() == [0, 1, 2, 3]


def test_files_without_a_time_get_one(tmp_path: Path) -> None:
    parts = [part(0).isel(time=0, drop=True).drop_vars("time_bnds").expand_dims(lev=2)] * 3
    with open_series(written(tmp_path, *parts), var="u") as series:
        metadata = series.metadata
    assert metadata.dimensions == {"time": "t", "lev": "z", "lat": "y", "lon": "x"}
    assert metadata.named("time").values.tolist() == [0, 1, 2]
    assert metadata.named("run").values == 0
