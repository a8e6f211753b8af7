"""NetCDF files of the kinds that CF data come in, small, with all that belongs to a variable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr


@dataclass(frozen=True)
class Kind:
    """A dataset, its variable, how it is encoded, and what is selected."""

    dataset: xr.Dataset
    variable: str
    encoding: dict[str, Any] = field(default_factory=dict)
    select: dict[str, int] = field(default_factory=dict)

    def write(self, path: Path) -> Path:
        self.dataset.to_netcdf(path, engine="h5netcdf", encoding=self.encoding)
        return path


def smooth(*shape: int) -> np.ndarray:
    axes = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    return 280 + 10 * np.sin(sum((3 + n) * axis for n, axis in enumerate(axes)))


def rotated() -> Kind:
    """Three dimensions: z is made up. Latitude and longitude are 2-D."""
    rlat, rlon = np.linspace(-2, 2, 7, dtype=np.float32), np.linspace(8, 11, 9, dtype=np.float32)
    lat, lon = np.meshgrid(rlat + 50, rlon, indexing="ij")
    data = xr.Dataset(
        {
            "tas": (
                ("time", "rlat", "rlon"),
                smooth(4, 7, 9).astype(np.float32),
                {"units": "K", "grid_mapping": "rotated_pole", "cell_methods": "time: mean"},
            ),
            "rotated_pole": (
                (),
                np.int32(0),
                {
                    "grid_mapping_name": "rotated_latitude_longitude",
                    "grid_north_pole_latitude": 39.25,
                    "north_pole_grid_longitude": np.float32(0.1),
                },
            ),
            "rlat_bnds": (("rlat", "bnds"), np.stack([rlat - 0.3, rlat + 0.3], axis=1)),
        },
        {
            "time": (
                "time",
                np.arange(4) * 6.0,
                {"units": "hours since 2001-02-03", "calendar": "standard"},
            ),
            "rlat": ("rlat", rlat, {"axis": "Y", "units": "degrees", "bounds": "rlat_bnds"}),
            "rlon": ("rlon", rlon, {"axis": "X", "units": "degrees"}),
            "lat": (("rlat", "rlon"), lat, {"units": "degrees_north"}),
            "lon": (("rlat", "rlon"), lon.astype(np.float64), {"units": "degrees_east"}),
            "height": ((), 2.0, {"units": "m", "axis": "Z", "positive": "up"}),
        },
        {"Conventions": "CF-1.8", "history": "made by hand\n", "levels": np.array([1, 2], "i2")},
    )
    return Kind(data, "tas", {"tas": {"_FillValue": None}})


def hybrid() -> Kind:
    """Hybrid levels with the terms of their formula, also a field of pressure at the surface."""
    data = xr.Dataset(
        {
            "t": (("time", "lev", "lat", "lon"), smooth(3, 4, 5, 6), {"units": "K"}),
            "hyam": ("lev", np.linspace(10, 5000, 4)),
            "hybm": ("lev", np.linspace(0, 1, 4, dtype=np.float32)),
            "p0": ((), np.float32(100000), {"units": "Pa"}),
            "aps": (("time", "lat", "lon"), (1e5 + smooth(3, 5, 6)).astype(np.float32)),
        },
        {
            "time": ("time", np.array([0, 12, 24], "i4"), {"units": "hours since 2000-01-01"}),
            "lev": (
                "lev",
                np.arange(1, 5, dtype=np.int32),
                {
                    "standard_name": "atmosphere_hybrid_sigma_pressure_coordinate",
                    "formula_terms": "a: hyam b: hybm ps: aps p0: p0",
                    "positive": "down",
                },
            ),
            "lat": ("lat", np.linspace(-80, 80, 5), {"units": "degrees_north"}),
            "lon": ("lon", np.arange(6) * 60.0, {"units": "degrees_east"}),
        },
        {"title": "hybrid levels"},
    )
    return Kind(data, "t")


def calendar() -> Kind:
    """Days of a calendar with 360 of them, and their bounds."""
    days = np.arange(15, 135, 30, dtype=np.int64)
    data = xr.Dataset(
        {
            "pr": (("time", "lat", "lon"), smooth(4, 6, 7).astype(np.float32), {"units": "mm"}),
            "time_bnds": (("time", "bnds"), np.stack([days - 15, days + 15], axis=1)),
        },
        {
            "time": (
                "time",
                days,
                {
                    "units": "days since 1950-01-01",
                    "calendar": "360_day",
                    "bounds": "time_bnds",
                },
            ),
            "lat": ("lat", np.linspace(-60, 60, 6, dtype=np.float32)),
            "lon": ("lon", np.linspace(0, 300, 7)),
        },
    )
    return Kind(data, "pr")


def packed() -> Kind:
    """Integers of 16 bits with a scale, an offset and missing values; x is the slowest."""
    values = smooth(5, 6, 4)
    values[2, 3] = np.nan
    data = xr.Dataset(
        {"sst": (("lon", "lat", "time"), values, {"units": "K", "valid_min": np.int16(-9000)})},
        {
            "lon": ("lon", np.arange(5) * 0.25),
            "lat": ("lat", np.arange(6) * 0.5 + 10),
            "time": ("time", np.arange(4.0), {"units": "days since 1999-12-31"}),
        },
    )
    packing = {"dtype": "int16", "scale_factor": 0.01, "add_offset": 280.0, "_FillValue": -32768}
    return Kind(data, "sst", {"sst": packing})


def ensemble() -> Kind:
    """Members with names, of which one is selected."""
    data = xr.Dataset(
        {"u": (("member", "time", "lev", "lat", "lon"), smooth(3, 2, 3, 5, 6).astype("f4"))},
        {
            "member": ("member", np.array(["control", "p1", "p2"], dtype=object)),
            "weight": ("member", np.array([0.5, 0.25, 0.25])),
            "time": ("time", np.array([0.0, 1.0]), {"units": "days since 2020-01-01"}),
            "lev": ("lev", np.array([850, 500, 200], "i2"), {"units": "hPa"}),
            "lat": ("lat", np.linspace(-1, 1, 5)),
            "lon": ("lon", np.linspace(0, 1, 6)),
        },
    )
    return Kind(data, "u", {}, {"member": 1})


def counts() -> Kind:
    """Integers with a missing value, one step, and a dimension of length 1 that is no axis."""
    values = np.arange(60, dtype=np.int16).reshape(1, 3, 4, 5)
    values[0, 1, 2, 3] = -9
    data = xr.Dataset(
        {"n": (("height", "lev", "lat", "lon"), values, {"_FillValue": np.int16(-9)})},
        {"lev": ("lev", np.array([1.0, 2.5, 7.0]))},
    ).rename({"height": "realization"})
    return Kind(data, "n")


KINDS: dict[str, Callable[[], Kind]] = {
    each.__name__: each for each in (rotated, hybrid, calendar, packed, ensemble, counts)
}
