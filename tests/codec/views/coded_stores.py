"""Zarr stores whose arrays `fhash.transform` coded, as xarray and dask write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from fhash_formats.transform.zarr_codec import TransformCodec

DIMENSIONS = ("time", "level", "lat", "lon")
SHAPE = (5, 6, 9, 10)
CHUNKS = {"time": 2, "level": 3, "lat": 4, "lon": 4}


def smooth(shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32) -> npt.NDArray[Any]:
    grid = np.meshgrid(*(np.linspace(0, 3, n) for n in shape), indexing="ij")
    values = 50 + 40 * np.sin(sum(((i + 1) * x for i, x in enumerate(grid)), start=np.zeros(shape)))
    return values.astype(dtype)


def dataset(
    dimensions: tuple[str, ...] = DIMENSIONS, dtype: npt.DTypeLike = np.float32, name: str = "u"
) -> xr.Dataset:
    """A variable with coordinates of several types, one of them auxiliary, and a grid mapping."""
    lengths = dict(zip(DIMENSIONS, SHAPE, strict=True)) | {"member": 3}
    shape = tuple(lengths[each] for each in dimensions)
    coords: dict[str, Any] = {
        "time": ("time", np.arange(5) * 6.0, {"units": "hours since 2001-02-03"}),
        "level": ("level", np.array([1000, 850, 700, 500, 300, 100], np.int32), {"units": "hPa"}),
        "lat": ("lat", np.linspace(40, 50, 9, dtype=np.float32), {"units": "degrees_north"}),
        "lon": ("lon", np.linspace(5, 15, 10), {"units": "degrees_east"}),
        "height": ("lat", np.linspace(0, 900, 9), {"units": "m"}),
    }
    attributes = {"units": "K", "long_name": "a field", "grid_mapping": "crs"}
    return xr.decode_cf(
        xr.Dataset(
            {
                name: (dimensions, smooth(shape, dtype), attributes),
                "crs": ((), np.int32(0), {"grid_mapping_name": "latitude_longitude"}),
            },
            {
                key: value
                for key, value in coords.items()
                if key in dimensions or value[0] in dimensions
            },
            {"title": "a test"},
        )
    )


def write(
    folder: Path,
    data: xr.Dataset,
    *,
    dask: dict[str, int] | None = None,
    coded: tuple[str, ...] = ("u",),
    max_error: float = 0.01,
    **encoding: Any,
) -> Path:
    """Write a dataset with dask, each chunk by a task of its own; the store.

    dask: lengths of the tasks' chunks.
    """
    path = folder / "run.zarr"
    told = {"serializer": TransformCodec(max_error=max_error), **encoding}
    chunked = data.chunk(CHUNKS if dask is None else dask)
    chunked.to_zarr(path, mode="w", zarr_format=3, encoding=dict.fromkeys(coded, told))
    return path


def shown(path: Path, variable: str | None = None) -> xr.Dataset:
    """A store or a container as xarray shows it, in memory."""
    if path.suffix == ".fhz":
        opened = xr.open_dataset(path, engine="fhash", variable=variable)
    else:
        opened = xr.open_zarr(path)
    with opened:
        return opened.load()


def without_provenance(data: xr.Dataset) -> xr.Dataset:
    """A dataset without the attributes that name the file it was made of."""
    kept = {
        key: value
        for key, value in data.attrs.items()
        if key != "history" and not key.startswith("fhash_")
    }
    return data.drop_attrs(deep=False).assign_attrs(kept)
