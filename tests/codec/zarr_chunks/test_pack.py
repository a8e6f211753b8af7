"""`pack`: a container of a Zarr store has the values that zarr decodes from it, bit by bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr
from coded_stores import CHUNKS, SHAPE, dataset, shown, smooth, without_provenance, write
from zarr.codecs import Crc32cCodec, TransposeCodec

import fhash_codec
from fhash_codec import DamagedFileError, FhashWarning, InputError, OutputExistsError
from fhash_codec.header import full_header
from fhash_formats.transform.zarr_codec import TransformCodec

pytestmark = pytest.mark.filterwarnings("ignore:.*Zarr format 3 specification")


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
        {"compressors": None},
        {"compressors": [Crc32cCodec()]},
        {"chunks": (2, 3, 4, 4), "shards": (4, 6, 8, 8), "compressors": None},
        {"filters": [TransposeCodec(order=(3, 1, 0, 2))]},
    ],
    ids=str,
)
def test_a_store_of_dask_becomes_a_container(tmp_path: Path, encoding: dict[str, Any]) -> None:
    chunks = dict(zip(CHUNKS, encoding.get("shards", CHUNKS.values()), strict=True))
    check(write(tmp_path, dataset(), dask=chunks, **encoding))


@pytest.mark.parametrize("dtype", ["f8", "f2", "i1", "u2", "i4", "i8", "u8"])
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
        np.testing.assert_array_equal(plain[...], shown(store).u.values)


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
