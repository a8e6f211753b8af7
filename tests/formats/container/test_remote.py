"""Few requests for many reads, and the same bytes as without them."""

from __future__ import annotations

import random
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from forked import ended_well, forked, needs_fork

from fhash_formats.container import remote
from fhash_formats.container.remote import GAP, MAX_TAIL_BYTES, TAIL_BYTES, RemoteSource
from fhash_formats.errors import DamagedFileError, InputError

DATA = random.Random(0).randbytes(1 << 20)


class CountedFile:
    """Bytes elsewhere; `asked` has every request, `busiest` how many there were at once."""

    connections = 4

    def __init__(self, data: bytes = DATA) -> None:
        self.data, self.size = data, len(data)
        self.asked: list[tuple[int, int]] = []
        self.failing: set[int] = set()
        self.meeting: threading.Barrier | None = None

    def fetch(self, start: int, stop: int) -> bytes:
        self.asked.append((start, stop))
        if start in self.failing:
            raise InputError(f"no bytes from {start}")
        if self.meeting is not None:
            self.meeting.wait(20)
        return self.data[start:stop]

    def changed(self) -> bool:
        return False

    def taken(self) -> list[tuple[int, int]]:
        asked, self.asked = self.asked, []
        return sorted(asked)


@pytest.fixture
def file():
    return CountedFile()


@pytest.fixture
def source(file):
    source = RemoteSource(file)
    file.taken()
    yield source
    source.close()


def test_the_end_is_read_once() -> None:
    file = CountedFile()
    source = RemoteSource(file)
    for offset, size in ((len(DATA) - 100, 100), (len(DATA) - TAIL_BYTES, TAIL_BYTES)):
        assert source.read(offset, size) == DATA[offset : offset + size]
    assert file.taken() == [(len(DATA) - TAIL_BYTES, len(DATA))]


@pytest.mark.parametrize("size", [0, 1, TAIL_BYTES, TAIL_BYTES + 1])
def test_small_files(size: int) -> None:
    file = CountedFile(DATA[:size])
    assert RemoteSource(file).read(0, size) == DATA[:size]
    assert file.taken() == [
        (a, b) for a, b in ((0, size - TAIL_BYTES), (max(0, size - TAIL_BYTES), size)) if a < b
    ]


def test_a_range_that_reaches_into_the_tail_makes_it_longer(file, source) -> None:
    start = len(DATA) - 5 * TAIL_BYTES
    assert source.read(start, 5 * TAIL_BYTES) == DATA[start:]
    assert file.taken() == [(start, len(DATA) - TAIL_BYTES)]
    assert source.read(start + 7, 5) == DATA[start + 7 : start + 12]
    assert file.taken() == []


def test_a_tail_does_not_grow_without_end(monkeypatch) -> None:
    monkeypatch.setattr(remote, "MAX_TAIL_BYTES", 2 * TAIL_BYTES)
    file = CountedFile()
    source = RemoteSource(file)
    assert source.read(0, len(DATA)) == DATA
    assert source.read(1, 5) == DATA[1:6]
    assert file.taken()[:2] == [(0, len(DATA) - TAIL_BYTES), (1, 6)]
    assert MAX_TAIL_BYTES > TAIL_BYTES


def test_announced_neighbours_are_one_request(file, source) -> None:
    places = [(1000, 500), (1500, 20), (1520 + GAP, 80)]
    source.prefetch(places)
    for offset, size in reversed(places):
        assert source.read(offset, size) == DATA[offset : offset + size]
    assert file.taken() == [(1000, 1600 + GAP)]


def test_announced_ranges_far_apart_are_fetched_side_by_side(file, source) -> None:
    # A barrier that all requests must reach holds only if they run at once.
    file.meeting = threading.Barrier(file.connections)
    places = [(number * 5 * GAP, 10) for number in range(file.connections)]
    source.prefetch(places)
    for offset, size in places:
        assert source.read(offset, size) == DATA[offset : offset + size]
    assert len(file.taken()) == file.connections


def test_no_more_runs_ahead_than_allowed(file, source) -> None:
    file.meeting = threading.Barrier(file.connections + 1)
    places = [(number * 2 * GAP, 10) for number in range(20)]
    source.prefetch(places)
    file.meeting.wait(20)
    assert len(file.asked) == file.connections
    file.meeting = None
    for offset, size in places:
        assert source.read(offset, size) == DATA[offset : offset + size]
    assert len(file.taken()) == 20


def test_what_came_is_kept_and_holds_ranges_within(file, source) -> None:
    source.prefetch([(1000, 500), (1500, 500)])
    source.read(1000, 500)
    source.prefetch([(1000, 500), (1200, 700)])
    assert source.read(1200, 700) == DATA[1200:1900]
    assert source.read(1000, 500) == DATA[1000:1500]
    assert file.taken() == [(1000, 2000)]


def test_no_more_is_kept_than_allowed(file, monkeypatch) -> None:
    monkeypatch.setattr(remote, "KEPT_BYTES", 2500)
    source = RemoteSource(file)
    for _ in range(2):
        for offset in (0, 100_000, 200_000):
            source.prefetch([(offset, 1000)])
            assert source.read(offset, 1000) == DATA[offset : offset + 1000]
    # The tail, and each of the three twice: the oldest is dropped each time.
    assert len(file.taken()) == 7
    source.close()


def test_a_failed_request_is_made_again_once_it_is_wanted(file, source) -> None:
    file.failing = {0, 5 * GAP}
    source.prefetch([(0, 10), (5 * GAP, 10)])
    for offset in (0, 5 * GAP):
        with pytest.raises(InputError, match=f"no bytes from {offset}"):
            source.read(offset, 10)
    file.failing = set()
    assert source.read(0, 10) == DATA[:10]


def test_what_a_reader_gave_up_is_not_fetched(file, source) -> None:
    file.meeting = threading.Barrier(file.connections + 1)
    source.prefetch([(number * 2 * GAP, 10) for number in range(20)])
    file.meeting.wait(20)
    file.meeting = None
    begun = len(file.taken())
    source.prefetch([(900_000, 10)])
    assert source.read(900_000, 10) == DATA[900_000:900_010]
    assert (begun, file.taken()) == (file.connections, [(900_000, 900_010)])


def test_random_reads_of_several_threads_equal_the_file() -> None:
    source = RemoteSource(CountedFile())

    def work(seed: int) -> bool:
        draw = random.Random(seed)
        for _ in range(30):
            places = [
                (offset, min(draw.randrange(1, 40_000), len(DATA) - offset))
                for offset in (draw.randrange(len(DATA)) for _ in range(draw.randrange(1, 8)))
            ]
            if draw.random() < 0.8:
                source.prefetch(iter(places))
            for offset, size in places[: draw.randrange(len(places) + 1)]:
                if source.read(offset, size) != DATA[offset : offset + size]:
                    return False
        return True

    with ThreadPoolExecutor(6) as pool:
        assert all(pool.map(work, range(12)))
    source.close()


def test_ranges_outside_and_a_closed_source(source) -> None:
    for offset, size in ((-1, 5), (len(DATA) - 1, 2), (5, -1)):
        with pytest.raises(DamagedFileError, match="outside the file"):
            source.read(offset, size)
    source.close()
    with pytest.raises(InputError, match="closed"):
        source.read(0, 1)


@needs_fork
def test_a_forked_process_reads_by_itself(file, source) -> None:
    source.prefetch([(0, 10), (5 * GAP, 10)])
    assert source.read(0, 10) == DATA[:10]

    def reads_right() -> bool:
        source.prefetch([(7 * GAP, 10), (9 * GAP, 10)])
        sound = source.read(9 * GAP, 10) == DATA[9 * GAP : 9 * GAP + 10]
        return sound and source.read(0, 10) == DATA[:10]

    assert ended_well(forked(reads_right))
