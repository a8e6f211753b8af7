"""Bytes at offsets: of a file, counted, and of a file whose end is not written yet."""

from __future__ import annotations

import io
import os
import random
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product

import numpy as np
import pytest
from forked import ended_well, forked, needs_fork

from fhash_formats.container import Container
from fhash_formats.container.source import (
    CountedSource,
    FileSource,
    OpenFileSource,
    PreviewSource,
    merged,
)
from fhash_formats.errors import DamagedFileError, InputError, MissingInputError


def test_no_file_folder_and_pipe(tmp_path) -> None:
    with pytest.raises(MissingInputError, match="no such file"):
        Container.open(tmp_path / "none.fhz")
    os.mkfifo(tmp_path / "pipe.fhz")
    for path in (tmp_path, tmp_path / "pipe.fhz"):
        with pytest.raises(InputError, match="regular file"):
            Container.open(path)


def test_file_cut_while_open(sample) -> None:
    with Container.open(sample) as container:
        sample.write_bytes(sample.read_bytes()[:100])
        with pytest.raises(InputError, match="the file changed since it was opened; open it again"):
            container.arrays["mlp/weight_1"].read()
    source = FileSource(sample)
    sample.write_bytes(b"")
    with pytest.raises(DamagedFileError, match="cut short"):
        source.read(90, 10)
    assert source.changed()
    source.close()


def test_a_file_is_damaged_rather_than_changed_if_nobody_wrote_to_it_since(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")
    source = FileSource(tmp_path / "a")
    assert source.read(0, 8) == b"abcdefgh"
    assert not source.changed()
    (tmp_path / "b").write_bytes(b"another file")
    (tmp_path / "b").replace(tmp_path / "a")
    assert source.read(0, 8) == b"abcdefgh"
    assert not source.changed()
    source.close()
    assert not source.changed()


def test_closed_container(sample) -> None:
    with Container.open(sample) as container:
        pass
    with pytest.raises(InputError, match="closed"):
        container.arrays["mlp/weight_1"].read()


def test_a_preview_is_the_file_followed_by_its_tail(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")
    preview = PreviewSource(FileSource(tmp_path / "a"), 5, b"XYZ")
    expected = b"abcdeXYZ"
    assert preview.size == len(expected)
    for start, stop in product(range(9), range(9)):
        if start <= stop:
            assert preview.read(start, stop - start) == expected[start:stop]
    for offset, size in ((0, 9), (8, 1), (-1, 1), (3, -1)):
        with pytest.raises(DamagedFileError, match="outside the file of 8 bytes"):
            preview.read(offset, size)
    preview.close()


def test_bytes_that_were_read_are_counted(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")
    source = CountedSource(FileSource(tmp_path / "a"))
    assert source.read(2, 3) + source.read(0, 0) + source.read(7, 1) == b"cdeh"
    assert source.bytes_read == 4
    with pytest.raises(DamagedFileError, match="outside the file"):
        source.read(7, 2)
    assert source.bytes_read == 4
    source.close()


@pytest.mark.skipif(not hasattr(os, "pread"), reason="one thread at a time without os.pread")
def test_threads_read_side_by_side_and_the_last_one_lets_go(tmp_path, monkeypatch) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")
    source, pread, both = FileSource(tmp_path / "a"), os.pread, threading.Barrier(2, timeout=30)

    def slow(file: int, size: int, offset: int) -> bytes:
        both.wait()
        source.close()
        return pread(file, size, offset)

    monkeypatch.setattr(os, "pread", slow)
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(source.read, (0, 5), (3, 3))) == [b"abc", b"fgh"]
    assert source._file.closed
    with pytest.raises(InputError, match="closed"):
        source.read(0, 1)


@needs_fork
def test_forked_processes_read_one_open_file_at_once(tmp_path) -> None:
    numbers = np.arange(50_000, dtype="<u4")
    (tmp_path / "a").write_bytes(numbers.tobytes())
    source = FileSource(tmp_path / "a")

    def reads_right(seed: int) -> bool:
        places = np.random.default_rng(seed).integers(0, numbers.size, 20_000).tolist()
        return all(source.read(4 * n, 4) == n.to_bytes(4, "little") for n in places)

    children = [forked(partial(reads_right, seed)) for seed in range(2)]
    assert reads_right(2)
    assert [ended_well(process) for process in children] == [True, True]
    source.close()


@needs_fork
def test_a_forked_process_reads_bytes_but_not_a_file_that_its_parent_opened(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")

    def refused() -> bool:
        with pytest.raises(InputError, match=r"this one was forked from.*open it by its path"):
            source.read(2, 3)
        return True

    with (tmp_path / "a").open("rb") as file:
        source = OpenFileSource(file)
        assert ended_well(forked(refused))
        assert source.read(2, 3) == b"cde"
    held = OpenFileSource(io.BytesIO(b"abcdefgh"))
    assert ended_well(forked(lambda: held.read(2, 3) == b"cde"))


def places(requests) -> list[tuple[int, int]]:
    return [(request.start, request.stop) for request in requests]


def test_neighbours_are_one_request() -> None:
    assert places(merged([(20, 5), (0, 10), (10, 5)], gap=5, most=100)) == [(0, 25)]
    assert places(merged([(20, 5), (0, 10), (10, 5)], gap=4, most=100)) == [(0, 15), (20, 25)]


def test_a_request_of_several_ranges_has_a_limit() -> None:
    assert places(merged([(0, 6), (6, 6), (12, 6)], gap=0, most=12)) == [(0, 12), (12, 18)]
    assert places(merged([(0, 60), (60, 6)], gap=0, most=12)) == [(0, 60), (60, 66)]


def test_a_range_within_another() -> None:
    (request,) = merged([(0, 50), (10, 5), (10, 5)], gap=0, most=100)
    assert (request.place, request.size, request.ranges) == ((0, 50), 50, ((0, 50), (10, 5)))


def test_nothing() -> None:
    assert merged([], gap=5, most=5) == []


def test_every_range_lies_in_one_request() -> None:
    for seed in range(200):
        draw = random.Random(seed)
        ranges = [(draw.randrange(300), draw.randrange(1, 40)) for _ in range(draw.randrange(1, 9))]
        gap, most = draw.randrange(20), draw.randrange(1, 120)
        requests = merged(ranges, gap, most)
        assert sorted(place for request in requests for place in request.ranges) == sorted(
            set(ranges)
        )
        for request in requests:
            covered = set()
            for offset, size in request.ranges:
                assert request.start <= offset
                assert offset + size <= request.stop
                covered.update(range(offset, offset + size))
            assert request.size - len(covered) <= gap * (len(request.ranges) - 1)
            assert len(request.ranges) == 1 or request.size <= most
