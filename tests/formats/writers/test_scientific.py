"""HDF5, NetCDF and Zarr: labels, exact coordinates, chunks, and what xarray sees."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from fhash_formats import Region, save_region
from fhash_formats.series import Coordinate
from fhash_formats.writers.common.held_file import HeldFile

SHAPE = (3, 4, 5, 6)
HOURS = 347921.000277 + np.array([0.0, 1.0, 3.5])
COORDS = {
    "t": Coordinate(
        name="time",
        values=HOURS,
        attributes={
            "units": "hours since 1970-01-01",
            "calendar": "gregorian",
            "standard_name": "time",
            "bounds": "time_bnds",
        },
    ),
    "z": Coordinate(
        name="height",
        values=np.array([5.0, 21.666664123535156, 45.0, 75.0]),
        attributes={"units": "m", "positive": "up"},
    ),
    "y": Coordinate(
        name="lat",
        values=np.linspace(1, -1, 5),
        attributes={"units": "degrees_north", "axis": "Y", "scale_factor": 0.5},
    ),
    "x": Coordinate(name="lon", values=np.linspace(0.1, 0.7, 6)),
}
ATTRIBUTES = {
    "standard_name": "air_temperature",
    "scale_factor": 0.5,
    "add_offset": 100.0,
    "_FillValue": 3.0,
    "missing_value": -9.0,
    "valid_range": [0, 1],
    "coordinates": "sigma altitude",
    "grid_mapping": "rotated_pole",
    "flags": [1, 2],
}
DATA = np.random.default_rng(3).normal(size=SHAPE).astype("f4")
DATA[0, 0, 0, :2] = np.nan, 3.0


def region(**changes: Any) -> Region:
    made = {
        "name": "theta",
        "units": "K",
        "dtype": np.dtype("f4"),
        "shape": SHAPE,
        "coords": COORDS,
        "attributes": ATTRIBUTES,
    }
    return Region(**{**made, **changes})


def test_hdf5_has_scales_and_attributes(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "out.h5", region(), DATA)
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

    (path,) = save_region(tmp_path / f"out{suffix}", region(), DATA)
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
    (path,) = save_region(tmp_path / "out.nc", region(), DATA)
    with h5py.File(path) as file:
        assert file.attrs["Conventions"] == "CF-1.8"
        assert np.isnan(file["theta"].attrs["_FillValue"]).all()
        assert all(
            "_FillValue" not in file[coordinate.name].attrs for coordinate in COORDS.values()
        )
    (path,) = save_region(tmp_path / "int.nc", region(dtype=np.dtype("i2")), np.zeros(SHAPE, "i2"))
    with h5py.File(path) as file:
        assert "_FillValue" not in file["theta"].attrs


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_names_that_a_file_cannot_hold(tmp_path: Path, suffix: str) -> None:
    import xarray

    coords = {
        axis: Coordinate(name="gas/density", values=coordinate.values)
        for axis, coordinate in COORDS.items()
    }
    (path,) = save_region(
        tmp_path / f"out{suffix}", region(name="gas/density", coords=coords, attributes={}), DATA
    )
    if suffix == ".h5":
        with h5py.File(path) as file:
            assert sorted(file) == ["gas_density", *(f"gas_density_{n}" for n in (2, 3, 4, 5))]
            np.testing.assert_array_equal(file["gas_density"], DATA)
            assert file["gas_density"].attrs["long_name"] == "gas/density"
        return
    with xarray.open_dataset(path, engine="zarr" if suffix == ".zarr" else "h5netcdf") as data:
        assert data["gas_density"].dims == tuple(f"gas_density_{n}" for n in (2, 3, 4, 5))
        np.testing.assert_array_equal(data["gas_density"].values, DATA)
        assert data["gas_density"].attrs == {"units": "K", "long_name": "gas/density"}


def test_zarr_is_one_chunk_a_step_and_none_is_missing(tmp_path: Path) -> None:
    import zarr

    nothing = np.zeros(SHAPE, "i4")
    nothing[1] = 7
    (path,) = save_region(tmp_path / "out.zarr", region(dtype=np.dtype("i4")), nothing)
    theta = zarr.open_group(path, mode="r")["theta"]
    assert isinstance(theta, zarr.Array)
    assert (theta.metadata.zarr_format, theta.chunks, theta.nchunks_initialized) == (
        3,
        (1, 4, 5, 6),
        3,
    )
    assert sum(file.is_file() for file in (path / "theta" / "c").rglob("*")) == 3
    np.testing.assert_array_equal(theta[:], nothing)


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_a_frame_above_the_bound_is_several_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    import zarr

    monkeypatch.setattr("fhash_formats.writers.common.writer.CHUNK_BYTES", 250)
    (path,) = save_region(tmp_path / f"out{suffix}", region(), DATA)
    if suffix == ".zarr":
        theta = zarr.open_group(path, mode="r")["theta"]
        assert isinstance(theta, zarr.Array)
        assert theta.chunks == (1, 2, 5, 6)
        np.testing.assert_array_equal(theta[:], DATA)
        return
    with h5py.File(path) as file:
        assert file["theta"].chunks == (1, 2, 5, 6)
        np.testing.assert_array_equal(file["theta"], DATA)


@pytest.mark.parametrize("suffix", [".h5", ".nc"])
def test_ctrl_c_inside_hdf5_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    # It was: h5py swallows what is raised while it releases an object, and the file that remained had a hole.
    write, calls = HeldFile.write, []

    def interrupted(self: HeldFile, data: Any, /) -> int:
        calls.append(len(data))
        if len(calls) == 5:
            signal.raise_signal(signal.SIGINT)
        return write(self, data)

    def frames() -> Iterator[np.ndarray]:
        yield from DATA

    monkeypatch.setattr(HeldFile, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_region(tmp_path / f"out{suffix}", region(), frames())
    assert len(calls) >= 5
    assert list(tmp_path.iterdir()) == []
