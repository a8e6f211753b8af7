"""The choice of an array of a file; arrays that cannot be read are described."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from stored_series import (
    VALUES,
    assert_frames,
    create_zarr,
    frames,
    save_netcdf,
    write_hdf5,
)

from fhash_formats import open_series
from fhash_formats.errors import InputError

DIMS = ("time", "lev", "lat", "lon")


def test_several_datasets_need_a_choice(tmp_path: Path) -> None:
    path = write_hdf5(
        tmp_path / "a.h5", density=VALUES, gas__pressure=VALUES * 2, time=np.arange(4.0)
    )
    with pytest.raises(
        InputError,
        match=r"holds 2 variables: density \(4, 3, 5, 6\), gas/pressure \(4, 3, 5, 6\);"
        " choose one with --var",
    ):
        open_series(path)
    for name in ("gas/pressure", "/gas/pressure", "pressure"):
        assert_frames(path, VALUES * 2, var=name)
    with pytest.raises(
        InputError, match=r"no variable 'presure'; it holds gas/pressure .*, density"
    ):
        open_series(path, var="presure")
    path = write_hdf5(tmp_path / "b.h5", a__v=VALUES, b__v=VALUES)
    with pytest.raises(InputError, match="means 2 variables"):
        open_series(path, var="v")


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros(3), "1 dimensions"),
        (np.zeros((3, 4)), "2 dimensions"),
        (np.float64(1), "0 dimensions"),
        (np.zeros((2, 2, 2), complex), "complex128"),
        (np.full((2, 2, 2), b"word"), "text"),
        (np.zeros((2, 2, 2), bool), "boolean.*--feature mask"),
        (np.zeros((2, 0, 2)), "length 0"),
        (np.zeros((2, 2, 2), np.longdouble), "float128|longdouble"),
    ],
)
def test_unsuitable_datasets_are_described(tmp_path: Path, array: Any, words: str) -> None:
    path = write_hdf5(tmp_path / "a.h5", odd=array)
    with pytest.raises(InputError, match=rf"no variable of 3 or 4 dimensions.*odd: .*({words})"):
        open_series(path)
    with pytest.raises(InputError, match=rf"variable odd has .*({words})"):
        open_series(path, var="odd")


def test_a_file_without_datasets(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no array at all"):
        open_series(write_hdf5(tmp_path / "a.h5"))


def test_several_variables_need_a_choice(tmp_path: Path) -> None:
    path = save_netcdf(
        tmp_path / "a.nc", xr.Dataset({"u": (DIMS, VALUES), "w": (DIMS, VALUES * 2)})
    )
    with pytest.raises(InputError, match=r"holds 2 variables: u \(4, 3, 5, 6\), w \(4, 3, 5, 6\)"):
        open_series(path)
    np.testing.assert_array_equal(frames(path, var="w"), VALUES * 2)
    with pytest.raises(InputError, match="no variable 'ww'; it holds w"):
        open_series(path, var="ww")


def test_one_dimension_only(tmp_path: Path) -> None:
    path = save_netcdf(tmp_path / "a.nc", xr.Dataset({"v": ("time", np.zeros(4))}))
    with pytest.raises(InputError, match=r"no variable of 3 or 4 dimensions.*v: 1 dimensions"):
        open_series(path)


def test_boolean_variables_are_refused(tmp_path: Path) -> None:
    path = save_netcdf(tmp_path / "a.nc", xr.Dataset({"v": (DIMS, VALUES > 0)}))
    with pytest.raises(InputError, match="boolean values"):
        open_series(path)


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros(3), "1 dimensions"),
        (np.zeros((2, 2, 2), complex), "complex128"),
        (np.zeros((2, 2, 2), bool), "boolean"),
        (np.zeros((2, 0, 2)), "length 0"),
    ],
)
@pytest.mark.parametrize("zarr_format", [2, 3])
def test_unsuitable_arrays_are_described(
    tmp_path: Path, array: np.ndarray, words: str, zarr_format: int
) -> None:
    create_zarr(tmp_path / "a.zarr", array, name="odd", zarr_format=zarr_format)
    with pytest.raises(InputError, match=f"odd: .*{words}"):
        open_series(tmp_path / "a.zarr")
