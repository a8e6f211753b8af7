"""Work in threads: order, failures, and what is left undone."""

from __future__ import annotations

import threading
import time

import pytest

from fhash_formats.container import parallel
from fhash_formats.container.parallel import in_threads


@pytest.mark.parametrize("threads", [1, 2, 4])
@pytest.mark.parametrize("count", [0, 1, 3, 50])
def test_results_come_in_the_order_of_the_items(monkeypatch, threads, count):
    monkeypatch.setattr(parallel, "usable_threads", lambda: threads)
    assert list(in_threads(lambda item: item * item, range(count))) == [item * item for item in range(count)]


def test_the_callers_thread_works_as_well(monkeypatch):
    monkeypatch.setattr(parallel, "usable_threads", lambda: 3)
    together = threading.Barrier(3, timeout=30)
    names = list(in_threads(lambda _: (together.wait(), threading.current_thread())[1], range(3)))
    assert len(set(names)) == 3
    assert threading.current_thread() in names


@pytest.mark.parametrize("threads", [1, 4])
def test_the_first_failure_is_raised_and_the_rest_left_undone(monkeypatch, threads):
    monkeypatch.setattr(parallel, "usable_threads", lambda: threads)
    begun = []

    def work(item):
        begun.append(item)
        time.sleep(0.001)
        if item >= 3:
            raise ValueError(str(item))
        return item

    results = in_threads(work, range(1000))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="3"):
        next(results)
    assert len(begun) < 1000
    assert not [thread for thread in threading.enumerate() if thread.name == "fhash"]
