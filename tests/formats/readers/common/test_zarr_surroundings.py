"""All that belongs to an array of a zarr store is what belonged to it in the dataset."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr

from fhash_formats import open_series


def dataset() -> xr.Dataset:
    values = np.linspace(0, 9, 60).reshape(3, 4, 5)
    values[0, 1, 2] = np.nan
    return xr.Dataset(
        {
            "u": (("time", "lat", "lon"), values, {"units": "K", "grid_mapping": "crs"}),
            "crs": ((), np.int32(0), {"grid_mapping_name": "latitude_longitude"}),
            "lat_bnds": (("lat", "bnds"), np.arange(8, dtype="f4").reshape(4, 2)),
        },
        {
            "time": ("time", np.array([0, 2, 3]), {"units": "days since 2000-01-01"}),
            "lat": ("lat", np.arange(4, dtype="f4"), {"bounds": "lat_bnds", "levels": [1, 2]}),
            "lon": ("lon", np.arange(5, dtype="i2")),
            "slope": (("lat", "lon"), np.full((4, 5), np.nan, dtype="f4")),
            "label": ("time", np.array(["a", "bb", "ö"], dtype=object)),
        },
        {"title": "a store"},
    )


@pytest.mark.parametrize("zarr_format", [2, 3])
@pytest.mark.parametrize("group", [None, "inner"])
def test_a_store_gives_what_was_written(tmp_path: Path, zarr_format: int, group: str) -> None:
    path = tmp_path / "a.zarr"
    packing = {"dtype": "int16", "scale_factor": 0.5, "_FillValue": -9}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of texts that are not yet in the specification
        dataset().to_zarr(
            path,
            group=group,
            zarr_format=zarr_format,
            encoding={"u": packing, "slope": {"_FillValue": np.float32(-1)}},
        )
    with open_series(path, var="u" if group is None else f"{group}/u") as series:
        metadata = series.metadata
    assert metadata.dimensions == {"time": "t", "lat": "y", "lon": "x"}
    assert (metadata.stored, metadata.file, metadata.digest) == ("int16", "a.zarr", None)
    assert metadata.attributes == {"title": "a store"}
    assert metadata.variable_attributes["_FillValue"] == -9
    assert metadata.variable_attributes["grid_mapping"] == "crs"
    found = {each.name: each for each in metadata.variables}
    assert set(found) == {"time", "lat", "lon", "slope", "label", "crs", "lat_bnds"}
    for name, one in found.items():
        wanted = dataset()[name]
        assert one.dimensions == wanted.dims
        assert one.values.dtype == wanted.dtype
        if name != "slope":
            np.testing.assert_array_equal(one.values, wanted.values)
    assert found["slope"].attributes["_FillValue"] == np.float32(-1)
    assert (found["slope"].values == -1).all()
    others = {key: value for key, value in found["lat"].attributes.items() if key != "_FillValue"}
    assert others == {"bounds": "lat_bnds", "levels": [1, 2]}


def test_an_array_without_names_has_no_source(tmp_path: Path) -> None:
    root = zarr.open_group(tmp_path / "a.zarr", mode="w")
    root.create_array("u", data=np.ones((2, 3, 4, 5)))
    with open_series(tmp_path / "a.zarr") as series:
        assert series.metadata is None
