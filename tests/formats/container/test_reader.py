"""`Container`: its header and figures, files that are no containers, and `verify`."""

from __future__ import annotations

import io
import os
import pickle
import struct
from pathlib import Path

import numcodecs.zstd
import numpy as np
import pytest
from hostile_files import refused, replaced

from fhash_formats.container import FORMAT_VERSION, Container, is_container, remote
from fhash_formats.container.coding import crc32c
from fhash_formats.container.header import complete
from fhash_formats.container.reader import Location
from fhash_formats.errors import DamagedFileError, InputError, MissingInputError


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


def values(container: Container) -> np.ndarray:
    return container.arrays["mlp/weight_1"].read()


@pytest.fixture
def expected(sample) -> np.ndarray:
    with Container.open(sample) as container:
        return values(container)


def test_a_path_and_a_local_url(sample, expected) -> None:
    for place in (sample, str(sample), f"file://{sample}"):
        with Container.open(place) as container:
            np.testing.assert_array_equal(values(container), expected)
            assert container.path == sample
            assert container.reopening() == Location(place=sample, digest=container.digest)
    with pytest.raises(MissingInputError, match="no such file"):
        Container.open("file:///none/run.fhz")


def test_a_relative_path_is_opened_again_from_elsewhere(sample, monkeypatch) -> None:
    monkeypatch.chdir(sample.parent)
    with Container.open(sample.name) as container:
        assert container.path == Path(sample.name)
        location = pickle.loads(pickle.dumps(container.reopening()))
    monkeypatch.chdir("/")
    Container.open(location).close()


def test_a_url(sample, expected, range_server) -> None:
    url = range_server.put("run.fhz", sample.read_bytes())
    with Container.open(f"{url}?signature=1") as container:
        np.testing.assert_array_equal(values(container), expected)
        assert container.path == f"{url}?signature=1"


def test_options_of_a_url_are_kept_but_not_shown(sample, range_server) -> None:
    range_server.token = "Bearer secret"
    options = {"headers": {"Authorization": range_server.token}}
    with Container.open(
        range_server.put("run.fhz", sample.read_bytes()), storage_options=options
    ) as container:
        location = pickle.loads(pickle.dumps(container.reopening()))
    assert "secret" not in repr(location)
    Container.open(location).close()


def test_options_without_a_url_are_refused(sample) -> None:
    for place in (sample, io.BytesIO(sample.read_bytes())):
        with pytest.raises(InputError, match="storage_options are for URLs"):
            Container.open(place, storage_options={"anon": True})
    Container.open(sample, storage_options={}).close()


def test_a_url_that_became_a_path() -> None:
    with pytest.raises(InputError, match="given as text, not as a Path"):
        Container.open(Path("https://host/run.fhz"))


def test_memory(sample, expected) -> None:
    import fsspec

    with fsspec.open("memory://location/run.fhz", "wb") as file:
        file.write(sample.read_bytes())
    with Container.open("memory://location/run.fhz") as container:
        np.testing.assert_array_equal(values(container), expected)
        assert container.path == "memory://location/run.fhz"
        assert container.verify() == len(container.arrays)


@pytest.mark.parametrize("kind", ["file", "unbuffered", "bytes"])
def test_an_open_file_stays_open(sample, expected, kind) -> None:
    buffering = {"file": -1, "unbuffered": 0}
    in_memory = io.BytesIO(sample.read_bytes())
    with in_memory if kind == "bytes" else open(sample, "rb", buffering=buffering[kind]) as file:
        with Container.open(file) as container:
            assert container.path == ("<BytesIO>" if kind == "bytes" else str(sample))
            np.testing.assert_array_equal(values(container), expected)
            with pytest.raises(InputError, match="open it by its path or URL"):
                container.reopening()
        assert not file.closed
        with pytest.raises(InputError, match="closed"):
            values(container)


def test_an_open_file_that_is_closed_before_the_container(sample) -> None:
    with open(sample, "rb") as file:
        container = Container.open(file)
    with pytest.raises(InputError, match="closed"):
        values(container)


def test_an_open_file_that_is_cut(sample) -> None:
    file = io.BytesIO(sample.read_bytes())
    container = Container.open(file)
    file.truncate(100)
    with pytest.raises(DamagedFileError, match="cut short"):
        values(container)


def test_files_that_cannot_be_read(sample) -> None:
    with (
        open(sample, encoding="latin-1") as file,
        pytest.raises(InputError, match="open it with 'rb'"),
    ):
        Container.open(file)
    with open(sample, "ab") as file, pytest.raises(InputError, match="cannot seek and read"):
        Container.open(file)
    ends = os.pipe()
    with open(ends[0], "rb") as pipe, pytest.raises(InputError, match="cannot seek and read"):
        Container.open(pipe)
    os.close(ends[1])
    with pytest.raises(InputError, match="int is no place of a container"):
        Container.open(5)


def test_a_file_of_fsspec_is_read_by_ranges(sample, expected, range_server) -> None:
    import fsspec

    data = sample.read_bytes()
    unopened = fsspec.open(range_server.put("run.fhz", data))
    with unopened as opened:
        for file in (unopened, opened):
            range_server.taken()
            with Container.open(file) as container:
                np.testing.assert_array_equal(values(container), expected)
                with pytest.raises(InputError, match="open it by its path or URL"):
                    container.reopening()
            assert range_server.taken()[1] <= len(data)
    with pytest.raises(InputError, match="compressed"):
        Container.open(fsspec.open(str(sample), compression="gzip"))


def test_another_file_in_the_place_is_noticed(sample, range_server) -> None:
    with Container.open(range_server.put("run.fhz", sample.read_bytes())) as container:
        location = container.reopening()
    Container.open(location).close()
    with pytest.raises(InputError, match="another file is there than was opened before"):
        Container.open(Location(place=location.place, digest="0" * 64))


def test_a_tail_that_is_cut_short_names_the_file(sample, monkeypatch) -> None:
    import fsspec

    from fhash_formats.container.fsspec_file import FsspecFile

    monkeypatch.setattr(FsspecFile.__init__, "__kwdefaults__", {"pause": lambda seconds: None})
    fsspec.filesystem("memory").pipe("/location/cut.fhz", sample.read_bytes())
    cat = fsspec.filesystem("memory").__class__.cat_file
    monkeypatch.setattr(
        fsspec.filesystem("memory").__class__,
        "cat_file",
        lambda self, path, start, end: cat(self, path, start, end - 1),
    )
    with pytest.raises(DamagedFileError, match=r"^memory://location/cut\.fhz: the file is"):
        Container.open("memory://location/cut.fhz")


@pytest.mark.parametrize("validators", [True, False])
def test_damage_is_told_as_a_change(sample, range_server, validators, monkeypatch) -> None:
    # Nothing but the documents and a short end is read at opening.
    monkeypatch.setattr(remote, "TAIL_BYTES", 1000)
    monkeypatch.setattr(remote, "GAP", 1)
    range_server.conditions = range_server.range_conditions = False
    range_server.validators = validators
    data = sample.read_bytes()
    with Container.open(range_server.put("run.fhz", data)) as container:
        member = next(iter(container.arrays["tables/level_1"].chunks.values()))
        assert member.end < len(data) - 1000
        range_server.put("run.fhz", bytes(len(data)))
        with pytest.raises(InputError, match="the file changed since it was opened") as told:
            container.arrays["tables/level_1"].read()
        assert not isinstance(told.value, DamagedFileError)


def test_damage_without_a_change_is_damage(sample, range_server) -> None:
    data = bytearray(sample.read_bytes())
    with Container.open(sample) as container:
        member = next(iter(container.arrays["mlp/weight_1"].chunks.values()))
    data[member.data_offset] ^= 1
    with (
        Container.open(range_server.put("run.fhz", bytes(data))) as container,
        pytest.raises(DamagedFileError, match=r"run\.fhz: member parts/0\.mlp\.weight_1"),
    ):
        values(container)
