"""Packed values by CF: the types of the results, fill values, unsigned integers, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stored_series import (
    VALUES,
    create_zarr,
    frames,
)

from fhash_formats import open_series
from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf_packing import packing


def test_zarrs_own_fill_value_hides_nothing_unless_xarray_wrote_it(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    create_zarr(tmp_path / "a.zarr", values, zarr_format=2, fill_value=0)
    np.testing.assert_array_equal(frames(tmp_path / "a.zarr")[0], values)
    create_zarr(
        tmp_path / "b.zarr", values, zarr_format=3, fill_value=0, dimension_names=["z", "y", "x"]
    )
    np.testing.assert_array_equal(frames(tmp_path / "b.zarr")[0], values)
    create_zarr(
        tmp_path / "c.zarr",
        values,
        zarr_format=2,
        fill_value=0,
        attributes={"_ARRAY_DIMENSIONS": ["z", "y", "x"]},
    )
    np.testing.assert_array_equal(
        frames(tmp_path / "c.zarr")[0], np.where(values == 0, np.nan, values.astype("f4"))
    )


def test_unsigned_values_stored_as_signed(tmp_path: Path) -> None:
    values = np.array([0, 1, 127, 128, 254, 255], np.uint8).reshape(1, 2, 3)
    attributes = {"_Unsigned": "true", "_FillValue": -1, "missing_value": 300}
    create_zarr(tmp_path / "a.zarr", values.view(np.int8), attributes=attributes)
    np.testing.assert_array_equal(
        frames(tmp_path / "a.zarr")[0], np.where(values == 255, np.nan, values.astype("f4"))
    )


def test_bad_packing_attributes_are_refused(tmp_path: Path) -> None:
    create_zarr(tmp_path / "a.zarr", VALUES, attributes={"scale_factor": "two"})
    with pytest.raises(InputError, match="scale_factor is 'two', not a number"):
        open_series(tmp_path / "a.zarr")
    create_zarr(tmp_path / "b.zarr", VALUES, attributes={"_FillValue": "?"})
    with pytest.raises(InputError, match=r"fill value '\?' is not a number"):
        open_series(tmp_path / "b.zarr")


@pytest.mark.parametrize(
    ("stored", "attributes", "expected"),
    [
        ("i2", {}, "i2"),
        (">i2", {}, "i2"),
        ("i2", {"_FillValue": -9}, "f4"),
        ("i4", {"_FillValue": -9}, "f8"),
        ("f4", {"_FillValue": -9}, "f4"),
        ("f4", {"scale_factor": 2}, "f8"),
        ("u1", {"add_offset": 0.5}, "f8"),
        ("i1", {"_Unsigned": "true"}, "u1"),
    ],
)
def test_the_type_of_the_values_holds_every_stored_number(
    stored: str, attributes: dict[str, Any], expected: str
) -> None:
    made = packing("a", np.dtype(stored), attributes)
    values = made.unpack(np.array([1, 2], stored))
    assert made.dtype == values.dtype == np.dtype(expected)


def test_scale_offset_and_every_fill_value_are_used() -> None:
    attributes = {"_FillValue": 1, "missing_value": [2, 300], "scale_factor": 0.5, "add_offset": 7}
    made = packing("a", np.dtype("u1"), attributes, fill_value=3)
    np.testing.assert_array_equal(
        made.unpack(np.array([0, 1, 2, 3, 4], "u1")), [7, np.nan, np.nan, np.nan, 9]
    )


@pytest.mark.parametrize("written", ["NaN", "AAAAAAAA+H8=", float("nan")])
def test_a_fill_value_of_nan_marks_itself(written: object) -> None:
    assert packing("a", np.dtype("f4"), {"_FillValue": written}).fills == ()
