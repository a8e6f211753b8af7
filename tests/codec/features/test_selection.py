"""Labelled arrays keep their labels and all that belongs to them, and are read frame by frame."""

from __future__ import annotations

import functools
import http.server
import threading
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr

from fhash_codec import InputError as InputError_lazy
from fhash_codec.config import EncodeConfig
from fhash_codec.features import selection as lazy
from fhash_codec.features.selection import (
    DaskSeries,
    LazyFrames,
    array_series,
    labelled_series,
    open_source,
    select_features,
)
from fhash_codec.progress import silent
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.registry import open_series
from fhash_formats.series import ArraySeries, Coordinate


def dataset() -> xr.Dataset:
    times = xr.date_range("2001-01-01", periods=3, calendar="360_day", use_cftime=True)
    return xr.Dataset(
        {
            "u": (
                ("lon", "time", "lat"),
                np.arange(60.0).reshape(5, 3, 4),
                {"units": "m s-1", "grid_mapping": "crs"},
            ),
            "crs": ((), 0, {"grid_mapping_name": "latitude_longitude"}),
        },
        {
            "time": ("time", times, {"axis": "T"}),
            "lat": ("lat", np.arange(4, dtype="f4")),
            "lon": ("lon", np.arange(5)),
            "area": (("lat", "lon"), np.ones((4, 5))),
            "when": ((), np.datetime64("2001-02-03")),
        },
        {"title": "a"},
    )


def test_a_dataset_gives_its_variable_with_what_belongs_to_it() -> None:
    source = dataset()
    series = labelled_series(source)
    assert (series.name, series.units, series.shape) == ("u", "m s-1", (3, 1, 4, 5))
    np.testing.assert_array_equal(series.read(1)[0], source["u"].values[:, 1].T)
    metadata = series.metadata
    assert metadata.dimensions == {"lon": "x", "time": "t", "lat": "y"}
    found = {each.name: each for each in metadata.variables}
    assert set(found) == {"lon", "time", "lat", "area", "when", "crs"}
    assert found["time"].attributes["calendar"] == "360_day"
    assert series.coords["t"].values.tolist() == found["time"].values.tolist() == [0, 1, 2]
    assert found["lat"].values.dtype == np.float32
    assert found["area"].is_coordinate
    assert not found["crs"].is_coordinate
    assert metadata.attributes == {"title": "a"}
    assert (metadata.file, metadata.digest) == (None, None)


def test_times_are_counted_as_the_file_counted_them() -> None:
    source = (
        dataset()
        .drop_vars("time")
        .assign_coords(
            time=("time", np.array([0.5, 1.5, 4.0]), {"units": "hours since 1999-12-31"})
        )
    )
    series = labelled_series(xr.decode_cf(source)["u"])
    assert series.coords["t"].values.tolist() == [0.5, 1.5, 4.0]
    assert series.coords["t"].attributes["units"].startswith("hours since 1999-12-31")


def test_packing_is_that_of_the_file(tmp_path: Path) -> None:
    packing = {"u": {"dtype": "int16", "scale_factor": 0.5, "_FillValue": -1}}
    dataset().to_netcdf(tmp_path / "a.nc", engine="h5netcdf", encoding=packing)
    with xr.open_dataset(tmp_path / "a.nc", decode_coords="all") as stored:
        metadata = labelled_series(stored["u"]).metadata
    assert metadata.stored == "int16"
    assert metadata.variable_attributes["scale_factor"] == 0.5
    assert not metadata.named("crs").is_coordinate  # as of the file


def test_indices_of_several_levels_are_named() -> None:
    source = dataset()["u"].stack(both=("lat", "lon")).expand_dims(lev=2).transpose()
    series = labelled_series(source)
    with pytest.warns(FhashWarning, match="both"):
        assert series.metadata.named("both") is None


def test_the_variable_must_be_clear() -> None:
    source = dataset()
    two = source.assign(v=source["u"])
    with pytest.raises(InputError, match=r"2 variables .*: u, v; .*dataset\['u'\]"):
        array_series(two)
    assert labelled_series(two, "v").name == "v"
    with pytest.raises(InputError, match="no variable 'w'; it has u, crs, v"):
        labelled_series(two, "w")
    with pytest.raises(InputError, match="no variable of 3"):
        labelled_series(source[["crs"]])


def forecast() -> xr.Dataset:
    """A dimension that no attribute explains: time in four dimensions, the slowest of three."""
    return xr.Dataset(
        {
            "T": (("frtime", "level", "lat", "lon"), np.zeros((7, 5, 4, 6), "f4")),
            "Psl": (("frtime", "lat", "lon"), np.zeros((7, 4, 6), "f4")),
        },
        {
            "frtime": ("frtime", np.arange(7.0) * 8, {"units": "hours"}),
            "level": ("level", [1000.0, 850, 500, 300, 200], {"units": "hPa"}),
            "lat": ("lat", np.linspace(20, 60, 4)),
            "lon": ("lon", np.linspace(-140, -52, 6)),
        },
    )


@pytest.mark.parametrize("kind", ["nc", "h5", "zarr", "labelled"])
def test_a_dimension_has_one_role_in_all_variables(tmp_path: Path, kind: str) -> None:
    data, path = forecast(), tmp_path / f"run.{kind}"
    if kind == "zarr":
        data.to_zarr(path, consolidated=False)
    elif kind != "labelled":
        data.to_netcdf(path, engine="h5netcdf")
    for name, shape in (("T", (7, 5, 4, 6)), ("Psl", (7, 1, 4, 6))):
        with (
            labelled_series(data, name)
            if kind == "labelled"
            else open_series(path, var=name) as series
        ):
            assert series.shape == shape
            assert series.coords["t"].values.tolist() == data["frtime"].values.tolist()


@pytest.mark.parametrize("chunks", [None, {}])
@pytest.mark.parametrize("lists", [True, False])
def test_chunks_that_a_store_elsewhere_lacks_are_told(
    tmp_path: Path, chunks: dict[str, int] | None, lists: bool
) -> None:
    group = zarr.open_group(tmp_path / "a.zarr", mode="w")
    made = group.create_array(
        "u", shape=(4, 3, 5, 6), dtype="f4", chunks=(1, 3, 5, 6), dimension_names=list("tzyx")
    )
    made[...] = np.arange(360.0).reshape(4, 3, 5, 6) + 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(tmp_path / "a.zarr")
    (tmp_path / "a.zarr" / "u" / "c" / "2" / "0" / "0" / "0").unlink()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *words: Any) -> None:
            pass

        def list_directory(self, path: Any) -> Any:
            return super().list_directory(path) if lists else self.send_error(404)

    handler = functools.partial(Handler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}/a.zarr"
        dataset = xr.open_zarr(url, chunks=chunks)
        with pytest.warns(FhashWarning, match=r"25 % of the values of 'u' .*\(step 2\).* as 0;"):
            series = array_series(dataset["u"])
        assert series.not_stored is not None
        assert series.not_stored.shares.tolist() == [0, 0, 1, 0]
        if chunks is None:
            some = "50 % of the values of 'u' .*step 0"
            with pytest.warns(FhashWarning, match=some):
                array_series(dataset["u"].isel(t=slice(2, 4)))
            assert array_series(dataset["u"].isel(t=slice(0, 2))).not_stored is None
        else:
            with pytest.warns(FhashWarning, match="25 % of the stored array behind it"):
                array_series(dataset["u"].isel(t=slice(2, 4)))
        server.shutdown()


def test_a_fill_value_that_xarray_masks_is_missing_already(tmp_path: Path) -> None:
    values = np.arange(360.0).reshape(4, 3, 5, 6)
    dataset = xr.Dataset({"u": (list("tzyx"), values)})
    options: dict[str, Any] = {"encoding": {"u": {"chunks": (1, 3, 5, 6)}}, "consolidated": False}
    dataset.to_zarr(tmp_path / "a.zarr", **options)
    (tmp_path / "a.zarr" / "u" / "c" / "2" / "0" / "0" / "0").unlink()
    assert (
        array_series(xr.open_zarr(tmp_path / "a.zarr", consolidated=False)["u"]).not_stored is None
    )


dask = pytest.importorskip("dask.array")
SHAPE = (7, 2, 3, 4)
VALUES = np.arange(np.prod(SHAPE), dtype=np.float32).reshape(SHAPE)


def counted(chunks, computed: Counter) -> object:
    """A dask array that counts how often each of its steps is computed."""

    def look(block, block_info=None):
        computed.update(range(*block_info[0]["array-location"][0]))
        return block

    return dask.map_blocks(look, dask.from_array(VALUES, chunks=chunks), dtype=VALUES.dtype)


@pytest.mark.parametrize("steps", [1, 3, 7])
def test_each_chunk_is_computed_once(steps) -> None:
    computed: Counter = Counter()
    frames = LazyFrames(counted((steps, 2, 3, 4), computed))
    for step, frame in enumerate(VALUES):
        np.testing.assert_array_equal(frames.read(step), frame)
    assert set(computed.values()) == {1}


def test_a_large_chunk_is_computed_in_slabs(monkeypatch) -> None:
    monkeypatch.setattr(lazy, "SLAB_BYTES", 2 * VALUES[0].nbytes)
    computed: Counter = Counter()
    frames = LazyFrames(counted((5, 2, 3, 4), computed))
    for step in (0, 1, 4, 6, 2, 3):
        np.testing.assert_array_equal(frames.read(step), VALUES[step])
    assert max(computed.values()) == 3  # slabs 0-1, 2-3 and 4 of the first chunk


@pytest.mark.parametrize("dtype", ["f4", ">f8", "i2"])
@pytest.mark.parametrize("axes", [3, 4])
def test_a_series_of_dask_is_that_of_its_values(axes, dtype) -> None:
    values = VALUES.astype(dtype) if axes == 4 else VALUES[0].astype(dtype)
    series = array_series(dask.from_array(values, chunks=2))
    plain = ArraySeries(values)
    assert isinstance(series, DaskSeries)
    for name in ("shape", "dtype", "name", "units", "source", "attributes"):
        assert getattr(series, name) == getattr(plain, name)
    for step in range(plain.shape[0]):
        np.testing.assert_array_equal(series.read(step), plain.read(step))
        assert series.read(step).dtype == plain.read(step).dtype
    with pytest.raises(IndexError):
        series.read(plain.shape[0])


def test_lengths_that_are_not_known_are_refused() -> None:
    array = dask.from_array(VALUES, chunks=2)
    unknown = array[array[:, 0, 0, 0] > 30]
    with pytest.raises(InputError_lazy, match="compute_chunk_sizes"):
        LazyFrames(unknown)
    with pytest.raises(InputError_lazy, match="compute_chunk_sizes"):
        array_series(unknown)


VALUES_SELECTION = np.random.default_rng(0).random((3, 4, 5, 6))


def test_a_mask_replaces_all_and_joins_named_features() -> None:
    mask = VALUES_SELECTION[0] > 0.8
    series = ArraySeries(VALUES_SELECTION)
    alone = select_features(series, EncodeConfig(dilation=0), silent, mask)
    assert [str(feature) for feature in alone.features] == ["mask:array"]
    assert alone.extent.samples == 3 * mask.sum()
    config = EncodeConfig(dilation=0, features=("interval:0:0.1",))
    joined = select_features(series, config, silent, mask)
    assert [str(feature) for feature in joined.features] == ["mask:array", "interval:0:0.1"]
    assert joined.extent.samples == (mask | (VALUES_SELECTION <= 0.1)).sum()
    with pytest.raises(InputError, match="mask has shape"):
        select_features(series, EncodeConfig(), silent, mask[1:])


@pytest.mark.parametrize(
    ("dims", "shape"),
    [
        (("time", "lat", "lon"), (3, 1, 4, 5)),
        (("lev", "lat", "lon"), (1, 3, 4, 5)),
        (("lon", "lat", "time"), (5, 1, 4, 3)),
        (("a", "b", "c"), (1, 3, 4, 5)),
    ],
)
def test_the_axes_of_a_labelled_array_are_those_of_its_names(
    dims: tuple[str, ...], shape: tuple[int, ...]
) -> None:
    values = np.arange(60.0).reshape(3, 4, 5)
    coords = {dim: np.arange(float(n)) + 7 for dim, n in zip(dims, values.shape, strict=True)}
    labelled = xr.DataArray(values, dims=dims, coords=coords)
    with open_source(labelled) as series:
        assert series.shape == shape
        names = [series.coords[axis].name for axis in "tzyx"]
        assert set(dims) <= set(names)
        axis = "tzyx"[names.index(dims[0])]
        assert series.coords[axis].values.tolist() == [7, 8, 9]
        stored = np.stack(list(series.frames()))
    order = [dims.index(name) for name in names if name in dims]
    np.testing.assert_array_equal(stored, values.transpose(order).reshape(shape))


def test_a_labelled_array_of_members_is_refused_with_the_selection() -> None:
    labelled = xr.DataArray(np.zeros((2, 3, 4, 5)), dims=("member", "time", "lat", "lon"))
    with pytest.raises(InputError, match=r"array\.isel\(member=0\)"), open_source(labelled):
        pass
    with open_source(labelled.isel(member=0)) as series:
        assert series.shape == (3, 1, 4, 5)


def test_a_missing_time_is_replaced_by_the_steps() -> None:
    time = Coordinate(name="time", values=np.array([0, 1, np.nan]), attributes={"units": "s"})
    series = ArraySeries(np.zeros((3, 4, 5, 6)), coords={"t": time})
    told = pytest.warns(FhashWarning, match="time at step 2; step numbers stand")
    with told, open_source(series) as opened:
        assert opened.coords["t"].values.tolist() == [0, 1, 2]
