"""Opening NetCDF files: groups, packed values, and the packing that a variable declares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from stored_series import VALUES, save_netcdf

from fhash_formats.readers.common.netcdf_store import (
    close_groups,
    declared,
    magic_of,
    open_groups,
)

DIMS = ("time", "lev", "lat", "lon")


def test_values_are_unpacked_unless_they_are_wanted_raw(tmp_path: Path) -> None:
    path = save_netcdf(
        tmp_path / "a.nc",
        xr.Dataset({"v": (DIMS, VALUES)}),
        encoding={"v": {"dtype": "i2", "scale_factor": 0.01, "_FillValue": -9}},
    )
    for raw, dtype in ((False, "f8"), (True, "i2")):
        groups = open_groups(str(path), path, magic_of(path), raw=raw)
        try:
            array = groups["/"].variables["v"]
            assert array.dtype == dtype
            assert array.attrs.get("scale_factor") == (0.01 if raw else None)
            packing = declared("a", array)
            assert packing is not None
            assert packing.scaled is not raw
        finally:
            close_groups(groups)


def test_groups_of_a_file_are_all_opened(tmp_path: Path) -> None:
    path = save_netcdf(tmp_path / "a.nc", xr.Dataset({"v": (DIMS, VALUES)}))
    xr.Dataset({"w": (DIMS, VALUES * 2)}).to_netcdf(
        path, mode="a", group="inner/most", engine="h5netcdf"
    )
    groups = open_groups(str(path), path, magic_of(path))
    try:
        assert {"/", "/inner/most"} <= set(groups)
        np.testing.assert_array_equal(groups["/inner/most"]["w"].to_numpy(), VALUES * 2)
    finally:
        close_groups(groups)
