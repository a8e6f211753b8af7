"""Files of fsspec's file systems: requests that fail, files that change, servers without ranges."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from forked import ended_well, forked, needs_fork

from fhash_formats.container import remote as fsspec_file
from fhash_formats.container.remote import PAUSES, FsspecFile
from fhash_formats.errors import (
    DamagedFileError,
    FhashWarning,
    InputError,
    MissingDependencyError,
    MissingInputError,
)

DATA = bytes(range(256)) * 400


@pytest.fixture(autouse=True)
def pauses(monkeypatch) -> list[float]:
    """The pauses that are asked for; none is made."""
    asked: list[float] = []
    monkeypatch.setattr(FsspecFile.__init__, "__kwdefaults__", {"pause": asked.append})
    return asked


@pytest.fixture
def memory():
    """A file system in memory that no other test has."""
    from fsspec.implementations.memory import MemoryFileSystem

    fs = MemoryFileSystem(skip_instance_cache=True)
    fs.store, fs.pseudo_dirs = {}, [""]
    return fs


@pytest.mark.parametrize("failure", [503, 500, 429, 408, "drop"])
def test_a_failure_that_may_pass_is_tried_again(range_server, pauses, failure) -> None:
    file = FsspecFile.open(range_server.put("run.fhz", DATA), {})
    range_server.failures = [failure] * len(PAUSES)
    assert file.fetch(5, 9) == DATA[5:9]
    # A connection that was cut may be made again below fsspec as well, without a pause.
    assert pauses == list(PAUSES) if failure != "drop" else pauses == list(PAUSES)[: len(pauses)]


def test_a_failure_that_stays_is_told(range_server, pauses) -> None:
    url = range_server.put("run.fhz", DATA)
    file = FsspecFile.open(url, {})
    range_server.failures = [503] * (len(PAUSES) + 1)
    with pytest.raises(InputError, match=r"run\.fhz: cannot be read, 4 times: HTTP status 503"):
        file.fetch(5, 9)
    assert pauses == list(PAUSES)
    assert file.fetch(5, 9) == DATA[5:9]


def test_nobody_listens(range_server, pauses) -> None:
    url = range_server.put("run.fhz", DATA)
    range_server.stop()
    with pytest.raises(InputError, match="cannot be read, 4 times"):
        FsspecFile.open(url, {})
    assert pauses == list(PAUSES)


def test_no_such_file(range_server, pauses, memory) -> None:
    url = range_server.put("run.fhz", DATA)
    with pytest.raises(MissingInputError, match=r"none\.fhz: no such file"):
        FsspecFile.open(url.replace("run", "none"), {})
    with pytest.raises(MissingInputError, match="m: no such file"):
        FsspecFile(memory, "/run.fhz", "m")
    assert pauses == []


def test_permission_and_options(range_server, pauses) -> None:
    url = range_server.put("run.fhz", DATA)
    range_server.token = "Bearer 1"
    with pytest.raises(InputError, match="no permission"):
        FsspecFile.open(url, {})
    file = FsspecFile.open(url, {"headers": {"Authorization": "Bearer 1"}})
    assert file.fetch(5, 9) == DATA[5:9]
    assert pauses == []


def test_a_folder(memory) -> None:
    memory.makedirs("/folder")
    with pytest.raises(InputError, match="m: a folder"):
        FsspecFile(memory, "/folder", "m")


def test_a_server_that_gives_no_parts(range_server) -> None:
    range_server.ranges = False
    url = range_server.put("run.fhz", DATA)
    file = FsspecFile.open(url, {})
    with pytest.warns(FhashWarning, match=f"no range requests.*all {len(DATA)} bytes are read"):
        assert file.fetch(300, 700) == DATA[300:700]
    asked = len(range_server.log)
    assert file.fetch(0, 5) == DATA[:5]
    assert len(range_server.log) == asked


def test_a_large_file_is_not_read_whole(range_server, monkeypatch) -> None:
    monkeypatch.setattr(fsspec_file, "WHOLE_BYTES", len(DATA) - 1)
    range_server.ranges = False
    file = FsspecFile.open(range_server.put("run.fhz", DATA), {})
    with pytest.raises(InputError, match=r"no range requests.*download it first"):
        file.fetch(300, 700)


def test_no_size_at_all(memory, monkeypatch) -> None:
    memory.pipe("/run.fhz", DATA)
    monkeypatch.setattr(memory, "info", lambda path: {"name": path, "size": None, "type": "file"})
    with pytest.raises(InputError, match="does not say its size"):
        FsspecFile(memory, "/run.fhz", "m")


@pytest.mark.parametrize("other", [DATA[::-1], DATA[:50_000], DATA + b"more"])
@pytest.mark.parametrize("heeded", ["conditions", "range_conditions"])
def test_a_file_that_changed_on_a_server(range_server, other, heeded) -> None:
    range_server.conditions, range_server.range_conditions = False, False
    setattr(range_server, heeded, True)
    url = range_server.put("run.fhz", DATA)
    file = FsspecFile.open(url, {})
    assert not file.changed()
    assert file.fetch(5, 9) == DATA[5:9]
    range_server.put("run.fhz", other)
    range_server.taken()
    with pytest.raises(InputError, match=r"run\.fhz: the file changed since it was opened"):
        file.fetch(5, 9)
    assert range_server.log[0][2] == (412 if heeded == "conditions" else 200)
    assert file.changed()


def test_a_server_that_does_not_know_its_own_tags(range_server) -> None:
    range_server.own_tags = False
    file = FsspecFile.open(range_server.put("run.fhz", DATA), {})
    assert [file.fetch(start, start + 9) for start in (70, 700)] == [DATA[70:79], DATA[700:709]]
    assert [entry[2] for entry in range_server.log] == [200, 200, 206, 206]


def test_a_file_of_the_same_size_on_a_server_without_versions(range_server) -> None:
    range_server.validators = False
    url = range_server.put("run.fhz", DATA)
    file = FsspecFile.open(url, {})
    assert file.fetch(len(DATA) - 900, len(DATA)) == DATA[-900:]
    range_server.taken()
    assert file.fetch(5, 9) == DATA[5:9]
    assert range_server.taken() == (2, 4 + 128)
    range_server.put("run.fhz", DATA[:-1] + b"x")
    with pytest.raises(InputError, match="the file changed since it was opened"):
        file.fetch(300, 700)


def test_a_file_that_is_gone(range_server) -> None:
    url = range_server.put("run.fhz", DATA)
    file = FsspecFile.open(url, {})
    range_server.files.clear()
    with pytest.raises(MissingInputError, match="no such file"):
        file.fetch(5, 9)
    assert file.changed()


def test_a_server_that_fails_does_not_mean_a_change(range_server) -> None:
    file = FsspecFile.open(range_server.put("run.fhz", DATA), {})
    range_server.failures = [503, 503]
    assert not file.changed()


def test_a_weak_tag_is_no_condition() -> None:
    conditions = fsspec_file._conditions
    strong = {"If-Match": '"a"', "If-Range": '"a"'}
    assert conditions({"ETag": '"a"', "Last-Modified": "then"}) == strong
    dated = {"If-Unmodified-Since": "then", "If-Range": "then"}
    assert conditions({"ETag": 'W/"a"', "Last-Modified": "then"}) == dated
    assert conditions({"ETag": 'W/"a"'}) == {}


def test_a_shorter_file_without_tags(range_server) -> None:
    range_server.validators = False
    file = FsspecFile.open(range_server.put("run.fhz", DATA), {})
    range_server.put("run.fhz", DATA[:500])
    with pytest.raises(InputError, match="the file changed"):
        file.fetch(300, 700)


def test_a_file_in_memory_that_changed(memory) -> None:
    memory.pipe("/run.fhz", DATA)
    file = FsspecFile(memory, "/run.fhz", "m")
    assert file.fetch(300, 700) == DATA[300:700]
    memory.pipe("/run.fhz", DATA[::-1])
    with pytest.raises(InputError, match="m: the file changed"):
        file.fetch(300, 700)
    assert file.changed()


def test_a_file_that_is_cut_short_and_says_nothing(memory, monkeypatch, pauses) -> None:
    memory.pipe("/run.fhz", DATA)
    file = FsspecFile(memory, "/run.fhz", "m")
    monkeypatch.setattr(memory, "cat_file", lambda path, start, end: DATA[start : end - 1])
    with pytest.raises(DamagedFileError, match="the file is cut short: 399 bytes came"):
        file.fetch(300, 700)
    assert pauses == list(PAUSES)


def test_a_file_system_for_one_thread_is_asked_by_one(memory, monkeypatch) -> None:
    memory.pipe("/run.fhz", DATA)
    file = FsspecFile(memory, "/run.fhz", "m")
    busy: list[int] = []
    cat = memory.cat_file

    def alone(path, start, end):
        assert not busy
        busy.append(1)
        data = cat(path, start, end)
        busy.pop()
        return data

    monkeypatch.setattr(memory, "cat_file", alone)
    with ThreadPoolExecutor(4) as pool:
        got = list(pool.map(lambda start: file.fetch(start, start + 9), range(200)))
    assert got == [DATA[start : start + 9] for start in range(200)]
    assert file.connections == 1


def test_a_chain_of_file_systems(tmp_path) -> None:
    import zipfile

    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        archive.writestr("run.fhz", DATA)
    file = FsspecFile.open(f"zip://run.fhz::file://{tmp_path}/all.zip", {})
    assert (file.size, file.fetch(300, 700)) == (len(DATA), DATA[300:700])


@pytest.mark.parametrize(
    ("url", "options"),
    [
        ("nowhere://run.fhz", {}),
        ("memory://run.fhz", {"skip_instance_cache": {1}, "loop": 3, 5: 1}),
    ],
)
def test_urls_that_cannot_be_opened(url: str, options: dict) -> None:
    with pytest.raises(InputError, match=r"run\.fhz: cannot be opened"):
        FsspecFile.open(url, options)


@pytest.mark.parametrize(
    ("missing", "url", "told"),
    [
        ("fsspec.core", "s3://bucket/run.fhz", r"need fsspec; pip install 'fhash\[remote\]'"),
        ("aiohttp", "https://host/run.fhz", r"pip install 'fhash\[remote\]'"),
        ("s3fs", "s3://bucket/run.fhz", "Install s3fs"),
    ],
)
def test_a_package_that_is_missing(monkeypatch, missing: str, url: str, told: str) -> None:
    import fsspec.registry  # noqa: F401

    monkeypatch.delitem(sys.modules, "fsspec.implementations.http", raising=False)
    known = sys.modules["fsspec.registry"]._registry
    for scheme in ("http", "https", "s3"):
        monkeypatch.delitem(known, scheme, raising=False)
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.setattr(fsspec_file, "object_store", lambda url: None)
    with pytest.raises(MissingDependencyError, match=told):
        FsspecFile.open(url, {})


def test_obstore_reads_an_object_store(range_server, monkeypatch) -> None:
    stores = pytest.importorskip("obstore.fsspec")
    stores.FsspecStore.clear_instance_cache()  # of other servers
    url = range_server.put("bucket/run.fhz", DATA)
    monkeypatch.setenv("AWS_ENDPOINT", url.removesuffix("/bucket/run.fhz"))
    for key, value in (("SKIP_SIGNATURE", "true"), ("ALLOW_HTTP", "true"), ("REGION", "x")):
        monkeypatch.setenv(f"AWS_{key}", value)
    file = FsspecFile.open("s3://bucket/run.fhz", {})
    assert (file.size, file.fetch(5, 9), file.changed()) == (len(DATA), DATA[5:9], False)
    range_server.put("bucket/run.fhz", DATA[::-1])
    assert file.changed()


@needs_fork
def test_a_forked_process_asks_by_itself(range_server) -> None:
    file = FsspecFile.open(range_server.put("run.fhz", DATA), {})
    assert file.fetch(5, 9) == DATA[5:9]
    assert ended_well(forked(lambda: file.fetch(300, 700) == DATA[300:700]))
