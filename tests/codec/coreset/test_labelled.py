"""Labelled arrays keep their labels and all that belongs to them, and are read frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from fhash_codec.coreset.labelled import array_series, labelled_series
from fhash_formats import open_series
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import ArraySeries


def dataset() -> xr.Dataset:
    times = xr.date_range("2001-01-01", periods=3, calendar="360_day", use_cftime=True)
    return xr.Dataset(
        {
            "u": (
                ("lon", "time", "lat"),
                np.arange(60.0).reshape(5, 3, 4),
                {"units": "m s-1", "grid_mapping": "crs"},
            ),
            "crs": ((), 0, {"grid_mapping_name": "latitude_longitude"}),
        },
        {
            "time": ("time", times, {"axis": "T"}),
            "lat": ("lat", np.arange(4, dtype="f4")),
            "lon": ("lon", np.arange(5)),
            "area": (("lat", "lon"), np.ones((4, 5))),
            "when": ((), np.datetime64("2001-02-03")),
        },
        {"title": "a"},
    )


def test_a_dataset_gives_its_variable_with_what_belongs_to_it() -> None:
    source = dataset()
    series = labelled_series(source)
    assert (series.name, series.units, series.shape) == ("u", "m s-1", (3, 1, 4, 5))
    np.testing.assert_array_equal(series.read(1)[0], source["u"].values[:, 1].T)
    metadata = series.metadata
    assert metadata.dimensions == {"lon": "x", "time": "t", "lat": "y"}
    found = {each.name: each for each in metadata.variables}
    assert set(found) == {"lon", "time", "lat", "area", "when", "crs"}
    assert found["time"].attributes["calendar"] == "360_day"
    assert series.coords["t"].values.tolist() == found["time"].values.tolist() == [0, 1, 2]
    assert found["lat"].values.dtype == np.float32
    assert found["area"].is_coordinate
    assert not found["crs"].is_coordinate
    assert metadata.attributes == {"title": "a"}
    assert (metadata.file, metadata.digest) == (None, None)


def test_times_are_counted_as_the_file_counted_them() -> None:
    source = (
        dataset()
        .drop_vars("time")
        .assign_coords(
            time=("time", np.array([0.5, 1.5, 4.0]), {"units": "hours since 1999-12-31"})
        )
    )
    series = labelled_series(xr.decode_cf(source)["u"])
    assert series.coords["t"].values.tolist() == [0.5, 1.5, 4.0]
    assert series.coords["t"].attributes["units"].startswith("hours since 1999-12-31")


def test_frames_of_a_lazy_array_are_computed_one_by_one() -> None:
    source = dataset()[["u"]].chunk({"time": 1})
    computed: list[int] = []

    def note(block: Any, block_info: Any = None) -> Any:
        if block_info:
            computed.append(block_info[0]["chunk-location"][1])
        return block

    lazy = source["u"].copy(data=source["u"].data.map_blocks(note, dtype="f8"))
    series = labelled_series(lazy)
    assert computed == []
    series.read(2)
    assert computed == [2]


def test_packing_is_that_of_the_file(tmp_path: Path) -> None:
    packing = {"u": {"dtype": "int16", "scale_factor": 0.5, "_FillValue": -1}}
    dataset().to_netcdf(tmp_path / "a.nc", engine="h5netcdf", encoding=packing)
    with xr.open_dataset(tmp_path / "a.nc", decode_coords="all") as stored:
        metadata = labelled_series(stored["u"]).metadata
    assert metadata.stored == "int16"
    assert metadata.variable_attributes["scale_factor"] == 0.5
    assert not metadata.named("crs").is_coordinate  # as of the file


def test_indices_of_several_levels_are_named() -> None:
    source = dataset()["u"].stack(both=("lat", "lon")).expand_dims(lev=2).transpose()
    series = labelled_series(source)
    with pytest.warns(FhashWarning, match="both"):
        assert series.metadata.named("both") is None


def test_the_variable_must_be_clear() -> None:
    source = dataset()
    two = source.assign(v=source["u"])
    with pytest.raises(InputError, match=r"2 variables .*: u, v; .*dataset\['u'\]"):
        array_series(two)
    assert labelled_series(two, "v").name == "v"
    with pytest.raises(InputError, match="no variable 'w'; it has u, crs, v"):
        labelled_series(two, "w")
    with pytest.raises(InputError, match="no variable of 3"):
        labelled_series(source[["crs"]])


def test_arrays_without_labels_are_arrays() -> None:
    assert isinstance(array_series(np.zeros((2, 3, 4))), ArraySeries)
    assert array_series(dataset()["u"]).name == "u"


def forecast() -> xr.Dataset:
    """A dimension that no attribute explains: time in four dimensions, the slowest of three."""
    return xr.Dataset(
        {
            "T": (("frtime", "level", "lat", "lon"), np.zeros((7, 5, 4, 6), "f4")),
            "Psl": (("frtime", "lat", "lon"), np.zeros((7, 4, 6), "f4")),
        },
        {
            "frtime": ("frtime", np.arange(7.0) * 8, {"units": "hours"}),
            "level": ("level", [1000.0, 850, 500, 300, 200], {"units": "hPa"}),
            "lat": ("lat", np.linspace(20, 60, 4)),
            "lon": ("lon", np.linspace(-140, -52, 6)),
        },
    )


@pytest.mark.parametrize("kind", ["nc", "h5", "zarr", "labelled"])
def test_a_dimension_has_one_role_in_all_variables(tmp_path: Path, kind: str) -> None:
    data, path = forecast(), tmp_path / f"run.{kind}"
    if kind == "zarr":
        data.to_zarr(path, consolidated=False)
    elif kind != "labelled":
        data.to_netcdf(path, engine="h5netcdf")
    for name, shape in (("T", (7, 5, 4, 6)), ("Psl", (7, 1, 4, 6))):
        with (
            labelled_series(data, name)
            if kind == "labelled"
            else open_series(path, var=name) as series
        ):
            assert series.shape == shape
            assert series.coords["t"].values.tolist() == data["frtime"].values.tolist()
