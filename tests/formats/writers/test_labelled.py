"""HDF5: dimension scales, attributes, and exact coordinates."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from labelled_region import COORDS, DATA, SHAPE, labelled_region

from fhash_formats.writers import save_region


def test_hdf5_has_scales_and_attributes(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "out.h5", labelled_region(), DATA)
    with h5py.File(path) as file:
        theta = file["theta"]
        assert sorted(file) == ["height", "lat", "lon", "theta", "time"]
        assert theta.chunks == (1, 4, 5, 6)
        assert dict(theta.attrs)["units"] == "K"
        assert theta.attrs["standard_name"] == "air_temperature"
        assert theta.attrs["flags"].tolist() == [1, 2]
        assert not {"scale_factor", "add_offset", "_FillValue", "valid_range", "coordinates"} & set(
            theta.attrs
        )
        for dimension, (axis, coordinate) in enumerate(COORDS.items()):
            scale = theta.dims[dimension][0]
            assert theta.dims[dimension].label == coordinate.name
            assert scale.name == f"/{coordinate.name}"
            assert scale.dtype == np.float64
            np.testing.assert_array_equal(scale, coordinate.values)
            assert scale.attrs["axis"] == axis.upper()
        assert file["time"].attrs["calendar"] == "gregorian"


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_xarray_sees_labelled_values(tmp_path: Path, suffix: str) -> None:
    import xarray

    (path,) = save_region(tmp_path / f"out{suffix}", labelled_region(), DATA)
    opened = xarray.open_zarr if suffix == ".zarr" else xarray.open_dataset
    with opened(path, decode_times=False) as data:
        theta = data["theta"]
        assert theta.dims == ("time", "height", "lat", "lon")
        assert set(data.variables) == {"theta", "time", "height", "lat", "lon"}
        assert theta.dtype == np.float32
        np.testing.assert_array_equal(theta.values, DATA)
        assert theta.attrs["units"] == "K"
        assert theta.attrs["standard_name"] == "air_temperature"
        assert not {
            "scale_factor",
            "add_offset",
            "missing_value",
            "valid_range",
            "grid_mapping",
        } & set(theta.attrs)
        for axis, coordinate in COORDS.items():
            found = data[coordinate.name]
            assert found.dtype == np.float64
            np.testing.assert_array_equal(found.values, coordinate.values)
            kept = {
                key: value
                for key, value in coordinate.attributes.items()
                if key not in ("bounds", "scale_factor")
            }
            assert found.attrs == {"axis": axis.upper(), **kept}
    with opened(path) as data:
        assert str(data["time"].values[0]).startswith("2009-09-09T17:00:00.99")
        assert (
            float(data["theta"].sel(lat=-1.0, lon=0.1, height=5.0).isel(time=0))
            == DATA[0, 0, -1, 0]
        )


def test_netcdf_declares_its_fill_value_for_floats_only(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "out.nc", labelled_region(), DATA)
    with h5py.File(path) as file:
        assert file.attrs["Conventions"] == "CF-1.8"
        assert np.isnan(file["theta"].attrs["_FillValue"]).all()
        assert all(
            "_FillValue" not in file[coordinate.name].attrs for coordinate in COORDS.values()
        )
    (path,) = save_region(
        tmp_path / "int.nc", labelled_region(dtype=np.dtype("i2")), np.zeros(SHAPE, "i2")
    )
    with h5py.File(path) as file:
        assert "_FillValue" not in file["theta"].attrs


def test_zarr_is_one_chunk_a_step_and_none_is_missing(tmp_path: Path) -> None:
    import zarr

    nothing = np.zeros(SHAPE, "i4")
    nothing[1] = 7
    (path,) = save_region(tmp_path / "out.zarr", labelled_region(dtype=np.dtype("i4")), nothing)
    theta = zarr.open_group(path, mode="r")["theta"]
    assert isinstance(theta, zarr.Array)
    assert (theta.metadata.zarr_format, theta.chunks, theta.nchunks_initialized) == (
        3,
        (1, 4, 5, 6),
        3,
    )
    assert sum(file.is_file() for file in (path / "theta" / "c").rglob("*")) == 3
    np.testing.assert_array_equal(theta[:], nothing)
