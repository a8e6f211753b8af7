"""`Container`: its header and figures, files that are no containers, and `verify`."""

from __future__ import annotations

import struct

import numcodecs.zstd
import numpy as np
import pytest
from hostile_files import refused, replaced

from fhash_formats.container import FORMAT_VERSION, Container, is_container
from fhash_formats.container.coding import crc32c
from fhash_formats.container.header import complete
from fhash_formats.errors import DamagedFileError


def test_header_comes_back(sample, samples) -> None:
    with Container.open(sample) as container:
        assert container.header == {
            **complete(samples.header()),
            "dimensions": ["time", "z", "y", "x"],
            "format": "fhash",
            "format_version": list(FORMAT_VERSION),
            "required_features": [],
        }
        assert container.size == sample.stat().st_size
        assert container.path == sample


def test_overhead_and_chunk_data_are_the_file(sample) -> None:
    with Container.open(sample) as container:
        assert (
            container.overhead() + sum(array.nbytes_stored for array in container.arrays.values())
            == sample.stat().st_size
        )
        assert 0 < container.overhead() < container.size


def test_verify_reports_every_member(sample, samples) -> None:
    seen = []
    with Container.open(sample) as container:
        container.verify(lambda done, total: seen.append((done, total)))
    assert seen[-1][0] == seen[-1][1] == len(samples.unpack(sample.read_bytes()))
    assert [done for done, _ in seen] == list(range(seen[0][0], seen[-1][0] + 1))


def test_chunks_whose_values_are_known_are_checked_and_not_decoded(sample) -> None:
    with Container.open(sample) as container:
        name = "tables/level_1"
        first = (0,) * len(container.arrays[name].grid)
        values = np.full_like(container.arrays[name].decode_chunk(first), 7)
    with Container.open(sample) as container:
        container.take_decoded(name, {first: values})
        np.testing.assert_array_equal(container.arrays[name].decode_chunk(first), values)
        member = next(iter(container.arrays[name].chunks.values()))
    data = bytearray(sample.read_bytes())
    data[member.data_offset] ^= 1
    sample.write_bytes(data)
    with Container.open(sample) as container, pytest.raises(DamagedFileError):
        container.take_decoded(name, {first: values})


def test_is_container(sample, tmp_path) -> None:
    assert is_container(sample)
    assert is_container(str(sample))
    data = sample.read_bytes()
    for name, other in {
        "cut": data[:-1],
        "longer": data + b"\n",
        "empty": b"",
        "text": b"fhash 1",
    }.items():
        (tmp_path / name).write_bytes(other)
        assert not is_container(tmp_path / name)
    assert not is_container(tmp_path)
    assert not is_container(tmp_path / "missing")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\x05\x06" + bytes(18),
        b"\x89HDF\r\n\x1a\n" + bytes(500),
        b"fhash 2 sha256=" + b"0" * 64,
    ],
)
def test_another_file_is_refused(tmp_path, content) -> None:
    refused(
        tmp_path / "other.fhz", content, "other.fhz: (not an fhash container|the ZIP end record)"
    )


@pytest.mark.parametrize("steps", [[0, 0], [3, 0], [-1, 3], [0, 4]])
def test_key_frames_increase_within_the_domain(sample, samples, steps) -> None:
    coded = numcodecs.zstd.compress(np.array(steps, dtype="<i8"), 1)
    coded += struct.pack("<I", crc32c(coded))
    refused(sample, replaced(sample, samples, "parts/0.key_frames/c/0", coded), "key_frames")
