"""Names and texts of any kind in a source: encoded and given back, or refused before the work."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr

import fhash_codec
from fhash_codec.config import EncodeConfig
from fhash_formats.errors import FhashWarning

VALUES = np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5) + 1
NAMES = {
    "zeta ": "zeta",
    " ": "unnamed",
    "": "unnamed",
    "/": "unnamed",
    "a/b": "a_b",
    "..": "unnamed",
    "a\nb": "a_b",
    "a\0b": "a_b",
    "__x": "_x",
    "zarr.json": "zarr_json",
    ".zarray": "_zarray",
    "y" * 300: "y" * 240,
    "\u03be": "\u03be",
    "tables": "tables",
    "a b": "a b",
    "\ud800": "?",
}
CONFIG = EncodeConfig(max_error=0.01, effort=1)


def zarr_2(folder: Path, names: list[str]) -> Path:
    group = zarr.open_group(folder / "a.zarr", mode="w", zarr_format=2)
    made = group.create_array("u", shape=VALUES.shape, dtype="f4", chunks=VALUES.shape)
    made[...] = VALUES
    made.attrs["_ARRAY_DIMENSIONS"] = names
    return folder / "a.zarr"


def labelled(folder: Path, names: list[str]) -> xr.Dataset:
    return xr.Dataset({"u": (names, VALUES)}, {names[1]: [3.0, 5.0, 7.0]})


@pytest.mark.parametrize(("name", "plain"), NAMES.items(), ids=map(ascii, NAMES))
@pytest.mark.parametrize("make", [zarr_2, labelled])
def test_a_dimension_of_any_name_comes_back(
    tmp_path: Path, make: Any, name: str, plain: str
) -> None:
    names = ["time", name, "lat", "lon"]
    path = tmp_path / "a.fhz"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fhash_codec.encode(make(tmp_path, names), path, CONFIG)
    told = [str(each.message) for each in caught if each.category is FhashWarning]
    assert any("were changed" in text for text in told) == (plain != name)
    with xr.open_dataset(path, engine="fhash") as dataset:
        assert dataset["u"].dims == ("time", plain, "lat", "lon")
        np.testing.assert_allclose(dataset["u"], VALUES, atol=0.01)
        if make is labelled:
            assert dataset[plain].values.tolist() == [3, 5, 7]
