"""Shapes of chunks: bounded bytes, whole parts of tiles, small tiles joined."""

from __future__ import annotations

import asyncio
import json
import pickle
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr
from hypothesis import given
from hypothesis import strategies as st
from zarr.abc.store import OffsetByteRequest, RangeByteRequest, SuffixByteRequest
from zarr.core.buffer import default_buffer_prototype

import fhash_codec
from fhash_codec import EncodeConfig, InputError, Volume
from fhash_codec.views import store as store_module
from fhash_codec.views import view as chunking
from fhash_codec.views.arrays import (
    Level,
    ViewArray,
    arrays_beside,
    chunk_index,
    chunk_key,
    level_count,
    multiscale,
    positions_along,
    shown_axes,
)
from fhash_codec.views.store import DecodedStore
from fhash_codec.views.view import FEW_BYTES, MOST_BYTES, ZarrView, opened_view, view_chunks
from fhash_formats.errors import DamagedFileError, MissingInputError
from fhash_formats.series import ArraySeries, Coordinate

sides = st.tuples(st.integers(1, 99), *[st.integers(1, 700)] * 3)


@given(shape=sides, tile=sides, itemsize=st.sampled_from([1, 2, 4, 8]))
def test_chunks_are_bounded_and_within_the_array(
    shape: tuple[int, ...], tile: tuple[int, ...], itemsize: int
) -> None:
    chunk = view_chunks(shape, tile, itemsize)
    size = itemsize * prod(chunk)
    assert all(1 <= side <= length for side, length in zip(chunk, shape, strict=True))
    assert size <= MOST_BYTES
    few = 2 * size > FEW_BYTES
    assert few or all(
        side == length or itemsize * prod(chunk) // side * min(2 * side, length) > FEW_BYTES
        for side, length in zip(chunk, shape, strict=True)
    )


@given(
    tile=st.tuples(*[st.sampled_from([1, 2, 4, 8, 16, 32, 48])] * 4),
    tiles=st.tuples(*[st.integers(1, 6)] * 4),
)
def test_no_chunk_reaches_into_a_part_of_another_tile(
    tile: tuple[int, ...], tiles: tuple[int, ...]
) -> None:
    shape = tuple(n * m for n, m in zip(tile, tiles, strict=True))
    for side, n, length in zip(view_chunks(shape, tile, 4), tile, shape, strict=True):
        assert n % side == 0 or side % n == 0 or side == length or n == length


ViewOf = Callable[..., ZarrView]


@pytest.fixture
def view_of() -> Iterator[ViewOf]:
    """A function that opens a file with options; all files are closed at the end."""
    with ExitStack() as files:

        def make(path: Path, **options: Any) -> ZarrView:
            opened, view = opened_view(path, **options)
            files.callback(opened.close)
            return view

        yield make


def document(view: ZarrView, path: str) -> Any:
    data = view.get(f"{path}/zarr.json" if path else "zarr.json")
    assert data is not None
    return json.loads(data, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))


def encoded(path: Path, shape: tuple[int, ...] = (2, 3, 4, 5), **names: Any) -> Path:
    """A container of a small ramp; names: of the variable and of its axes t, z, y, x."""
    series = ArraySeries(np.arange(float(np.prod(shape))).reshape(shape), name=names["name"])
    series.coords = {
        axis: Coordinate(name=names.get(axis, axis), values=np.arange(n) * names.get("step", 1.0))
        for axis, n in zip("tzyx", shape, strict=True)
    }
    fhash_codec.encode(series, path, EncodeConfig(effort=1, max_error=0.0))
    return path


def test_the_root_document_holds_all_metadata(view_of: ViewOf, whole: Path) -> None:
    view = view_of(whole)
    root = document(view, "")
    assert (root["zarr_format"], root["node_type"]) == (3, "group")
    assert root["consolidated_metadata"]["kind"] == "inline"
    inside = root["consolidated_metadata"]["metadata"]
    for path, node in inside.items():
        alone = document(view, path)
        alone.pop("consolidated_metadata", None)
        assert alone == node
    arrays = {path for path, node in inside.items() if node["node_type"] == "array"}
    assert arrays == set(view.arrays)
    assert {"density", "time", "height", "lat", "lon", "lod/0/density", "lod/2/lat"} <= arrays
    assert "lod/3/density" not in arrays
    level = document(view, "lod/1")["consolidated_metadata"]["metadata"]
    assert set(level) == {"density", "time", "height", "lat", "lon"}


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize("kind", ["whole", "feature"])
def test_every_key_has_as_many_bytes_as_told(
    view_of: ViewOf, kind: str, request: pytest.FixtureRequest
) -> None:
    view = view_of(request.getfixturevalue(kind))
    keys = list(view.listing())
    assert len(keys) == len(set(keys))
    for key in keys:
        data = view.get(key)
        assert data is not None
        assert view.size(key) == len(data)
        assert view.is_document(key) == key.endswith("zarr.json")


@pytest.mark.parametrize(
    "key",
    [
        "", "/", "zarr.json/", "/zarr.json", "nope", "density", "density/", "density/c",
        "density/c/", "density/c/0", "density/c/0/0/0/99", "density/c/0/0/0/0/0",
        "density/c/00/0/0/0", "density/c/-1/0/0/0", "density/c/0/0/0/0/", "../density/c/0/0/0/0",
        "lod/9/density/zarr.json", "time/c/1", "c/0/0/0/0", ".zattrs", "density/.zarray",
    ],
)  # fmt: skip
def test_other_keys_are_not_there(view_of: ViewOf, whole: Path, key: str) -> None:
    view = view_of(whole)
    assert view.get(key) is None
    assert view.size(key) is None


@pytest.mark.usefixtures("apart")
def test_names_below_a_path(view_of: ViewOf, whole: Path) -> None:
    view = view_of(whole)
    assert set(view.children("")) == {"zarr.json", "density", "time", "height", "lat", "lon", "lod"}
    assert set(view.children("lod")) == {"zarr.json", "0", "1", "2"}
    assert set(view.children("density")) == {"zarr.json", "c"}
    grid = view.arrays["density"].grid
    assert list(view.children("density/c")) == [str(n) for n in range(grid[0])]
    assert list(view.children("density/c/1/0/0")) == [str(n) for n in range(grid[3])]
    assert list(view.children("nope")) == []
    assert set(view.listing("lod/1/lat")) == {"lod/1/lat/zarr.json", "lod/1/lat/c/0"}


@pytest.mark.parametrize(
    ("names", "arrays"),
    [
        ({"name": "lod", "t": "time"}, {"lod_2", "time", "z", "y", "x"}),
        ({"name": "a/b", "x": "lod"}, {"a_b", "t", "z", "y", "lod_2"}),
        ({"name": "x"}, {"x", "t", "z", "y", "x_2"}),
        ({"name": "a", "z": "n", "y": "n", "x": "n"}, {"a", "t", "n", "n_2", "n_3"}),
        ({"name": "zarr.json", "t": "../up"}, {"zarr_json", ".._up", "z", "y", "x"}),
        ({"name": "c", "t": "__t"}, {"c", "_t", "z", "y", "x"}),
    ],
)
def test_names_that_would_collide_are_changed(
    tmp_path: Path, names: dict[str, str], arrays: set[str]
) -> None:
    with fhash_codec.open(encoded(tmp_path / "a.fhz", **names)) as volume:
        view = ZarrView({volume.name: volume})
        assert {path for path in view.arrays if not path.startswith("lod/")} == arrays
        (name,) = view.names.values()
        dimensions = view.arrays[name].dimension_names
        assert len(set(dimensions)) == 4
        assert set(dimensions) == arrays - {name}
        got = b"".join(view.get(key) or b"" for key in view.listing(f"{name}/c/"))
        assert got == volume[...].tobytes()


class Several(Mapping[str, Volume]):
    """A stand-in for a file of several variables."""

    def __init__(self, volumes: dict[str, Volume]) -> None:
        self._volumes = volumes
        self.attributes = {"title": "two", "_FillValue": 3, "bad": float("nan")}

    def __getitem__(self, name: str) -> Volume:
        return self._volumes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._volumes)

    def __len__(self) -> int:
        return len(self._volumes)


def test_several_volumes_share_the_coordinates_that_are_equal(tmp_path: Path) -> None:
    first = fhash_codec.open(encoded(tmp_path / "u.fhz", name="u"))
    second = fhash_codec.open(encoded(tmp_path / "v.fhz", name="v", shape=(2, 3, 4, 6)))
    with first, second:
        view = ZarrView(Several({"u": first, "v": second}))
        assert view.arrays["u"].dimension_names == ("t", "z", "y", "x")
        assert view.arrays["v"].dimension_names == ("t", "z", "y", "x_2")
        assert view.arrays["x_2"].shape == (6,)
        root = document(view, "")
        assert root["attributes"] == {"title": "two", "bad": "NaN"}
        scales = document(view, "lod")["attributes"]["ome"]["multiscales"]
        assert [entry["name"] for entry in scales] == ["u", "v"]
        assert view.get("v/c/0/0/0/0") == second[...].tobytes()


def test_the_nodes_of_a_group_stand_together(whole: Path, feature: Path) -> None:
    # zarr-python loses those of consolidated metadata that do not
    with fhash_codec.open(whole) as first, fhash_codec.open(feature) as second:
        view = ZarrView({"u": first, "v": second})
        assert set(view.names.values()) == {"density", "density_2"}
        for group in ("", "lod"):
            inside = document(view, group)["consolidated_metadata"]["metadata"]
            by_depth = sorted(inside, key=lambda path: path.count("/"))
            parents = [path.rpartition("/")[0] for path in by_depth]
            runs = [
                name
                for name, before in zip(parents, [None, *parents], strict=False)
                if name != before
            ]
            assert len(runs) == len(set(runs))
        assert {"lod/2/density", "lod/1/density_2"} <= view.arrays.keys()


def test_attributes_of_the_file_may_be_arrays(view_of: ViewOf) -> None:
    golden = Path(__file__).resolve().parents[2] / "golden"
    attributes = document(view_of(golden / "compact-source.fhz"), "")["attributes"]
    assert attributes["title"] == "golden"
    assert attributes["range"][0] == pytest.approx(0.1)


VALUES = np.arange(35, dtype=np.int16).reshape(5, 7)


def view_array(values: np.ndarray = VALUES, **changes: Any) -> ViewArray:
    """An array in chunks of 2 x 4; the first two rows have no value."""
    settings: dict[str, Any] = {
        "shape": values.shape,
        "chunk_shape": (2, 4),
        "dtype": values.dtype,
        "dimension_names": ("y", "x"),
        "attributes": {"units": "m"},
        "fill": -1,
        "read": lambda region: values[region],
        "holds": lambda region: region[0].start >= 2,
    }
    return ViewArray(**{**settings, **changes})


def test_the_document_is_of_zarr_3() -> None:
    document = view_array().document()
    assert document["zarr_format"] == 3
    assert document["node_type"] == "array"
    assert document["shape"] == [5, 7]
    assert document["data_type"] == "int16"
    assert document["chunk_grid"]["configuration"] == {"chunk_shape": [2, 4]}
    assert document["fill_value"] == -1
    assert document["codecs"] == [{"name": "bytes", "configuration": {"endian": "little"}}]
    assert document["dimension_names"] == ["y", "x"]
    assert document["attributes"] == {"units": "m"}


def test_chunks_are_little_endian_and_full_at_the_ends() -> None:
    array = view_array()
    assert array.grid == (3, 2)
    assert array.chunk((1, 0)) == VALUES[2:4, :4].astype("<i2").tobytes()
    last = np.full((2, 4), -1, dtype="<i2")
    last[:1, :3] = VALUES[4:, 4:]
    assert array.chunk((2, 1)) == last.tobytes()
    assert len(array.chunk((2, 1))) == array.chunk_bytes == 16


def test_chunks_without_values_and_outside_the_grid_are_not_there() -> None:
    array = view_array()
    assert list(array.indices()) == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert not any(map(array.has, [(0, 0), (3, 0), (1, 2), (1,), (1, 0, 0), (-1, 0)]))


@pytest.mark.parametrize(
    ("text", "index"),
    [
        ("0", (0,)),
        ("10/0/3", (10, 0, 3)),
        ("", None),
        ("01", None),
        ("-1", None),
        ("1/", None),
        ("1//2", None),
        ("1.5", None),
        ("9" * 19, None),
        ("0/٣", None),
    ],
)
def test_keys_and_indices(text: str, index: tuple[int, ...] | None) -> None:
    assert chunk_index(text) == index
    if index is not None:
        assert chunk_key(index) == f"c/{text}"


TILE = (2, 5, 12, 11)
"""Vertices of the first tile of the container `whole`."""
GOLDEN = Path(__file__).resolve().parents[2] / "golden"


def region_of(level: Level) -> tuple[slice, ...]:
    return tuple(slice(0, n) for n in level.shape)


@pytest.mark.parametrize("kind", ["whole", "feature"])
@pytest.mark.parametrize("lod", [1, 2, 3])
def test_coarse_levels_are_those_of_the_box_and_empty_elsewhere(
    kind: str, lod: int, request: pytest.FixtureRequest
) -> None:
    with fhash_codec.open(request.getfixturevalue(kind)) as volume:
        level = Level(volume, lod)
        every = [range(n)[level.vertices(axis)] for axis, n in enumerate(volume.shape[1:])]
        assert level.shape == (volume.shape[0], *map(len, every))
        got = level.read(region_of(level))
        assert got.dtype == volume.dtype
        expected = np.full(level.shape, np.nan, dtype=np.float32)
        inside = [
            [place for place, vertex in enumerate(along) if vertex in vertices]
            for along, vertices in zip(every, volume.lod_vertices(lod), strict=True)
        ]
        for step in range(volume.shape[0]):
            expected[(step, *np.ix_(*inside))] = volume.read_lod(step, lod)
        assert np.isfinite(expected).any()
        assert got.tobytes() == expected.tobytes()
        assert level.holds(region_of(level))


@pytest.mark.parametrize(
    ("name", "count"),
    [("compact-labels", 2), ("compact-linear", 2), ("paper-sparse", 1)],
)
def test_levels_end_where_all_is_small(name: str, count: int) -> None:
    with fhash_codec.open(GOLDEN / f"{name}.fhz") as volume:
        assert level_count(volume) == count
        if count > 1:
            assert max(volume.read_lod(0, count - 1).shape) <= 16
            assert max(volume.read_lod(0, count - 2).shape) > 16


def test_a_tile_whose_chunks_are_asked_for_at_once_is_decoded_once(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunking, "MOST_BYTES", 100)
    monkeypatch.setattr(chunking, "FEW_BYTES", 0)

    def bytes_read(threads: int) -> int:
        with fhash_codec.open(whole) as volume, ThreadPoolExecutor(threads) as pool:
            array = ZarrView({"density": volume}).arrays["density"]
            assert array.chunk_bytes <= 100
            sides = array.chunk_shape
            indices = [
                index
                for index in array.indices()
                if all((i + 1) * n <= m for i, n, m in zip(index, sides, TILE, strict=True))
            ]
            assert len(indices) > 8
            list(pool.map(array.chunk, indices))
            return volume.container.bytes_read

    assert bytes_read(8) == bytes_read(1)


def test_levels_of_integers_far_from_zero_stay_in_their_range(tmp_path: Path) -> None:
    steps = np.arange(2 * 12 * 40 * 40, dtype=np.uint64).reshape(2, 12, 40, 40) // 97
    values = np.uint64(2**64 - 1) - steps
    config = fhash_codec.EncodeConfig(max_error=3.0, effort=1)
    fhash_codec.encode(values, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        for lod in range(level_count(volume)):
            level = Level(volume, lod)
            found = level.read(region_of(level))
            assert found.dtype == values.dtype
            assert found.min() >= values.min()
            near = values[:, :: level.stride, :: level.stride, :: level.stride]
            pair = [(each - values.min()).astype(float) for each in (found, near)]
            assert np.abs(pair[0] - pair[1]).max() < 60


NAMES = {"t": "time", "z": "height", "y": "lat", "x": "lon"}


def test_vertices_lead_to_positions_where_these_are_even(feature: Path) -> None:
    with fhash_codec.open(feature) as volume:
        levels = {f"{lod}/density": Level(volume, lod) for lod in range(3)}
        entry = multiscale("density", volume.coords, NAMES, levels)
        assert entry["name"] == "density"
        assert entry["axes"] == [
            {"name": "time", "type": "time", "unit": "hour"},
            {"name": "height", "type": "space", "unit": "meter"},
            {"name": "lat", "type": "space"},
            {"name": "lon", "type": "space"},
        ]
        assert [dataset["path"] for dataset in entry["datasets"]] == list(levels)
        for dataset, level in zip(entry["datasets"], levels.values(), strict=True):
            scale, translation = dataset["coordinateTransformations"]
            assert (scale["type"], translation["type"]) == ("scale", "translation")
            for axis, letter in ((1, "z"), (3, "x")):
                positions = volume.coords[letter].values[level.vertices(axis - 1)]
                got = translation["translation"][axis] + scale["scale"][axis] * np.arange(
                    positions.size
                )
                np.testing.assert_allclose(got, positions, rtol=1e-12)
            assert scale["scale"][0] == 6.0
            # latitudes descend: a scale must be positive, so that it counts vertices
            assert scale["scale"][2] == level.stride
            assert translation["translation"][2] == level.first[1]


SHAPE = (3, 20, 24)


def ocean() -> xr.Dataset:
    """Ice on a rotated grid (lat, lon, time), with bounds, 2-D positions and packed depths."""
    t, y, x = SHAPE
    values = np.sin(np.arange(y * x * t) / 90).reshape(y, x, t).astype(np.float32)
    data = xr.Dataset(
        {
            "ice": (("rlat", "rlon", "time"), values, {"units": "1", "grid_mapping": "rotated"}),
            "rotated": ((), np.int32(0), {"grid_mapping_name": "rotated_latitude_longitude"}),
            "time_bnds": (("time", "nv"), np.arange(6.0).reshape(3, 2)),
        },
        coords={
            "time": ("time", np.arange(3.0), {"units": "days since 2001-01-01"}),
            "rlat": ("rlat", np.arange(y, dtype=np.float32), {"units": "degrees"}),
            "rlon": ("rlon", np.arange(x, dtype=np.int32), {"units": "degrees"}),
            "depth": (("rlat", "rlon"), np.arange(y * x).reshape(y, x) * 0.5, {"units": "m"}),
        },
        attrs={"title": "ice of the year"},
    )
    data["time"].attrs["bounds"] = "time_bnds"
    data["depth"].encoding = {"dtype": "int16", "scale_factor": 0.5, "_FillValue": -1}
    return data


@pytest.fixture(scope="module")
def ice(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ice")
    ocean().to_netcdf(folder / "ice.nc", engine="h5netcdf")
    config = EncodeConfig(effort=1, max_error=1e-3)
    fhash_codec.encode(folder / "ice.nc", folder / "ice.fhz", config)
    return folder / "ice.fhz"


def test_a_dataset_has_what_the_source_has(ice: Path) -> None:
    source = xr.open_dataset(ice.with_name("ice.nc"), engine="h5netcdf", decode_coords="all")
    with source, fhash_codec.zarr_store(ice) as store:
        data = xr.open_zarr(store, decode_coords="all").load()
        assert set(data.variables) == set(source.variables)
        # the axis z was made up: it is not there, and the others are in the order of axes
        assert data["ice"].dims == ("time", "rlat", "rlon")
        assert data.attrs["title"] == "ice of the year"
        assert set(data["ice"].coords) == set(source["ice"].coords)
        for name in set(source.variables) - {"ice"}:
            assert data[name].dims == source[name].dims, name
            assert data[name].dtype == source[name].dtype, name
            np.testing.assert_array_equal(data[name], source[name], err_msg=name)
        np.testing.assert_allclose(data["ice"], source["ice"].transpose("time", ...), atol=1.001e-3)


def test_levels_have_it_at_their_vertices(ice: Path) -> None:
    with fhash_codec.zarr_store(ice) as store:
        fine, coarse = (xr.open_zarr(store, group=f"lod/{n}").load() for n in (0, 1))
        assert coarse["ice"].shape == (3, 10, 12)
        for name in ("depth", "rlat", "rlon"):
            np.testing.assert_array_equal(
                coarse[name], fine[name][tuple(slice(None, None, 2) for _ in fine[name].dims)]
            )
        np.testing.assert_array_equal(coarse["time_bnds"], fine["time_bnds"])


def test_variables_share_what_is_equal(ice: Path) -> None:
    with fhash_codec.open(ice) as first, fhash_codec.open(ice) as second:
        view = ZarrView({"first": first, "second": second})
        arrays = {path for path in view.arrays if not path.startswith("lod/")}
        assert arrays == {
            "ice", "ice_2", "time", "rlat", "rlon", "rotated", "time_bnds", "depth",
        }  # fmt: skip
        assert view.arrays["ice"].attributes == view.arrays["ice_2"].attributes
        assert view.arrays["time"].attributes["bounds"] == "time_bnds"
        assert view.arrays["ice"].attributes["grid_mapping"] == "rotated"


def test_arrays_of_other_lengths_are_left_out(ice: Path) -> None:
    dimensions = {"t": "time", "y": "rlat", "x": "rlon"}
    with fhash_codec.open(ice) as volume:
        level = Level(volume, 0)
        lengths = {"time": 3, "rlat": 20, "rlon": 24}
        names = {name for name, _ in arrays_beside(volume, level, dimensions, dict(lengths))}
        assert names == {"rotated", "time_bnds", "depth"}
        others = {**lengths, "nv": 4}
        names = {name for name, _ in arrays_beside(volume, level, dimensions, others)}
        assert names == {"rotated", "depth"}


def test_positions_have_the_type_of_the_source(ice: Path, whole: Path) -> None:
    with fhash_codec.open(ice) as volume:
        types = [positions_along(volume, axis).dtype.name for axis in "tzyx"]
        assert types == ["float64", "float64", "float32", "int32"]
    with fhash_codec.open(whole) as volume:
        assert positions_along(volume, "y") is volume.coords["y"].values
        assert shown_axes(volume) == (0, 1, 2, 3)
        assert list(arrays_beside(volume, Level(volume, 0), {}, {})) == []


NAMES_STORE = {
    "labels": GOLDEN / "compact-labels.fhz",
    "counts": GOLDEN / "compact-counts.fhz",
    "paper": GOLDEN / "paper-sparse.fhz",
    "plain": GOLDEN / "compact-plain-labels.fhz",
}


def run_of(kind: str, request: pytest.FixtureRequest) -> Path:
    return NAMES_STORE[kind] if kind in NAMES_STORE else request.getfixturevalue(kind)


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize("kind", ["whole", "feature", "gappy", *NAMES_STORE])
def test_zarr_reads_the_bits_of_the_volume(kind: str, request: pytest.FixtureRequest) -> None:
    path = run_of(kind, request)
    with fhash_codec.open(path) as volume, fhash_codec.zarr_store(path) as store:
        group = zarr.open_group(store, mode="r")
        array = group[volume.name]
        assert isinstance(array, zarr.Array)
        assert array.dtype == volume.dtype
        assert array[...].tobytes() == volume[...].tobytes()
        part = (slice(1, None), slice(2, 4), 3, slice(5, 9))
        assert np.asarray(array[part]).tobytes() == volume[part].tobytes()
        for axis, name in zip("tzyx", array.metadata.dimension_names, strict=True):
            np.testing.assert_array_equal(group[name][...], volume.coords[axis].values)


def test_a_store_travels_to_other_processes(whole: Path, tmp_path: Path) -> None:
    run = tmp_path / "run.fhz"
    run.write_bytes(whole.read_bytes())
    key = "density/c/0/0/0/0"
    with fhash_codec.zarr_store(run, fill=-5) as store:
        sent = pickle.dumps(store)
        assert len(sent) < 1000
        other, third = pickle.loads(sent), pickle.loads(sent)
        assert other == store
        assert hash(other) == hash(store)
        assert other.view.get(key) == store.view.get(key)
        # tasks of dask share the tiles that were decoded
        assert third.view is other.view
        assert other.view is not store.view
        other.close()
        assert third.view.get(key) == store.view.get(key)
        with fhash_codec.zarr_store(run) as different:
            assert different != store
    with pytest.raises(InputError, match="closed"):
        other.view.get(key)


def test_a_pickled_store_refuses_another_file(whole: Path, tmp_path: Path) -> None:
    run = tmp_path / "run.fhz"
    run.write_bytes(whole.read_bytes())
    with fhash_codec.zarr_store(run) as store:
        sent = pickle.dumps(store)
    fhash_codec.encode(np.zeros((1, 2, 3, 4)), run, EncodeConfig(effort=1), force=True)
    with pytest.raises(InputError, match="another one than when the store was pickled"):
        zarr.open_group(pickle.loads(sent), mode="r")


def test_few_files_stay_open(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module, "SHARED_FILES", 1)
    sent = []
    for name in ("a", "b"):
        path = tmp_path / f"{name}.fhz"
        path.write_bytes(whole.read_bytes())
        with fhash_codec.zarr_store(path) as store:
            sent.append(pickle.dumps(store))
    first, second = map(pickle.loads, sent)
    view = first.view
    assert second.view is not view
    assert first.view is view, "a store keeps its file while it lives"
    assert pickle.loads(sent[1]).view is second.view
    assert pickle.loads(sent[0]).view is not view


def test_parts_of_keys_and_sizes(whole: Path) -> None:
    prototype = default_buffer_prototype()

    async def read(store: DecodedStore) -> None:
        key = "density/c/0/0/0/0"
        buffer = await store.get(key, prototype)
        assert buffer is not None
        data = buffer.to_bytes()
        assert await store.getsize(key) == len(data)
        requests = [
            (key, RangeByteRequest(3, 9)),
            (key, OffsetByteRequest(5)),
            (key, SuffixByteRequest(7)),
            (key, SuffixByteRequest(10**9)),
            ("nope", None),
        ]
        parts = await store.get_partial_values(prototype, requests)
        got = [None if part is None else part.to_bytes() for part in parts]
        assert got == [data[3:9], data[5:], data[-7:], data, None]
        assert await store.exists(key)
        assert not await store.exists("density/c/9/9/9/9")
        assert not await store.is_empty("")
        assert [name async for name in store.list_dir("lod/1/")] == sorted(
            ["zarr.json", "density", "time", "height", "lat", "lon"]
        )
        assert [key async for key in store.list()] == list(store.view.listing())
        assert {key async for key in store.list_prefix("time/")} == {"time/zarr.json", "time/c/0"}
        with pytest.raises(FileNotFoundError):
            await store.getsize("nope")

    with fhash_codec.zarr_store(whole) as store:
        asyncio.run(read(store))


def test_nothing_can_be_written(whole: Path) -> None:
    before = whole.read_bytes()
    with fhash_codec.zarr_store(whole) as store:
        assert store.read_only
        assert not store.supports_writes
        assert not store.supports_deletes
        group = zarr.open_group(store, mode="r")
        with pytest.raises(ValueError, match="read-only"):
            group["density"][0] = 1
        with pytest.raises(ValueError, match="read-only"):
            zarr.open_group(store, mode="r+")
        with pytest.raises(ValueError, match="read-only"):
            asyncio.run(store.delete("zarr.json"))
        with pytest.raises(InputError, match="cannot be written"):
            store.with_read_only(False)
        assert store.with_read_only(True) is store
    assert whole.read_bytes() == before


@pytest.mark.usefixtures("apart")
def test_what_is_wrong_is_an_error_and_never_a_missing_chunk(damaged: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="no such file"):
        fhash_codec.zarr_store(tmp_path / "nope.fhz")
    with fhash_codec.zarr_store(damaged) as store:
        array = zarr.open_group(store, mode="r")["density"]
        with pytest.raises(DamagedFileError, match=r"damaged\.fhz"):
            array[...]
        assert np.isfinite(array[-1, -1, -1, -1])
    with pytest.raises(InputError, match="closed"):
        array[-1, -1, -1, -1]
