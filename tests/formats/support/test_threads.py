"""A lock that is free in a forked process."""

from __future__ import annotations

import errno
import gc
import os
import threading
import weakref
from collections.abc import Iterator, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folders import store
from forked import ended_well, forked, needs_fork
from hypothesis import given
from hypothesis import strategies as st

from fhash_formats.errors import InputError, OutputError, OutputExistsError, RegionError
from fhash_formats.support import files as atomic
from fhash_formats.support import threads as parallel
from fhash_formats.support.files import check_output
from fhash_formats.support.threads import (
    ITEMS_PER_THREAD,
    PART,
    SHARES_PER_THREAD,
    ForkLock,
    at_most,
    chunk_region,
    common_part,
    in_threads,
    map_ahead,
    one_ahead,
    region_bounds,
    row_parts,
    share_out,
    slab_shape,
    thread_pool,
    usable_threads,
)


def test_one_thread_at_a_time_holds_it() -> None:
    lock, entered, released = ForkLock(), threading.Event(), []

    def wait() -> None:
        entered.set()
        with lock:
            released.append(len(released))

    with lock:
        thread = threading.Thread(target=wait)
        thread.start()
        entered.wait()
        thread.join(0.05)
        assert released == []
    thread.join()
    assert released == [0]


@needs_fork
def test_a_forked_process_finds_it_free_although_a_thread_of_its_parent_holds_it() -> None:
    lock, held, over = ForkLock(), threading.Event(), threading.Event()

    def hold() -> None:
        with lock:
            held.set()
            over.wait()

    def take() -> bool:
        with lock:
            return True

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait()
    taken = ended_well(forked(take))
    over.set()
    thread.join()
    assert taken


@given(
    st.lists(st.integers(1, 10**6), max_size=5),
    st.sampled_from([1, 2, 4, 8]),
    st.integers(8, 10**9),
)
def test_slabs_keep_the_limit_and_use_it(shape: list[int], itemsize: int, limit: int) -> None:
    chunk = slab_shape(shape, itemsize, limit)
    size = prod(chunk) * itemsize
    assert size <= limit
    assert all(1 <= part <= whole for part, whole in zip(chunk, shape, strict=True))
    assert size == prod(shape) * itemsize or size > limit / 4


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(1, 5)), min_size=1, max_size=3))
def test_regions_of_chunks_tile_the_array(axes: list[tuple[int, int]]) -> None:
    shape, chunk = (tuple(column) for column in zip(*axes, strict=True))
    covered = np.zeros(shape, dtype=int)
    for index in np.ndindex(*(-(-n // c) for n, c in axes)):
        covered[chunk_region(index, chunk, shape)] += 1
    np.testing.assert_array_equal(covered, 1)


def test_the_common_parts_of_all_chunks_make_the_region() -> None:
    values = np.arange(5 * 7).reshape(5, 7)
    bounds, chunk = [(1, 5), (2, 6)], (2, 3)
    region = np.zeros((4, 4), int)
    for index in np.ndindex(3, 2):
        in_region, in_chunk = common_part(index, chunk, bounds)
        region[in_region] += values[chunk_region(index, chunk, values.shape)][in_chunk]
    np.testing.assert_array_equal(region, values[1:5, 2:6])


def test_bounds_of_a_region() -> None:
    assert region_bounds((slice(None), slice(1, 3, 1)), (4, 5), "a") == [(0, 4), (1, 3)]
    for region in [(slice(0, 5),), (slice(2, 1),), (slice(0, 4, 2),), (slice(-1, 2),)]:
        with pytest.raises(RegionError, match=r"a: .* within 0\.\.4"):
            region_bounds(region, (4,), "a")
    with pytest.raises(RegionError, match="2 axes; the array has 1"):
        region_bounds((slice(0, 1), slice(0, 1)), (4,), "a")


def test_results_come_in_order_and_from_several_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_threads", lambda: 3)
    both = threading.Barrier(2, timeout=60)  # opens only when two threads wait

    def work(item: int) -> int:
        if item < 2:
            both.wait()
        return item * item

    assert list(in_threads(work, range(20))) == [item * item for item in range(20)]


def test_the_pool_grows_with_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    for count in (2, 5, 3):
        monkeypatch.setattr(parallel, "usable_threads", lambda count=count: count)
        all_at_once = threading.Barrier(count, timeout=60)
        assert len(list(in_threads(lambda _, meet=all_at_once: meet.wait(), range(count)))) == count


def test_calls_within_calls_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_threads", lambda: 3)
    sums = in_threads(
        lambda outer: sum(in_threads(lambda inner: outer * inner, range(30))), range(30)
    )
    assert list(sums) == [outer * sum(range(30)) for outer in range(30)]


def test_a_busy_pool_holds_no_work_that_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_threads", lambda: 2)
    pool, free = parallel._threads.pool(1), threading.Event()
    waiting = [pool.submit(free.wait, 60) for _ in range(pool._max_workers)]

    class Work:
        def __call__(self, number: int) -> int:
            return number

    work = Work()
    held = weakref.ref(work)
    try:
        assert list(in_threads(work, range(3))) == [0, 1, 2]
        del work
        assert held() is None  # else each decoded tile of a large layer stays until its end
    finally:
        free.set()
    assert all(each.result() for each in waiting)


def test_the_first_failure_is_raised_and_the_rest_is_left() -> None:
    begun: list[int] = []

    def work(item: int) -> int:
        begun.append(item)
        if item == 2:
            raise ValueError("two")
        return item

    with pytest.raises(ValueError, match="two"):
        list(in_threads(work, range(10_000)))
    assert len(begun) < 10_000


def test_without_threads_the_callers_own_does_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    class Exhausted:
        def pool(self, _: int) -> Exhausted:
            return self

        def submit(self, *_: object) -> None:
            raise RuntimeError("can't start new thread")

    monkeypatch.setattr(parallel, "usable_threads", lambda: 3)
    monkeypatch.setattr(parallel, "_threads", Exhausted())
    assert list(in_threads(abs, range(-4, 0))) == [4, 3, 2, 1]


def test_the_number_of_threads_may_be_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_threads", lambda: pytest.fail("was given"))
    both = threading.Barrier(2, timeout=60)
    assert len(list(in_threads(lambda _: both.wait(), range(2), 2))) == 2
    callers: list[int] = []
    assert (
        list(in_threads(lambda n: callers.append(threading.get_ident()), range(9), 1)) == [None] * 9
    )
    assert set(callers) == {threading.get_ident()}


@pytest.mark.parametrize("threads", [2, 5])
@pytest.mark.parametrize("count", [0, 1, 2 * ITEMS_PER_THREAD, 999])
def test_shares_hold_each_item_once(count: int, threads: int) -> None:
    shares: list[list[int]] = []
    share_out(lambda share: shares.append(list(share)), range(count), threads)
    assert sorted(item for share in shares for item in share) == list(range(count))
    assert len(shares) <= SHARES_PER_THREAD * threads
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_few_items_are_one_share_in_the_callers_thread() -> None:
    calls: list[tuple[int, int]] = []
    items = range(2 * ITEMS_PER_THREAD - 1)
    share_out(lambda share: calls.append((len(share), threading.get_ident())), items, 8)
    assert calls == [(len(items), threading.get_ident())]


def test_a_failure_in_a_share_is_raised() -> None:
    def work(share: Sequence[int]) -> None:
        if 50 in share:
            raise ValueError("fifty")

    with pytest.raises(ValueError, match="fifty"):
        share_out(work, range(100), 3)


@needs_fork
def test_a_forked_process_has_threads_of_its_own() -> None:
    assert next(iter(in_threads(abs, range(-8, 0)))) == 8
    assert ended_well(forked(lambda: list(in_threads(abs, range(-8, 0)))[-1] == 1))


def test_the_environment_says_how_many_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FHASH_THREADS", raising=False)
    assert usable_threads() >= 1
    monkeypatch.setenv("FHASH_THREADS", "3")
    assert usable_threads() == 3
    assert usable_threads(5) == 5


@pytest.mark.parametrize("threads", [0, -3])
def test_no_threads_are_refused(threads: int) -> None:
    with pytest.raises(InputError, match=f"threads is {threads}; at least 1 is needed"):
        usable_threads(threads)


@pytest.mark.parametrize("given", ["", "0", "-1", "2.5", "many", "99999999999", "\u00b2"])
def test_another_number_of_threads_is_refused(monkeypatch: pytest.MonkeyPatch, given: str) -> None:
    monkeypatch.setenv("FHASH_THREADS", given)
    with pytest.raises(InputError, match=r"FHASH_THREADS is '.*'; allowed: 1 to 1024"):
        usable_threads()


def test_few_items_are_read_ahead_and_results_come_in_order() -> None:
    read: list[int] = []
    yielded = 0

    def items() -> Iterator[int]:
        for item in range(50):
            assert item - yielded < 4
            read.append(item)
            yield item

    with thread_pool() as pool:
        for number, result in enumerate(map_ahead(pool, lambda item: item * item, items(), 4)):
            assert result == number * number
            yielded += 1
    assert read == list(range(50))


def test_what_was_not_begun_is_left_out_after_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "1")
    begun: list[int] = []

    def work(item: int) -> int:
        begun.append(item)
        if item == 2:
            raise ValueError("two")
        return item

    with thread_pool() as pool, pytest.raises(ValueError, match="two"):
        list(map_ahead(pool, work, range(100), 8))
    assert len(begun) < 100


def test_one_item_is_made_ahead_in_another_thread() -> None:
    made: list[int] = []
    caller = threading.current_thread()

    def items() -> Iterator[int]:
        for number in range(5):
            assert threading.current_thread() is not caller
            made.append(number)
            yield number
        raise ValueError("five")

    found = one_ahead(items())
    assert next(found) == 0
    found.close()
    assert made == [0, 1]
    made.clear()
    with pytest.raises(ValueError, match="five"):
        list(one_ahead(items()))
    assert made == list(range(5))
    assert list(one_ahead(iter([]))) == []


@pytest.mark.parametrize(("rows", "row", "threads"), [(1, 5, 4), (7, PART, 3), (2, PART, 9)])
def test_parts_hold_each_row_once_and_pay(rows: int, row: int, threads: int) -> None:
    parts = row_parts(rows, row, threads)
    assert [number for first, end in parts for number in range(first, end)] == list(range(rows))
    assert len(parts) == max(1, min(threads, rows, rows * row // PART))


def test_a_job_may_be_limited_to_some_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "6")
    seen = []
    with at_most(2):
        assert usable_threads() == 2
        other = threading.Thread(target=lambda: seen.append(usable_threads()))
        other.start()
        other.join()
        with at_most(9):
            assert usable_threads() == 6
        assert usable_threads(5) == 5
        with thread_pool() as pool:
            assert pool.submit(usable_threads).result() == 2
    assert seen == [6]  # another job of the process is not concerned
    assert usable_threads() == 6


def test_a_busy_pool_holds_no_results(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_threads", lambda: 2)
    begun, done = threading.Event(), threading.Event()

    class Large:
        """A result that can be watched."""

    def wait(item: int) -> None:
        begun.set()
        done.wait(60)

    occupied = threading.Thread(target=lambda: list(in_threads(wait, range(2))))
    occupied.start()
    assert begun.wait(60)
    held: list[weakref.ref[Large]] = []
    try:
        for result in in_threads(lambda item: Large(), range(4)):
            assert all(one() is None for one in held)
            held.append(weakref.ref(result))
        del result
        gc.collect()
        assert [one() for one in held] == [None] * 4
    finally:
        done.set()
        occupied.join()


def file(path: Path) -> Path:
    path.write_text("old")
    return path


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


@pytest.mark.parametrize(
    ("make", "force", "directory", "error", "message"),
    [
        (
            file,
            False,
            False,
            OutputExistsError,
            r"out exists; use --force \(force=True\) to replace it",
        ),
        (store, False, True, OutputExistsError, r"out exists; use --force"),
        (folder, False, False, OutputError, "out is a directory; give the name of a file"),
        (store, True, False, OutputError, "out is a directory; give the name of a file"),
        (folder, True, True, OutputError, "is a directory but no Zarr store"),
        (pipe, True, False, OutputError, "is not an ordinary file"),
        (
            lambda path: path / "x.npy",
            True,
            False,
            OutputError,
            r"the folder .*out does not exist; create it first",
        ),
        (lambda path: file(path) / "x.npy", True, False, OutputError, r"out is not a folder"),
    ],
)
def test_what_may_not_be_replaced(
    tmp_path: Path, make: Any, force: bool, directory: bool, error: type[Exception], message: str
) -> None:
    path = make(tmp_path / "out")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(error, match=message) as caught:
        check_output(path, force, directory=directory)
    assert "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("make", "directory"),
    [
        (lambda path: path, False),
        (lambda path: path, True),
        (file, False),
        (store, True),
        (file, True),
    ],
)
def test_what_may_be_written_with_force(tmp_path: Path, make: Any, directory: bool) -> None:
    check_output(make(tmp_path / "out"), True, directory=directory)


def test_a_folder_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        os, "access", lambda *_: False
    )  # the tests may run as root, whom no mode stops
    with pytest.raises(OutputError, match="no permission to write in"):
        check_output(tmp_path / "out", False)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (errno.ENOSPC, "no space left on the disk"),
        (errno.EDQUOT, "no space left on the disk"),
        (errno.EACCES, "no permission to write in"),
        (errno.EROFS, "no permission to write in"),
        (errno.EISDIR, "is a directory"),
        (errno.ENOTDIR, "is not a folder"),
        (errno.EFBIG, "cannot be written: File too large"),
    ],
)
def test_every_failure_is_one_line(tmp_path: Path, code: int, message: str) -> None:
    error = atomic.explained(tmp_path / "out", OSError(code, os.strerror(code)))
    assert message in str(error)
    assert "\n" not in str(error)
    assert "\n" not in str(atomic.explained(tmp_path / "out", OSError("two\nlines")))


def itself(folder: Path) -> tuple[Path, Path]:
    return file(folder / "a.npy"), folder / "a.npy"


def by_link(folder: Path) -> tuple[Path, Path]:
    (folder / "link.npy").symlink_to(file(folder / "a.npy"))
    return folder / "a.npy", folder / "link.npy"


def link_to_it(folder: Path) -> tuple[Path, Path]:
    return by_link(folder)[::-1]


def by_hard_link(folder: Path) -> tuple[Path, Path]:
    os.link(file(folder / "a.npy"), folder / "b.npy")
    return folder / "a.npy", folder / "b.npy"


def not_there(folder: Path) -> tuple[Path, Path]:
    return folder / "x" / ".." / "a.npy", folder / "a.npy"


def inside(folder: Path) -> tuple[Path, Path]:
    return store(folder / "a.zarr"), folder / "a.zarr" / "c" / "0"


def new_inside(folder: Path) -> tuple[Path, Path]:
    return store(folder / "a.zarr"), folder / "a.zarr" / "run.fhz"


def around(folder: Path) -> tuple[Path, Path]:
    return store(folder / "a.zarr") / "c" / "0", folder / "a.zarr"


@pytest.mark.parametrize("force", [True, False])
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (itself, "is the input itself; choose another name"),
        (by_link, "is the input itself"),
        (link_to_it, "is the input itself"),
        (by_hard_link, "is the input itself"),
        (not_there, "is the input itself"),
        (inside, "lies inside the input"),
        (new_inside, "lies inside the input"),
        (around, "contains the input"),
    ],
)
def test_no_output_is_its_own_input(tmp_path: Path, make: Any, words: str, force: bool) -> None:
    source, path = make(tmp_path)
    for name in (source, str(source)):
        with pytest.raises(InputError, match=words) as caught:
            check_output(path, force, directory=path.is_dir(), sources=[tmp_path / "other", name])
        assert "--force" not in str(caught.value)
    check_output(
        path.with_name("out.npy") if make is not inside else tmp_path / "out",
        False,
        sources=[tmp_path / "a.npy"],
    )


def test_a_link_into_a_folder_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "out.npy").symlink_to(tmp_path / "gone" / "out.npy")
    with pytest.raises(
        OutputError,
        match=r"out.npy is a link to .*, and the folder .*gone does not exist; create it",
    ):
        check_output(tmp_path / "out.npy", True)
