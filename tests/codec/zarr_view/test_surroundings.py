"""Arrays beside the values: what the source has along with a variable is in the hierarchy too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.zarr_view.levels import Level
from fhash_codec.zarr_view.surroundings import (
    arrays_beside,
    naming_attributes,
    positions_along,
    shown_axes,
)
from fhash_codec.zarr_view.view import ZarrView

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


def test_values_have_the_bits_of_the_volume_without_the_axis(ice: Path) -> None:
    with fhash_codec.open(ice) as volume, fhash_codec.zarr_store(ice) as store:
        assert shown_axes(volume) == (0, 2, 3)
        array = zarr.open_group(store, mode="r")["ice"]
        assert array[...].tobytes() == volume[...].tobytes()
        assert array[1:, 3, 4:9].tobytes() == volume[1:, 0, 3, 4:9].tobytes()
        scalar = zarr.open_group(store, mode="r")["rotated"]
        assert (scalar.shape, int(scalar[()])) == ((), 0)
        assert store.view.size("rotated/c") == 4
        assert store.view.get("rotated/c/0") is None
        assert set(store.view.listing("rotated/")) == {"rotated/zarr.json", "rotated/c"}


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


def test_an_image_of_two_axes_in_space_is_a_multiscale_image(ice: Path) -> None:
    with fhash_codec.zarr_store(ice) as store:
        (entry,) = zarr.open_group(store, mode="r", path="lod").attrs["ome"]["multiscales"]
        assert [axis["name"] for axis in entry["axes"]] == ["time", "rlat", "rlon"]
        scale = entry["datasets"][1]["coordinateTransformations"][0]["scale"]
        assert scale == [1.0, 2.0, 2.0]


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


@pytest.mark.parametrize(
    ("raw", "kept"),
    [
        ({"coordinates": "a b", "units": "m"}, {"coordinates": "a b"}),
        ({"coordinates": "a gone"}, {"coordinates": "a"}),
        ({"coordinates": "gone"}, {}),
        ({"grid_mapping": "gone", "bounds": "b"}, {"bounds": "b"}),
        ({"cell_measures": "area: a volume: gone"}, {}),
        ({"bounds": 3}, {}),
    ],
)
def test_attributes_name_what_is_there(raw: dict[str, object], kept: dict[str, str]) -> None:
    assert naming_attributes(raw, {"a", "b"}) == kept
