"""Axes of a file's dimensions: by CF attributes, by names, by places."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from stored_series import (
    VALUES,
    frames,
    save_netcdf,
)

from fhash_formats import open_series
from fhash_formats.errors import InputError


def roles(path: Path, sizes: str, **coords: Any) -> str:
    """Axes of a variable's dimensions a, b, c, d, as letters in file order.

    The dimensions have different lengths, which tell them apart.
    """
    values = VALUES[tuple(slice(None) if at < len(sizes) else 0 for at in range(4))]
    save_netcdf(
        path,
        xr.Dataset(
            {"v": (tuple(sizes), values)}, coords={name: coord for name, coord in coords.items()}
        ),
    )
    with open_series(path) as series:
        return "".join("tzyx"[series.shape.index(length)] for length in values.shape)


def along(dimension: str, **attributes: str) -> tuple[str, np.ndarray, dict[str, str]]:
    return dimension, np.arange(float(VALUES.shape["abcd".index(dimension)])), attributes


@pytest.mark.parametrize(
    ("coords", "expected"),
    [
        ({}, "tzyx"),
        (
            {
                "a": along("a", axis="X"),
                "b": along("b", axis="Y"),
                "c": along("c", axis="Z"),
                "d": along("d", axis="T"),
            },
            "xyzt",
        ),
        (
            {
                "a": along("a", standard_name="projection_x_coordinate"),
                "b": along("b", standard_name="latitude"),
                "c": along("c", standard_name="atmosphere_hybrid_height_coordinate"),
                "d": along("d", standard_name="time"),
            },
            "xyzt",
        ),
        (
            {
                "a": along("a", units="degrees_east"),
                "b": along("b", units="hours since 2000-01-01"),
                "c": along("c", units="hPa"),
            },
            "xtzy",
        ),
        ({"a": along("a", positive="down"), "b": along("b", axis="T")}, None),
        (
            {
                "a": along("a", positive="down"),
                "b": along("b", axis="T"),
                "c": along("c", axis="Y"),
            },
            "ztyx",
        ),
        (
            {"when": along("d", axis="T"), "c": along("c", axis="Z"), "b": along("b", axis="Y")},
            "xyzt",
        ),
    ],
)
def test_axes_by_cf_attributes(
    tmp_path: Path, coords: dict[str, Any], expected: str | None
) -> None:
    if expected is None:
        with pytest.raises(InputError, match=r"not clear.*--axes"):
            roles(tmp_path / "a.nc", "abcd", **coords)
    else:
        assert roles(tmp_path / "a.nc", "abcd", **coords) == expected


@pytest.mark.parametrize(
    ("dims", "shape"),
    [
        (("time", "lat", "lon"), (4, 1, 3, 5)),
        (("lev", "lat", "lon"), (1, 4, 3, 5)),
        (("lon", "lat", "time_0"), (5, 1, 3, 4)),
        (("time", "z", "x"), (4, 3, 1, 5)),
        (("sheet", "south_north", "west_east"), (1, 4, 3, 5)),
    ],
)
def test_three_dimensions_by_name(
    tmp_path: Path, dims: tuple[str, ...], shape: tuple[int, ...]
) -> None:
    path = save_netcdf(tmp_path / "a.nc", xr.Dataset({"v": (dims, VALUES[:, :, :, 0])}))
    with open_series(path) as series:
        assert series.shape == shape


def test_two_dimensions_of_one_meaning_are_refused(tmp_path: Path) -> None:
    path = save_netcdf(
        tmp_path / "a.nc", xr.Dataset({"v": (("time", "lev", "height", "lon"), VALUES)})
    )
    with pytest.raises(
        InputError,
        match=r"two dimensions of \(time=4, lev=3, height=5, lon=6\) mean the same axis.*--axes",
    ):
        open_series(path)
    np.testing.assert_array_equal(frames(path, axes="t,z,y,x"), VALUES)
