"""Places of inner chunks, read from the indices of shards: here also from far away."""

from __future__ import annotations

import numpy as np
import pytest
from sharded_files import NAME, random_values, write_sharded

from fhash_formats.container import Container
from fhash_formats.container.remote import TAIL_BYTES


def remote(range_server, path) -> Container:
    container = Container.open(range_server.put("run.fhz", path.read_bytes()))
    range_server.taken()
    return container


def test_one_region_of_a_file_elsewhere_is_one_request(tmp_path, samples, range_server) -> None:
    values = random_values((8, 64, 80))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (4, 16, 16), (8, 64, 80))
    assert path.stat().st_size > 8 * TAIL_BYTES
    with remote(range_server, path) as container:
        array = container.arrays[NAME]
        region = (slice(0, 4), slice(16, 32), slice(3, 9))
        np.testing.assert_array_equal(array.read(region), values[region])
        member = next(iter(array.chunks.values()))
        ((method, asked, status, size),) = range_server.log
        assert (method, status) == ("GET", 206)
        assert size < 5000 < member.size
        assert asked.startswith("bytes=")
        range_server.taken()
        array.read(region)
        assert range_server.taken() == (0, 0)
        region = (slice(4, 8), slice(0, 64), slice(0, 32))
        np.testing.assert_array_equal(array.read(region), values[region])
        requests, size = range_server.taken()
        assert requests == 1
        assert size <= 8 * 16 * 1028
        np.testing.assert_array_equal(array.read(), values)
        assert container.verify() == 2


def test_many_indices_are_read_together(tmp_path, samples, range_server) -> None:
    values = random_values((16, 40, 40))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (1, 20, 20), (1, 40, 40))
    with remote(range_server, path) as container:
        array = container.arrays[NAME]
        np.testing.assert_array_equal(
            array.read((slice(0, 16), slice(0, 20), slice(0, 20))), values[:, :20, :20]
        )
        # Indices and chunks of 16 shards: all lie together, and some ends beside them.
        assert range_server.taken()[0] <= 3


def test_a_large_index_is_read_by_entries(tmp_path, samples, range_server) -> None:
    values = random_values((2, 2400, 4))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (2, 1, 4), (2, 2400, 4))
    assert TAIL_BYTES < 2400 * 16
    with remote(range_server, path) as container:
        array = container.arrays[NAME]
        for rows in (slice(5, 6), slice(700, 720)):
            region = (slice(0, 2), rows, slice(0, 4))
            np.testing.assert_array_equal(array.read(region), values[region])
            requests, size = range_server.taken()
            assert requests == 2
            assert size <= 20 * 16 + 20 * 60


@pytest.mark.parametrize("gap", [0, 1 << 20])
def test_a_large_gap_reads_whole_indices(tmp_path, samples, gap, monkeypatch) -> None:
    values = random_values((2, 2400, 4))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (2, 1, 4), (2, 2400, 4))
    with Container.open(path) as container:
        array = container.arrays[NAME]
        monkeypatch.setattr(container._source, "gap", gap)
        before = container.bytes_read
        region = (slice(0, 2), slice(5, 6), slice(0, 4))
        np.testing.assert_array_equal(array.read(region), values[region])
        read = container.bytes_read - before
        assert 30 <= read - (2400 * 16 + 4 if gap else 16) <= 60
