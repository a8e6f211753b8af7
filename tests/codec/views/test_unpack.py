"""`unpack`: the chunks of a store are the tiles of a container, in the dimensions of its source."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from coded_stores import dataset, shown, without_provenance, write

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec import InputError as InputError_unpack
from fhash_codec.views.unpack import ChunkTable
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries

pytestmark = pytest.mark.filterwarnings("ignore:.*Zarr format 3 specification")


@pytest.mark.parametrize(
    ("dimensions", "chunk", "axes"),
    [
        (("time", "level", "lat", "lon"), (2, 3, 4, 4), None),
        (("time", "lat", "lon"), (2, 4, 4), None),
        (("lon", "time", "lat"), (4, 2, 4), None),
        (("lat", "lon", "level", "time"), (4, 4, 3, 2), None),
    ],
)
def test_chunks_have_the_dimensions_of_the_source(
    tmp_path: Path, dimensions: tuple[str, ...], chunk: tuple[int, ...], axes: list[str] | None
) -> None:
    lengths = {"time": 2, "level": 3, "lat": 4, "lon": 4}
    run = tmp_path / "run.fhz"
    store = write(tmp_path, dataset(dimensions), dask={name: lengths[name] for name in dimensions})
    fhash_codec.pack(store, run)
    with fhash_codec.open(run) as volume:
        table = ChunkTable(volume)
        assert tuple(table.outline.dimensions) == dimensions
        assert table.chunk == chunk
        assert table.shard is not None
        # What the codec of the store took for z, y, x is so again.
        assert table.codec.axes is axes
        assert table.codec.reading
        assert len(table.stream([0] * len(dimensions))) > 10
        assert table.fill is None


def test_a_made_up_axis_is_left_out_and_the_codec_says_so(tmp_path: Path) -> None:
    data = dataset(("time", "lat", "lon"))
    data.to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    run = tmp_path / "run.fhz"
    config = fhash_codec.EncodeConfig(max_error=0.1, effort=1, tile="2x1x4x4")
    fhash_codec.encode(tmp_path / "run.nc", run, config)
    with fhash_codec.open(run) as volume:
        table = ChunkTable(volume)
        assert table.chunk == (2, 4, 4)
        assert table.codec.axes == ("t", "y", "x")


def test_a_feature_is_refused(tmp_path: Path) -> None:
    run, values = tmp_path / "run.fhz", dataset().u.values
    mask = np.zeros(values.shape, bool)
    mask[:, 1:4, 2:5, 2:5] = True
    config = fhash_codec.EncodeConfig(max_error=0.1, effort=1, dilation=0)
    fhash_codec.encode(ArraySeries(values), run, config, mask=mask)
    with fhash_codec.open(run) as volume, pytest.raises(InputError, match="a part of its domain"):
        ChunkTable(volume)


def encoded(folder: Path, data: xr.Dataset, **settings: object) -> Path:
    data.to_netcdf(folder / "run.nc", engine="h5netcdf")
    run = folder / "run.fhz"
    told = {"max_error": 0.02, "effort": 1, **settings}
    config = EncodeConfig.from_dict(
        {key: value for key, value in told.items() if value is not None}
    )
    fhash_codec.encode(folder / "run.nc", run, config)
    return run


def check(run: Path) -> Path:
    """Unpack a container and pack it again; what xarray shows is the same each time."""
    store, again = run.with_name("unpacked.zarr"), run.with_name("again.fhz")
    fhash_codec.unpack(run, store)
    expected = shown(run)
    for found in (shown(store), (fhash_codec.pack(store, again), shown(again))[1]):
        xr.testing.assert_identical(without_provenance(found), without_provenance(expected))
    with fhash_codec.open(again) as opened:
        opened.verify()
    return store


def with_gaps() -> xr.Dataset:
    data = dataset()
    data["u"] = data.u.where((data.lat - 45) ** 2 + (data.lon - 10) ** 2 < 40).transpose(
        *data.u.dims
    )
    return data


CASES = {
    "one tile": (dataset, {}),
    "many tiles": (dataset, {"tile": "2x3x4x4"}),
    "a psnr": (dataset, {"max_error": None, "psnr": 50.0, "effort": 2}),
    "without z": (lambda: dataset(("time", "lat", "lon")), {"tile": "2x1x4x4"}),
    "another order": (lambda: dataset(("lon", "level", "time", "lat")), {"tile": "2x3x4x4"}),
    "float64": (lambda: dataset(dtype="f8"), {}),
    "integers": (lambda: dataset(dtype="i4"), {"max_error": 0}),
    "missing values": (with_gaps, {"tile": "2x3x4x4"}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_store_shows_what_the_container_shows(tmp_path: Path, case: str) -> None:
    make, settings = CASES[case]
    check(encoded(tmp_path, make(), **settings))


def test_a_head_comes_along(tmp_path: Path) -> None:
    golden = Path(__file__).parents[2] / "golden" / "compact-head.fhz"
    run = tmp_path / "run.fhz"
    run.write_bytes(golden.read_bytes())
    store, again = tmp_path / "unpacked.zarr", tmp_path / "again.fhz"
    fhash_codec.unpack(run, store)
    fhash_codec.pack(store, again)
    with fhash_codec.open(run) as one, fhash_codec.open(again) as other:
        assert other.mlp.parameters == one.mlp.parameters > 0
        np.testing.assert_array_equal(other[...], one[...])
        array = zarr.open_group(store, mode="r")["density"]
        np.testing.assert_array_equal(array[...], one[...])


@pytest.mark.parametrize("dimensions", [("time", "lat", "lon"), ("lat", "time", "lon", "level")])
def test_what_was_packed_is_unpacked_to_the_same_chunks(
    tmp_path: Path, dimensions: tuple[str, ...]
) -> None:
    store = write(
        tmp_path, dataset(dimensions), dask=dict.fromkeys(dimensions, 4), compressors=None
    )
    run = tmp_path / "run.fhz"
    fhash_codec.pack(store, run)
    check(run)
    with fhash_codec.open(run) as volume:
        assert volume.container.arrays["tables/level_1"].axes is not None


def test_fill_values_come_back(tmp_path: Path) -> None:
    data = with_gaps()
    store = write(tmp_path, data.round(), max_error=0, dtype="i2", _FillValue=np.int16(-7))
    run = tmp_path / "run.fhz"
    fhash_codec.pack(store, run)
    found = zarr.open_group(check(run), mode="r")["u"]
    assert found.attrs["_FillValue"] == -7
    assert found.dtype == np.int16


def test_several_variables_come_into_one_store(tmp_path: Path) -> None:
    data = dataset()
    data["v"] = data.u * 2
    data["w"] = data.u.isel(level=0, drop=True)
    run = tmp_path / "run.fhz"
    fhash_codec.pack(write(tmp_path, data, coded=("u", "v", "w")), run)
    check(run)
    report = fhash_codec.unpack(run, tmp_path / "one.zarr", variables=["w"])
    assert list(report["variables"]) == ["w"]
    assert list(shown(tmp_path / "one.zarr").data_vars) == ["crs", "w"]
    with pytest.raises(InputError_unpack, match="no variable 'x'"):
        fhash_codec.unpack(run, tmp_path / "two.zarr", variables=["x"])


def test_the_profile_paper_is_refused(tmp_path: Path) -> None:
    golden = Path(__file__).parents[2] / "golden" / "paper-plain.fhz"
    with pytest.raises(InputError_unpack, match=r"the profile paper.*fhash decode .* -o OUT\.zarr"):
        fhash_codec.unpack(golden, tmp_path / "out.zarr")
    assert not (tmp_path / "out.zarr").exists()


def test_plain_files_and_integers_with_gaps_are_refused(tmp_path: Path) -> None:
    golden = Path(__file__).parents[2] / "golden"
    for name, what in (
        ("compact-plain-head", "tables of plain numbers"),
        ("compact-counts", "integers of which some have no value"),
    ):
        with pytest.raises(InputError_unpack, match=what):
            fhash_codec.unpack(golden / f"{name}.fhz", tmp_path / "out.zarr")
