"""Tiles of a store: their order, their shards, and what one look at each tells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from coded_stores import SHAPE, dataset, write

from fhash_codec.views import pack as module
from fhash_codec.views.pack import Tiles
from fhash_formats.errors import InputError
from fhash_formats.readers.common.file_series import Request
from fhash_formats.readers.zarr_coded import open_coded
from fhash_formats.transform.chunk import decode_chunk

pytestmark = pytest.mark.filterwarnings("ignore:.*Zarr format 3 specification")


@pytest.mark.parametrize(
    ("most", "shard"),
    [
        (1 << 30, (6, 6, 12, 12)),
        (2 * 18 * 384, (4, 6, 12, 12)),
        (18 * 384, (2, 6, 12, 12)),
        (9 * 384, (2, 3, 12, 12)),
        (4 * 384, (2, 3, 4, 12)),
        (1, (2, 3, 4, 4)),
    ],
)
def test_shards_are_of_a_bounded_size_and_keep_steps_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, shard: tuple[int, ...]
) -> None:
    monkeypatch.setattr(module, "SHARD_BYTES", most)
    with open_coded(write(tmp_path, dataset()), Request()) as (series, array):
        found = Tiles(array, series.source)
        assert found.shard == shard
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
    monkeypatch.setattr(module, "SHARD_BYTES", most)
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
