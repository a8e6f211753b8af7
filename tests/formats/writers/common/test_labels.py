"""Names and attributes in the forms that files can hold."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from labelled_region import COORDS, DATA, labelled_region

from fhash_formats import save_region
from fhash_formats.series import Coordinate
from fhash_formats.writers.common.labels import (
    coordinate_attributes,
    hdf5_value,
    safe_name,
    safe_names,
    variable_attributes,
)
from fhash_formats.writers.common.region import Region


def region(
    shape: tuple[int, int, int, int] = (1, 1, 1, 1),
    dtype: str = "f4",
    names: str = "tzyx",
    **changes: Any,
) -> Region:
    coords = {
        axis: Coordinate(name=name, values=np.zeros(n))
        for axis, name, n in zip("tzyx", names, shape, strict=True)
    }
    return Region(
        **{"name": "wind", "dtype": np.dtype(dtype), "shape": shape, "coords": coords, **changes}
    )


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("wind", "wind"),
        ("air temperature", "air temperature"),
        ("Größe", "Größe"),
        ("group/wind", "group_wind"),
        ("/", "values"),
        ("..", "values"),
        (" . ", "values"),
        ("__wind", "_wind"),
        ("a\nb\0c\\d", "a_b_c_d"),
        ("zarr.json", "zarr_json"),
    ],
)
def test_safe_names(name: str, safe: str) -> None:
    assert safe_name(name) == safe
    assert safe_name(safe) == safe


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("tzyx", "t z y x"),
        ("aaaa", "a a_2 a_3 a_4"),
        (["x", "wind", "wind", "x"], "x wind_2 wind_3 x_2"),
        (["", "/", "b", "b_2"], "t values b b_2"),
    ],
)
def test_all_names_of_a_file_differ(names: Any, expected: str) -> None:
    variable, found = safe_names(region(names=names))
    assert variable == "wind"
    assert list(found) == ["t", "z", "y", "x"]
    assert list(found.values()) == expected.split()


def test_no_attribute_that_changes_the_values_is_kept() -> None:
    packing = {
        name: 1
        for name in (
            "scale_factor",
            "add_offset",
            "_FillValue",
            "missing_value",
            "valid_range",
            "valid_min",
            "valid_max",
        )
    }
    references = {
        name: "x"
        for name in (
            "coordinates",
            "grid_mapping",
            "bounds",
            "DIMENSION_LIST",
            "_Netcdf4Dimid",
            "CLASS",
        )
    }
    made = region(
        name="group/wind",
        units="m s-1",
        attributes={
            **packing,
            **references,
            "standard_name": "wind_speed",
            "units": "knots",
            "": 1,
        },
    )
    assert variable_attributes(made) == {
        "standard_name": "wind_speed",
        "units": "m s-1",
        "long_name": "group/wind",
    }
    time = Coordinate(
        name="t",
        values=np.zeros(1),
        attributes={
            "units": "hours since 1970-01-01",
            "calendar": "gregorian",
            "bounds": "time_bnds",
        },
    )
    assert coordinate_attributes("t", time) == {
        "axis": "T",
        "units": "hours since 1970-01-01",
        "calendar": "gregorian",
    }
    assert coordinate_attributes(
        "z", Coordinate(name="z", values=np.zeros(1), attributes={"axis": "z", "positive": "up"})
    ) == {
        "axis": "z",
        "positive": "up",
    }


def test_attributes_are_json_and_what_cannot_be_is_left_out() -> None:
    odd = {
        "a": np.float32(1.5),
        "b": np.arange(3),
        "c": (1, "x"),
        "d": float("nan"),
        "e2": "\udcff",
        "e": b"raw",
        "f": {"g": None},
        "h": Path("p"),
        "i": True,
    }
    kept = variable_attributes(region(attributes=odd))
    assert kept == {
        "a": 1.5,
        "b": [0, 1, 2],
        "c": [1, "x"],
        "d": "NaN",
        "e": "raw",
        "e2": "\u00ff",
        "f": {"g": None},
        "i": True,
    }
    assert json.loads(json.dumps(kept, allow_nan=False)) == kept


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("text", "text"),
        ("nul\0", "nul"),
        (True, 1),
        (3, 3),
        (2**63, "9223372036854775808"),
        (0.5, 0.5),
        ([1, 2], [1, 2]),
        ([0.5, 1.5], [0.5, 1.5]),
        (["a", "b"], ["a", "b"]),
        ([1, "a"], '[1, "a"]'),
        ([2**70], "[1180591620717411303424]"),
        ([], "[]"),
        (None, "null"),
        ({"a": 1}, '{"a": 1}'),
    ],
)
def test_attributes_of_hdf5(tmp_path: Path, value: Any, expected: Any) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["a"] = hdf5_value(value)
        read = file.attrs["a"]
        assert (read.tolist() if isinstance(read, np.ndarray) else read) == expected


def test_a_long_list_fits_into_hdf5(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["a"] = hdf5_value(list(range(20000)))
        assert json.loads(file.attrs["a"]) == list(range(20000))


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
def test_names_that_a_file_cannot_hold(tmp_path: Path, suffix: str) -> None:
    import xarray

    coords = {
        axis: Coordinate(name="gas/density", values=coordinate.values)
        for axis, coordinate in COORDS.items()
    }
    (path,) = save_region(
        tmp_path / f"out{suffix}",
        labelled_region(name="gas/density", coords=coords, attributes={}),
        DATA,
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
