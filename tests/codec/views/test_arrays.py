"""Arrays of a view: their documents, the bytes of their chunks, and chunks that are left out."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import fhash_codec
from fhash_codec import EncodeConfig
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
from fhash_codec.views.view import ZarrView

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
