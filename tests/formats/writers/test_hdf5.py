"""HDF5: dimension scales, attributes, and exact coordinates."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from labelled_region import COORDS, DATA, labelled_region

from fhash_formats import save_region


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
