"""Labelled arrays keep their labels and all that belongs to them, and are read frame by frame."""

from __future__ import annotations

import functools
import http.server
import threading
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr

from fhash_codec import InputError
from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import (
    Everything,
    Extent,
    Feature,
    FeatureChoice,
    Interval,
    Isosurface,
    Mask,
    Segmentation,
    dilate,
    find_extent,
    otsu_threshold,
    parse_feature,
    resolve_features,
)
from fhash_codec.features.scan import scan
from fhash_codec.features.selection import (
    open_source,
    resolve_selection,
    select_features,
)
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import silent
from fhash_formats.errors import FhashWarning
from fhash_formats.readers import file_series
from fhash_formats.readers.labelled import array_series, labelled_series
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


def test_names_that_a_library_made_up_say_nothing(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["rho"], file["time"] = np.ones((3, 4, 5, 6)), np.array([1.0, 2, 4])
    with (
        open_series(tmp_path / "a.h5") as series,
        xr.open_dataset(tmp_path / "a.h5", engine="h5netcdf", phony_dims="sort") as data,
    ):
        for found in (series, labelled_series(data)):
            assert found.shape == (3, 4, 5, 6)
            assert found.coords["t"].values.tolist() == [1, 2, 4]


@pytest.mark.parametrize(
    ("dims", "attributes", "message"),
    [
        (("time", "cell"), {"CDI_grid_type": "unstructured"}, "7 places of a mesh .cell"),
        (("time", "face"), {"mesh": "m", "location": "face"}, "mesh .face"),
        (("time", "nCells"), {}, "mesh .nCells"),
        (("time", "lev", "site"), {}, "mesh .site"),
    ],
)
def test_a_mesh_is_no_grid(
    tmp_path: Path, dims: tuple[str, ...], attributes: dict[str, str], message: str
) -> None:
    shape = [{"time": 3, "lev": 2}.get(each, 7) for each in dims]
    data = xr.Dataset(
        {"u": (dims, np.ones(shape, "f4"), attributes)},
        {
            "lat": ("site", np.arange(7.0), {"units": "degrees_north"}),
            "lon": ("site", np.arange(7.0), {"units": "degrees_east"}),
        },
    )
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=message):
        open_series(tmp_path / "a.nc", var="u")
    with pytest.raises(InputError, match=message):
        labelled_series(data)
    axes = "t,x" if len(dims) == 2 else "t,z,x"
    with open_series(tmp_path / "a.nc", var="u", axes=axes) as series:
        assert series.shape[3] == 7


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
    with pytest.raises(InputError, match="no variable of 2"):
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
    frames = array_series(counted((steps, 2, 3, 4), computed))
    for step, frame in enumerate(VALUES):
        np.testing.assert_array_equal(frames.read(step), frame)
    assert set(computed.values()) == {1}


def test_a_large_chunk_is_computed_in_slabs(monkeypatch) -> None:
    monkeypatch.setattr(file_series, "SLAB_BYTES", 2 * VALUES[0].nbytes)
    computed: Counter = Counter()
    frames = array_series(counted((5, 2, 3, 4), computed))
    for step in (0, 1, 4, 6, 2, 3):
        np.testing.assert_array_equal(frames.read(step), VALUES[step])
    assert max(computed.values()) == 3  # slabs 0-1, 2-3 and 4 of the first chunk


@pytest.mark.parametrize("dtype", ["f4", ">f8", "i2"])
@pytest.mark.parametrize("axes", [3, 4])
def test_a_series_of_dask_is_that_of_its_values(axes, dtype) -> None:
    values = VALUES.astype(dtype) if axes == 4 else VALUES[0].astype(dtype)
    series = array_series(dask.from_array(values, chunks=2))
    plain = ArraySeries(values)
    assert series.lazy.shape == series.shape
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
    with pytest.raises(InputError, match="compute_chunk_sizes"):
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


VALUES_FEATURES = np.random.default_rng(0).random((4, 5, 6, 7))


def extent_of(values: np.ndarray, features: tuple[Feature, ...], dilation: int = 0) -> Extent:
    series = ArraySeries(values)
    choice = FeatureChoice((0, 1, 3), features, dilation)
    return find_extent(series, scan(series, silent), choice, silent)


def test_masks_are_the_selected_vertices_in_the_box_of_all_key_frames() -> None:
    values = VALUES_FEATURES.copy()
    values[:, :, 0], values[:, 4], values[0, 2, 3, 4] = 0, 0, np.nan
    extent = extent_of(values, (Interval(0.9, 1.0), Interval(0.5, 0.52)))
    selected = (values >= 0.9) | ((values >= 0.5) & (values <= 0.52))
    masks = np.stack([extent.mask(key) for key in range(3)])
    np.testing.assert_array_equal(masks, selected[[0, 1, 3]][:, *extent.box.slices()])
    assert extent.samples == masks.sum() == selected[[0, 1, 3]].sum()
    assert extent.fraction == pytest.approx(selected[[0, 1, 3]].mean())
    outside = values[[0, 1, 3]][~selected[[0, 1, 3]]]
    assert extent.background == pytest.approx(np.nanmean(outside), rel=1e-12)


def test_the_fringe_is_what_only_a_neighbouring_key_frame_has() -> None:
    extent = extent_of(VALUES_FEATURES, (Interval(0.7, 1.0),))
    masks = [extent.mask(key) for key in range(3)]
    grown = [extent.with_fringe(key) for key in range(3)]
    np.testing.assert_array_equal(grown[0], masks[0] | masks[1])
    np.testing.assert_array_equal(grown[1], masks[0] | masks[1] | masks[2])
    np.testing.assert_array_equal(grown[2], masks[1] | masks[2])
    assert extent.samples_with_fringe() == sum(mask.sum() for mask in grown)


def test_features_are_kept_apart_where_asked_and_make_up_the_whole() -> None:
    values = VALUES_FEATURES.copy()
    values[0, 2, 3, 4] = np.nan
    features = (Interval(0.9, 1.0), Everything(), Interval(0.0, 0.1))
    series = ArraySeries(values)
    choice = FeatureChoice((0, 1, 3), features, 1)
    extent = find_extent(series, scan(series, silent), choice, silent, apart=True)
    for key in range(3):
        masks = [extent.mask_of(number, key) for number in range(3)]
        np.testing.assert_array_equal(np.logical_or.reduce(masks), extent.mask(key))
        assert masks[0].sum() < masks[1].sum()
    assert extent_of(values, features).apart == ()


SHAPES = [(1, 1, 1), (1, 5, 6), (4, 1, 5), (3, 4, 1), (5, 6, 7)]


def random_frame(shape, dtype=np.float32, seed=0):
    return (np.random.default_rng(seed).random(shape) * 10).astype(dtype)


@pytest.mark.parametrize(
    ("text", "feature"),
    [
        ("all", Everything()),
        ("interval:0.25:1", Interval(0.25, 1.0)),
        ("interval:-1e-30:1e+30", Interval(-1e-30, 1e30)),
        ("interval:-inf:-5", Interval(-np.inf, -5.0)),
        ("interval:2:2", Interval(2.0, 2.0)),
        ("isosurface:-3.5", Isosurface(-3.5)),
        ("segmentation", Segmentation()),
        ("segmentation:7", Segmentation(7.0)),
        ("mask:a:b/c.h5", Mask("a:b/c.h5")),
    ],
)
def test_text_and_feature_name_each_other(text, feature) -> None:
    assert parse_feature(text) == feature
    assert str(feature) == text
    assert parse_feature(str(feature)) == feature


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("intervall:1:2", "not known; allowed: interval:LO:HI, isosurface:V, segmentation"),
        ("", "not known"),
        ("all:1", "not known"),
        ("mask:", "not known"),
        ("mask", "not known"),
        ("interval", "malformed; write interval:LO:HI with LO <= HI"),
        ("interval:1", "malformed"),
        ("interval:1:2:3", "malformed"),
        ("interval:a:b", "malformed"),
        ("interval:nan:1", "malformed"),
        ("interval:2:1", "write interval:LO:HI with LO <= HI"),
        ("isosurface:", "malformed; write isosurface:V"),
        ("isosurface:inf", "malformed"),
        ("isosurface:1:2", "malformed"),
        ("segmentation:", "malformed; write segmentation or segmentation:T"),
        ("segmentation:x", "malformed"),
    ],
)
def test_malformed_text_is_refused_in_one_line(text, message) -> None:
    with pytest.raises(InputError, match=message) as caught:
        parse_feature(text)
    assert "\n" not in str(caught.value)


def brute_force_isosurface(frame, value):
    selected = frame == value
    for vertex in np.ndindex(frame.shape):
        for axis in range(3):
            other = tuple(v + (a == axis) for a, v in enumerate(vertex))
            if other[axis] < frame.shape[axis]:
                ends = sorted([frame[vertex], frame[other]])
                if np.isfinite(ends).all() and ends[0] < value < ends[1]:
                    selected[vertex] = selected[other] = True
    return selected


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16, np.uint8])
@pytest.mark.parametrize("value", [5.0, 3.3, -1.0])
def test_isosurface_takes_both_ends_of_every_crossed_edge(shape, dtype, value) -> None:
    frame = random_frame(shape, dtype)
    np.testing.assert_array_equal(
        Isosurface(value).select(frame, 0), brute_force_isosurface(frame, value)
    )


def test_features_that_are_not_ready_say_so() -> None:
    frame = np.zeros((1, 1, 1))
    for feature in (Segmentation(), Mask("m")):
        with pytest.raises(InputError, match="resolve_features"):
            feature.select(frame, 0)
    with pytest.raises(InputError, match=r"shape \(1, 2, 1\)"):
        Mask("m", lambda step: np.ones((1, 2, 1), bool)).select(frame, 0)


def brute_force_dilation(mask, vertices):
    grown = np.zeros_like(mask)
    for vertex in np.argwhere(mask):
        grown[tuple(slice(max(v - vertices, 0), v + vertices + 1) for v in vertex)] = True
    return grown


@pytest.mark.parametrize("shape", [*SHAPES, (9, 2, 20)])
@pytest.mark.parametrize("vertices", [0, 1, 2, 3, 5, 64])
@pytest.mark.parametrize("density", [0.0, 0.02, 0.3])
def test_dilation_is_the_26_neighbourhood_without_wrap_around(shape, vertices, density) -> None:
    mask = np.random.default_rng(vertices).random(shape) < density
    before = mask.copy()
    np.testing.assert_array_equal(dilate(mask, vertices), brute_force_dilation(mask, vertices))
    np.testing.assert_array_equal(mask, before)


def brute_force_otsu(counts, edges):
    """The variance of every split of the repeated bin numbers; the middle of the best ones."""
    numbers = np.repeat(np.arange(len(counts)), counts)
    scores = []
    for split in range(1, len(counts)):
        low, high = numbers[numbers < split], numbers[numbers >= split]
        scores.append(
            low.size * high.size * (low.mean() - high.mean()) ** 2
            if low.size and high.size
            else 0.0
        )
    best = np.flatnonzero(np.isclose(scores, max(scores), rtol=1e-12))
    return edges[best[best.size // 2] + 1]


@pytest.mark.parametrize("seed", range(8))
def test_otsu_against_every_split(seed) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 30, size=12) * (rng.random(12) < 0.7)
    edges = np.linspace(-3, 5, 13)
    assert otsu_threshold(counts, edges) == pytest.approx(brute_force_otsu(counts, edges))


def test_the_file_of_a_mask_is_opened(tmp_path: Path) -> None:
    marked = np.random.default_rng(0).random((2, 3, 4, 5)) < 0.5
    np.save(tmp_path / "m.npy", marked)
    series, text = ArraySeries(np.ones(marked.shape)), f"mask:{tmp_path / 'm.npy'}"
    (feature,) = resolve_features([text], series, (0, 1), ValueRange(0.0, 1.0), silent)
    for step in (0, 1):
        np.testing.assert_array_equal(feature.select(series.read(step), step), marked[step])


def happening(text: str, values: np.ndarray, key_frames: tuple[int, ...]) -> np.ndarray:
    """Masks (key frames, z, y, x) of a feature in time."""
    series = ArraySeries(values)
    (feature,) = resolve_features([text], series, key_frames, ValueRange(0.0, 1.0), silent)
    assert str(feature) == str(parse_feature(text))
    return np.stack([feature.select(series.read(step), step) for step in key_frames])


@pytest.mark.parametrize("dtype", [np.float32, np.uint8, np.int64])
def test_a_change_is_at_both_its_ends_and_above_the_threshold(dtype) -> None:
    values = np.full((5, 1, 1, 3), 100, dtype)
    values[2:, 0, 0, 1], values[3:, 0, 0, 2] = 90, 89  # by 10, and by 11
    masks = happening("change:10", values, (0, 1, 2, 3, 4))
    assert not masks[..., :2].any()
    np.testing.assert_array_equal(masks[:, 0, 0, 2], [False, False, True, True, False])


def test_what_happens_between_key_frames_is_in_both_of_them() -> None:
    values = np.zeros((9, 1, 1, 3), np.float32)
    values[4, 0, 0, 1] = 1.0  # a flash that no key frame sees
    values[8, 0, 0, 2] = 1.0
    masks = happening("change:0.5", values, (1, 3, 6))
    np.testing.assert_array_equal(masks[:, 0, 0, 1], [False, True, True])
    np.testing.assert_array_equal(masks[:, 0, 0, 2], [False, False, True])


def test_missing_values_neither_change_nor_rise() -> None:
    values = np.zeros((3, 1, 1, 3), np.float32)
    values[1, 0, 0, :2] = np.nan, np.inf
    values[2, 0, 0, 2] = 1.0
    for text in ("change:0.1", "onset:0.1"):
        masks = happening(text, values, (0, 1, 2))
        np.testing.assert_array_equal(masks.any(axis=0)[0, 0], [False, False, True])


@pytest.mark.parametrize("text", ["change", "change:-1", "change:nan", "onset", "onset:inf"])
def test_malformed_features_in_time_are_refused(text) -> None:
    with pytest.raises(InputError, match="is malformed"):
        parse_feature(text)
    with pytest.raises(InputError, match="looks at other steps"):
        parse_feature("onset:1").select(np.zeros((1, 1, 1)), 0)


def test_auto_looks_at_the_vertices_of_the_feature_alone() -> None:
    """Outside the feature the steps jump at 2; within it at 5."""
    values = np.zeros((9, 6, 8, 10), np.float32)
    values[2:] += 0.5 * np.random.default_rng(0).random((6, 8, 10)).astype(np.float32)
    values[:, 2:4, 2:4, 2:4] = 2.0
    values[5:, 2:4, 2:4, 2:4] = 3.0
    series = ArraySeries(values)
    keys = {}
    for features in (("all",), ("interval:1:9",)):
        config = EncodeConfig(
            preset="published", tables="float16", key_frames="auto:4", features=features
        )
        keys[features] = resolve_selection(series, config, silent, None)[1]
    assert {1, 2} < set(keys["all",])
    assert {4, 5} < set(keys["interval:1:9",])
