"""A lock that is free in a forked process."""

from __future__ import annotations

import os
import signal
import threading

import pytest

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


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_process_finds_it_free_although_a_thread_of_its_parent_holds_it() -> None:
    lock, held, over = ForkLock(), threading.Event(), threading.Event()

    def hold() -> None:
        with lock:
            held.set()
            over.wait()

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait()
    child = os.fork()
    if child == 0:
        signal.alarm(30)  # kills the child where it hangs
        with lock:
            os._exit(0)
    status = os.waitpid(child, 0)[1]
    over.set()
    thread.join()
    assert status == 0
