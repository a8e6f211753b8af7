"""A lock that is free in a forked process."""

from __future__ import annotations

import threading

from forked import ended_well, forked, needs_fork

from fhash_formats.support.fork_lock import ForkLock


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
