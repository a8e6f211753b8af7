"""`pack`: a container of a Zarr store has the values that zarr decodes from it, bit by bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr
from coded_stores import CHUNKS, SHAPE, dataset, shown, smooth, without_provenance, write
from rarely import rarely
from zarr.codecs import Crc32cCodec, TransposeCodec

import fhash_codec
from fhash_codec import (
    DamagedFileError,
    EncodeConfig,
    FhashWarning,
    InputError,
    OutputExistsError,
)
from fhash_codec.header import full_header
from fhash_codec.views import pack as module
from fhash_codec.views.pack import Tiles
from fhash_codec.views.unpack import ChunkTable
from fhash_formats.readers.file_series import Request
from fhash_formats.readers.zarr_coded import open_coded
from fhash_formats.series import ArraySeries
from fhash_formats.transform.tile import decode_chunk
from fhash_formats.transform.zarr_codec import TransformCodec

pytestmark = pytest.mark.filterwarnings("ignore:.*Zarr format 3 specification")


@pytest.mark.parametrize(
    ("most", "together"),
    [
        pytest.param(1 << 30, (3, 2, 3, 3), marks=pytest.mark.every),
        (2 * 18 * 384, (2, 2, 3, 3)),
        pytest.param(18 * 384, (1, 2, 3, 3), marks=pytest.mark.every),
        (9 * 384, (1, 1, 3, 3)),
        pytest.param(4 * 384, (1, 1, 1, 3), marks=pytest.mark.every),
        pytest.param(1, (1, 1, 1, 1), marks=pytest.mark.every),
    ],
)
def test_members_are_of_a_bounded_size_and_keep_steps_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, together: tuple[int, ...]
) -> None:
    monkeypatch.setattr(module, "TOGETHER_BYTES", most)
    with open_coded(write(tmp_path, dataset()), Request()) as (series, array):
        found = Tiles(array, series.source)
        assert found.metadata.together == together
        told: list[int] = []
        streams = list(found.streams(told.append))
        assert told == list(range(1, 55))
        assert len(streams) == len(found) == 54
        values = decode_chunk(streams[0], (2, 3, 4, 4), np.float32)
        assert np.array_equal(values, array.values((0, 0, 0, 0)))
        found.check_against_store()
        whole = np.stack(list(series.frames()))
    facts = found.facts
    assert (facts.low, facts.high) == (whole.min(), whole.max())
    assert facts.mean.count == whole.size == facts.occupied
    assert facts.mean.value() == pytest.approx(whole.mean(dtype=np.float64), rel=1e-6)
    assert facts.bytes == sum(map(len, streams))
    assert not facts.missing


@pytest.mark.parametrize("most", [1 << 30, 4 * 384])
def test_missing_vertices_are_kept_step_by_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    monkeypatch.setattr(module, "TOGETHER_BYTES", most)
    data = dataset()
    gaps = np.zeros(SHAPE, bool)
    gaps[1, 2, 3:7] = gaps[4, 5] = True
    data["u"] = data.u.where(~gaps)
    with open_coded(write(tmp_path, data), Request()) as (series, array):
        found = Tiles(array, series.source)
        assert len(list(found.streams(lambda _: None))) == 54
    assert sorted(found.facts.missing) == [1, 4]
    for step, bits in found.facts.missing.items():
        assert np.array_equal(np.unpackbits(bits, count=540).reshape(SHAPE[1:]), gaps[step])


def test_a_tile_in_a_wrong_place_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_coded(write(tmp_path, dataset()), Request()) as (series, array):
        stream = array.stream
        monkeypatch.setattr(array, "stream", lambda index: stream((1, *index[1:])))
        with pytest.raises(RuntimeError, match="other values"):
            Tiles(array, series.source).check_against_store()


def test_lacking_chunks_are_filled_on_request(tmp_path: Path) -> None:
    store = write(tmp_path, dataset(dtype="i4"), max_error=1)
    (store / "u" / "c" / "2" / "1" / "2" / "2").unlink()
    with open_coded(store, Request()) as (series, array):
        with pytest.raises(InputError, match="lacks chunk"):
            list(Tiles(array, series.source).streams(lambda _: None))
        found = Tiles(array, series.source, fill_absent=True)
        *_, last = found.streams(lambda _: None)
    assert found.facts.absent == 1
    assert not decode_chunk(last, (2, 3, 4, 4), np.int32).any()


def check(store: Path, *names: str, **options: Any) -> fhash_codec.Volume | None:
    """Pack a store, and compare what xarray shows of both."""
    run = store.with_suffix(".fhz")
    report = fhash_codec.pack(store, run, force=True, **options)
    expected, found = shown(store), shown(run)
    for name in names or ("u",):
        np.testing.assert_array_equal(found[name].values, expected[name].values)
    xr.testing.assert_identical(without_provenance(found), without_provenance(expected))
    assert report["bytes"] == run.stat().st_size
    assert set(report["variables"]) == set(names or ("u",))
    with fhash_codec.open(run) as opened:
        opened.verify()
    return None


@pytest.mark.parametrize(
    "encoding",
    [
        {},
        {"chunks": (2, 3, 4, 4), "shards": (4, 6, 8, 8), "compressors": None},
        *rarely(
            {"compressors": None},
            {"compressors": [Crc32cCodec()]},
            {"filters": [TransposeCodec(order=(3, 1, 0, 2))]},
        ),
    ],
    ids=str,
)
def test_a_store_of_dask_becomes_a_container(tmp_path: Path, encoding: dict[str, Any]) -> None:
    chunks = dict(zip(CHUNKS, encoding.get("shards", CHUNKS.values()), strict=True))
    check(write(tmp_path, dataset(), dask=chunks, **encoding))


@pytest.mark.parametrize("dtype", ["f2", "i8", *rarely("f8", "i1", "u2", "i4", "u8")])
def test_all_number_types_are_taken(tmp_path: Path, dtype: str) -> None:
    check(write(tmp_path, dataset(dtype=dtype), max_error=1 if dtype[0] != "f" else 0.1))


def test_missing_values_are_missing(tmp_path: Path) -> None:
    data = dataset()
    data["u"] = data.u.where((data.lat - 45) ** 2 + (data.lon - 10) ** 2 < 24).transpose(
        *data.u.dims
    )
    store = write(tmp_path, data)
    # dask writes no chunk that has nothing but missing values
    with pytest.warns(FhashWarning, match="18 of 54"):
        check(store)
    with fhash_codec.open(store.with_suffix(".fhz")) as volume:
        assert np.isnan(volume.sample(t=0, z=0, y=0.2, x=0.2))
        assert not volume.occupancy(0)[0, 0, 0]
        assert volume.info["value_range"] == [np.nanmin(volume[...]), np.nanmax(volume[...])]
    fhash_codec.export_plain(store.with_suffix(".fhz"), tmp_path / "plain.fhz")
    with fhash_codec.open(tmp_path / "plain.fhz") as plain:
        np.testing.assert_array_max_ulp(plain[...], shown(store).u.values)  # tiles have corrections


@pytest.mark.parametrize(
    ("dtype", "fill", "max_error"), [("f4", np.float32(1e20), 0.01), ("i2", np.int16(-999), 0)]
)
def test_fill_values_are_missing(tmp_path: Path, dtype: str, fill: Any, max_error: float) -> None:
    data = dataset()
    data["u"] = data.u.round().where(data.lon > 8).transpose(*data.u.dims)
    store = write(tmp_path, data, max_error=max_error, dtype=dtype, _FillValue=fill)
    check(store)
    with fhash_codec.open(store.with_suffix(".fhz")) as volume:
        assert volume.info["value_range"][1] < 200
        assert volume.dtype == dtype
        assert volume[0, 0, 0, 0] == fill or np.isnan(volume[0, 0, 0, 0])


def test_several_variables_share_a_file(tmp_path: Path) -> None:
    data = dataset()
    data["v"] = data.u * 2
    data["w"] = data.u.isel(level=0, drop=True)
    store = write(tmp_path, data, coded=("u", "v", "w"))
    check(store, "u", "v", "w")
    report = fhash_codec.pack(store, tmp_path / "part.fhz", variables=["w", "u"])
    assert list(report["variables"]) == ["w", "u"]


def test_an_index_is_selected_along_an_ensemble(tmp_path: Path) -> None:
    data = dataset(("member", "time", "level", "lat", "lon"))
    store = write(tmp_path, data, dask={"member": 1, **CHUNKS})
    run = tmp_path / "run.fhz"
    with pytest.raises(InputError, match="--select member=0"):
        fhash_codec.pack(store, run)
    fhash_codec.pack(store, run, select={"member": 2})
    np.testing.assert_array_equal(shown(run).u.values, shown(store).u.values[2])


def test_figures_that_nobody_measured_are_not_in_the_file(tmp_path: Path) -> None:
    run = tmp_path / "run.fhz"
    report = fhash_codec.pack(write(tmp_path, dataset(), max_error=0.5), run)
    assert report["variables"]["u"]["codec"] == {"max_error": 0.5}
    with fhash_codec.open(run) as volume:
        header = full_header(volume.container.header, volume.container.arrays)
        assert not {"psnr", "rmse", "max_abs_error", "ssim"} & header["quality"].keys()
        assert volume.config["max_error"] == 0.5
        assert header["encoder"]["codec"] == {"max_error": 0.5}
        assert volume.metadata is not None
        assert volume.metadata.attributes["history"].endswith("fhash pack run.zarr")
        assert np.abs(volume[...] - smooth(SHAPE)).max() <= 0.5
    measured = fhash_codec.diff(smooth(SHAPE), run)
    assert 0 < measured["max_abs_error"] <= 0.5
    with fhash_codec.open(run) as volume:
        fhash_codec.render(volume)


def test_chunks_that_are_missing_are_told_or_refused(tmp_path: Path) -> None:
    store = write(tmp_path, dataset())
    (store / "u" / "c" / "1" / "0" / "1" / "2").unlink()
    with pytest.warns(FhashWarning, match="lacks 1 of 54 chunks of u"):
        check(store)
    group = zarr.open_group(tmp_path / "zero.zarr", mode="w")
    array = group.create_array(
        "u", shape=SHAPE, chunks=(2, 6, 9, 10), dtype="f4", serializer=TransformCodec(max_error=0.1)
    )
    array[2:] = smooth(SHAPE)[2:]
    run = tmp_path / "zero.fhz"
    with pytest.raises(InputError, match=r"lacks chunk \(0, 0, 0, 0\) of u.*--absent fill"):
        fhash_codec.pack(group.store.root, run)
    assert not run.exists()
    report = fhash_codec.pack(group.store.root, run, absent="fill")
    assert report["variables"]["u"]["absent"] == 1
    with fhash_codec.open(run) as volume:
        np.testing.assert_array_equal(volume[...], array[...])


def test_a_damaged_chunk_leaves_no_file(tmp_path: Path) -> None:
    store = write(tmp_path, dataset(), compressors=None)
    file = store / "u" / "c" / "1" / "0" / "1" / "2"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)
    with pytest.raises(DamagedFileError, match=r"chunk \(1, 0, 1, 2\) of u is damaged"):
        fhash_codec.pack(store, tmp_path / "run.fhz")
    assert [each.name for each in tmp_path.iterdir()] == ["run.zarr"]


def test_a_store_that_changes_meanwhile_is_refused(tmp_path: Path) -> None:
    store, run = write(tmp_path, dataset()), tmp_path / "run.fhz"

    def progress(stage: str, done: int, total: int, note: str) -> None:
        if done == total:
            (store / "u" / "c" / "1" / "0" / "0" / "0").write_bytes(b"")

    with pytest.raises(InputError, match="changed"):
        fhash_codec.pack(store, run, progress=progress)
    assert not run.exists()


def test_other_sources_are_refused(tmp_path: Path) -> None:
    run = tmp_path / "run.fhz"
    data = dataset()
    data["v"] = data.u * 2
    store = write(tmp_path, data)
    with pytest.raises(InputError, match=r"v is not coded by fhash.transform.*--var u"):
        fhash_codec.pack(store, run)
    with pytest.raises(InputError, match="v is coded by bytes, zstd"):
        fhash_codec.pack(store, run, variables=["v"])
    with pytest.raises(InputError, match="no variable 'w'"):
        fhash_codec.pack(store, run, variables=["w"])
    with pytest.raises(InputError, match="allowed: refuse, fill"):
        fhash_codec.pack(store, run, absent="zero")
    with pytest.raises(InputError, match="copy it here first"):
        fhash_codec.pack("https://example.org/run.zarr", run)
    with pytest.raises(InputError, match="no such file"):
        fhash_codec.pack(tmp_path / "none.zarr", run)
    with pytest.raises(InputError, match=r"is not a \.zarr file"):
        fhash_codec.pack(store, tmp_path / "other.zarr")
    assert not run.exists()
    fhash_codec.pack(store, run, variables=["u"])
    with pytest.raises(OutputExistsError):
        fhash_codec.pack(store, run, variables=["u"])


@pytest.mark.parametrize(
    ("value", "message"), [(np.inf, "infinite values"), (np.nan, "no finite value")]
)
@pytest.mark.filterwarnings("ignore::fhash_codec.FhashWarning")
def test_values_that_a_container_has_no_place_for_are_refused(
    tmp_path: Path, value: float, message: str
) -> None:
    data = dataset()
    data["u"][...] = value
    with pytest.raises(InputError, match=message):
        fhash_codec.pack(write(tmp_path, data), tmp_path / "run.fhz")


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


def check_unpack(run: Path) -> Path:
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


@pytest.mark.parametrize("case", [*list(CASES)[-2:], *rarely(*list(CASES)[:-2])])
def test_a_store_shows_what_the_container_shows(tmp_path: Path, case: str) -> None:
    make, settings = CASES[case]
    check_unpack(encoded(tmp_path, make(), **settings))


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
    check_unpack(run)
    with fhash_codec.open(run) as volume:
        assert volume.container.arrays["table_1"].axes is not None


def test_fill_values_come_back(tmp_path: Path) -> None:
    data = with_gaps()
    store = write(tmp_path, data.round(), max_error=0, dtype="i2", _FillValue=np.int16(-7))
    run = tmp_path / "run.fhz"
    fhash_codec.pack(store, run)
    found = zarr.open_group(check_unpack(run), mode="r")["u"]
    assert found.attrs["_FillValue"] == -7
    assert found.dtype == np.int16


def test_several_variables_come_into_one_store(tmp_path: Path) -> None:
    data = dataset()
    data["v"] = data.u * 2
    data["w"] = data.u.isel(level=0, drop=True)
    run = tmp_path / "run.fhz"
    fhash_codec.pack(write(tmp_path, data, coded=("u", "v", "w")), run)
    check_unpack(run)
    report = fhash_codec.unpack(run, tmp_path / "one.zarr", variables=["w"])
    assert list(report["variables"]) == ["w"]
    assert list(shown(tmp_path / "one.zarr").data_vars) == ["crs", "w"]
    with pytest.raises(InputError, match="no variable 'x'"):
        fhash_codec.unpack(run, tmp_path / "two.zarr", variables=["x"])


def test_the_published_network_is_refused(tmp_path: Path) -> None:
    golden = Path(__file__).parents[2] / "golden" / "paper-plain.fhz"
    with pytest.raises(InputError, match=r"the published network.*fhash decode .* -o OUT\.zarr"):
        fhash_codec.unpack(golden, tmp_path / "out.zarr")
    assert not (tmp_path / "out.zarr").exists()


def test_plain_files_and_integers_with_gaps_are_refused(tmp_path: Path) -> None:
    golden = Path(__file__).parents[2] / "golden"
    for name, what in (
        ("compact-plain-head", "tables of plain numbers"),
        ("compact-counts", "integers of which some have no value"),
    ):
        with pytest.raises(InputError, match=what):
            fhash_codec.unpack(golden / f"{name}.fhz", tmp_path / "out.zarr")
