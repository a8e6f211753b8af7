"""Work in threads: order, failures, calls within calls, and processes that fork."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator

import pytest

from fhash_formats.errors import InputError
from fhash_formats.support import threads as parallel
from fhash_formats.support.threads import (
    in_threads,
    map_ahead,
    thread_pool,
    usable_threads,
)


def test_results_come_in_order_and_from_several_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_threads", lambda: 3)
    both = threading.Barrier(2, timeout=60)  # passes only where two threads meet

    def work(item: int) -> int:
        if item < 2:
            both.wait()
        return item * item

    assert list(in_threads(work, range(20))) == [item * item for item in range(20)]


def test_the_threads_grow_with_what_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    for count in (2, 5, 3):
        monkeypatch.setattr(parallel, "usable_threads", lambda count=count: count)
        all_at_once = threading.Barrier(count, timeout=60)
        assert len(list(in_threads(lambda _, meet=all_at_once: meet.wait(), range(count)))) == count


def test_calls_within_calls_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_threads", lambda: 3)
    found = in_threads(
        lambda outer: sum(in_threads(lambda inner: outer * inner, range(30))), range(30)
    )
    assert list(found) == [outer * sum(range(30)) for outer in range(30)]


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


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own() -> None:
    assert next(iter(in_threads(abs, range(-8, 0)))) == 8
    child = os.fork()
    if child == 0:
        signal.alarm(30)  # kills the child where it hangs
        os._exit(0 if list(in_threads(abs, range(-8, 0)))[-1] == 1 else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_the_environment_says_how_many_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FHASH_THREADS", raising=False)
    assert usable_threads() >= 1
    monkeypatch.setenv("FHASH_THREADS", "3")
    assert usable_threads() == 3


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
