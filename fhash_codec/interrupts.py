"""Ctrl-C as a request that work answers at its next safe point, so that no state is torn."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

REQUESTS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
SAME_REQUEST_SECONDS = 1.0  # shells, make and batch systems may deliver one request several times


class StopRequest:
    """Whether the user has asked to stop."""

    def __init__(self) -> None:
        self.asked = False
        self.since = 0.0


@contextmanager
def deferred_interrupts() -> Iterator[StopRequest]:
    """Within it the first SIGINT, SIGTERM or SIGHUP sets `asked`, and one more than a second later raises KeyboardInterrupt at once.

    SIGTERM counts because batch systems send it before they kill a job, SIGHUP because a lost connection does. Signals reach only
    the main thread; elsewhere nothing is changed and `asked` stays false.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if request.asked and time.monotonic() > request.since + SAME_REQUEST_SECONDS:
            raise KeyboardInterrupt
        if not request.asked:
            request.asked, request.since = True, time.monotonic()

    # A signal that is ignored stays ignored: nohup does that with SIGHUP.
    heeded = [number for number in REQUESTS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, ask) for number in heeded}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
