"""The law of exports: what is written in a format is read from it with the same values, positions,
times and units, as far as the format holds them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fhash_formats.readers import open_series
from fhash_formats.series import Coordinate
from fhash_formats.writers import Region, save_region

EVEN = {"t": [3.5, 4.0, 9.0], "z": [2.0, 2.5], "y": [-1.0, 0.0, 1.0, 2.0], "x": [10.0, 10.5, 11.0]}
UNEVEN = {**EVEN, "x": [10.0, 10.5, 13.0], "z": [5.0, 7.5]}
UNITS = "days since 2001-02-03"


def region(axes: dict[str, list[float]], dtype: str) -> Region:
    coords = {
        axis: Coordinate(
            name={"t": "time"}.get(axis, axis),
            values=np.array(values),
            attributes={"units": UNITS} if axis == "t" else {},
        )
        for axis, values in axes.items()
    }
    t, z, y, x = (len(axes[axis]) for axis in "tzyx")
    return Region(
        name="wind", units="m/s", dtype=np.dtype(dtype), shape=(t, z, y, x), coords=coords
    )


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("dtype", ["f4", "f8", "i2"])
@pytest.mark.parametrize(
    "suffix", [".h5", ".nc", ".zarr", ".raw", ".vti", ".vtr", ".pvd", ".vtkhdf"]
)
def test_an_export_comes_back(tmp_path: Path, suffix: str, dtype: str, steps: int) -> None:
    axes = {**(UNEVEN if suffix == ".vtr" else EVEN), "t": EVEN["t"][:steps]}
    described = region(axes, dtype)
    values = np.random.default_rng(0).normal(size=described.shape) * 100
    values = values.astype(dtype)
    written = save_region(tmp_path / f"out{suffix}", described, values)
    with open_series(written[-1]) as series:  # the list of files, or the header, is the last
        assert series.shape == described.shape
        assert series.dtype == described.dtype
        np.testing.assert_array_equal(np.stack(list(series.frames())), values)
        assert (series.name, series.units) == ("wind", "m/s")
        for axis in "tzyx":
            np.testing.assert_array_equal(series.coords[axis].values, described.coords[axis].values)
        assert series.coords["t"].attributes["units"] == UNITS


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr", ".raw", ".vti", ".pvd", ".vtkhdf"])
def test_no_date_loses_its_calendar(tmp_path: Path, suffix: str) -> None:
    described = region(EVEN, "f4")
    time = described.coords["t"]
    attributes = {**time.attributes, "calendar": "noleap"}
    coords = {**described.coords, "t": replace(time, attributes=attributes)}
    values = np.zeros(described.shape, "f4")
    written = save_region(tmp_path / f"out{suffix}", replace(described, coords=coords), values)
    with open_series(written[-1]) as series:
        found = series.coords["t"].attributes
        assert found.get("calendar") == "noleap" or "units" not in found
        assert ("units" in found) == (suffix not in (".vti", ".pvd"))


@pytest.mark.parametrize("suffix", [".vti", ".vtr", ".pvd", ".vtkhdf"])
def test_descending_axes_come_back_ascending(tmp_path: Path, suffix: str) -> None:
    described = region({**EVEN, "y": EVEN["y"][::-1]}, "f4")
    values = np.random.default_rng(0).normal(size=described.shape).astype("f4")
    written = save_region(tmp_path / f"out{suffix}", described, values)
    with open_series(written[-1]) as series:
        np.testing.assert_array_equal(series.coords["y"].values, EVEN["y"])
        np.testing.assert_array_equal(np.stack(list(series.frames())), values[:, :, ::-1])


def test_numbered_files_come_back_by_a_pattern(tmp_path: Path) -> None:
    described = region(EVEN, "f4")
    values = np.random.default_rng(0).normal(size=described.shape).astype("f4")
    save_region(tmp_path / "out.vti", described, values)
    with open_series(tmp_path / "out_*.vti") as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), values)
        np.testing.assert_array_equal(series.coords["t"].values, EVEN["t"])


def test_vtk_takes_the_time_and_its_units(tmp_path: Path) -> None:
    xml = pytest.importorskip("vtkmodules.vtkIOXML")
    described = region({**EVEN, "t": [4.0]}, "f4")
    save_region(tmp_path / "out.vti", described, np.zeros(described.shape, "f4"))
    reader = xml.vtkXMLImageDataReader()
    reader.SetFileName(str(tmp_path / "out.vti"))
    reader.Update()
    array = reader.GetOutput().GetFieldData().GetArray("TimeValue")
    assert array.GetTuple1(0) == 4.0
    assert array.GetInformation().Get(array.UNITS_LABEL()) == UNITS
