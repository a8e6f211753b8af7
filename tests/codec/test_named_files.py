"""Files of one variable under the names of their source: libraries of Zarr show the variable."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
import zarr

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_formats.series import ArraySeries, Coordinate

SHAPE = (5, 4, 12, 10)


def values() -> np.ndarray[Any, Any]:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in SHAPE), indexing="ij")
    return (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)


def series(
    data: np.ndarray[Any, Any] | None = None,
    name: str = "rain rate",
    times: Sequence[float] = (0, 1, 2.5, 4, 9),
) -> ArraySeries:
    coords = {
        "t": Coordinate(name="time", values=np.array(times)),
        "z": Coordinate(name="height", values=np.array([1.0, 2.0, 4.0, 8.0])),
        "x": Coordinate(name="lon", values=np.linspace(0, 90, SHAPE[3])),
    }
    return ArraySeries(values() if data is None else data, name=name, units="mm h-1", coords=coords)


def shown(path: Path) -> xarray.Dataset:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        store = zarr.storage.ZipStore(path, mode="r")
        return xarray.open_zarr(store, consolidated=False, chunks=None).load()


@pytest.mark.parametrize("tile", ["whole", "2x4x6x10"])
@pytest.mark.parametrize("effort", [1, 3])
def test_xarray_shows_the_variable(tmp_path: Path, tile: str, effort: int) -> None:
    path = tmp_path / "run.fhz"
    config = EncodeConfig(effort=effort, max_error=0.01, tile=tile, timings=False)
    fhash_codec.encode(series(), path, config)
    dataset = shown(path)
    assert list(dataset.data_vars) == ["rain_rate"]
    assert dataset["rain_rate"].dims == ("time", "height", "y", "lon")
    assert dataset["rain_rate"].attrs == {"units": "mm h-1"}
    with fhash_codec.open(path) as volume:
        assert volume.name == "rain rate"
        assert volume.info["arrays"]["rain_rate"]["shape"] == list(SHAPE)
        np.testing.assert_array_equal(dataset["rain_rate"], volume[...])
        assert volume.verify()


def test_of_features_it_shows_the_box_and_nan_outside(tmp_path: Path) -> None:
    path = tmp_path / "run.fhz"
    config = EncodeConfig(effort=2, max_error=0.01, features=("interval:1.2:9",), dilation=0)
    fhash_codec.encode(series(), path, config)
    with fhash_codec.open(path) as volume:
        box = tuple(slice(low, high) for low, high in volume.box)
        expected = volume[(slice(None), *box)]
    found = shown(path)["rain_rate"]
    np.testing.assert_array_equal(found, expected)
    assert np.isnan(expected).any()
    assert found.dims[0] == "time"
    for name, own, whole in zip(found.dims[1:], found.shape[1:], SHAPE[1:], strict=True):
        assert str(name).endswith("_box") == (own != whole)
