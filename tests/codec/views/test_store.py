"""`zarr_store`: the bits of a volume through zarr-python, xarray and dask."""

from __future__ import annotations

import asyncio
import pickle
from pathlib import Path

import numpy as np
import pytest
import zarr
from zarr.abc.store import OffsetByteRequest, RangeByteRequest, SuffixByteRequest
from zarr.core.buffer import default_buffer_prototype

import fhash_codec
from fhash_codec import EncodeConfig, InputError
from fhash_codec.views import store as store_module
from fhash_codec.views.store import DecodedStore
from fhash_formats.errors import DamagedFileError, MissingInputError

GOLDEN = Path(__file__).resolve().parents[2] / "golden"
NAMES = {
    "labels": GOLDEN / "compact-labels.fhz",
    "counts": GOLDEN / "compact-counts.fhz",
    "paper": GOLDEN / "paper-sparse.fhz",
    "plain": GOLDEN / "compact-plain-labels.fhz",
}


def run_of(kind: str, request: pytest.FixtureRequest) -> Path:
    return NAMES[kind] if kind in NAMES else request.getfixturevalue(kind)


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize("kind", ["whole", "feature", "gappy", *NAMES])
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
