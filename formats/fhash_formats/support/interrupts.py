"""Signals that ask a process to stop, delayed until no work is half done.

Two blocks delay them: `signals_held` for a few system calls, `deferred_interrupts` for hours of
work that looks for a request at its safe points. Python delivers signals to the main thread only;
in other threads both blocks change nothing.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

STOP_SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
"""Signals that ask to stop: Ctrl-C, the end of a batch job, a lost connection (not on Windows)."""
SAME_REQUEST_SECONDS = 1.0
"""Time within which a second signal repeats the first: shells and batch systems send several."""

Handler = Callable[[int, FrameType | None], Any]


class StopRequest:
    """A request to stop: `asked` says whether it was made, `since` when (`time.monotonic`)."""

    def __init__(self) -> None:
        self.asked = False
        self.since = 0.0


@contextmanager
def deferred_interrupts() -> Iterator[StopRequest]:
    """A block in which a stop signal sets `asked` of the request, which the work then looks at.

    A further signal more than SAME_REQUEST_SECONDS later raises KeyboardInterrupt at once. A signal
    that is ignored stays ignored: `nohup` ignores SIGHUP.
    """
    request = StopRequest()

    def ask(number: int, frame: FrameType | None) -> None:
        if request.asked and time.monotonic() > request.since + SAME_REQUEST_SECONDS:
            raise KeyboardInterrupt
        if not request.asked:
            request.asked, request.since = True, time.monotonic()

    with _handled_by(ask, lambda handler: handler is not signal.SIG_IGN):
        yield request


@contextmanager
def signals_held() -> Iterator[None]:
    """A block within which no Python handler of a stop signal runs; the handlers run after it.

    A signal without a Python handler, such as SIGTERM by default, ends the process at once as ever.
    """
    missed: list[int] = []

    def hold(number: int, frame: FrameType | None) -> None:
        missed.append(number)

    handlers: dict[signal.Signals, Any] = {}
    try:
        with _handled_by(hold, callable) as handlers:
            yield
    finally:
        for number in missed:
            handlers[signal.Signals(number)](number, None)


@contextmanager
def _handled_by(
    handler: Handler, replaced: Callable[[object], bool]
) -> Iterator[dict[signal.Signals, Any]]:
    """A block in which `handler` gets the stop signals whose present handler is to be `replaced`.

    Yields the handlers that were replaced, and puts them back after the block. Outside the main
    thread, which alone may set handlers, none is replaced.
    """
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        present = {number: signal.getsignal(number) for number in STOP_SIGNALS}
        before = {number: previous for number, previous in present.items() if replaced(previous)}
    try:
        for number in before:
            signal.signal(number, handler)
        yield before
    finally:
        _restore(before)


def _restore(handlers: dict[signal.Signals, Any]) -> None:
    """Put handlers back, all of them, even where one that is back already raises on the way."""
    remaining = list(handlers)
    raised: BaseException | None = None
    while remaining:
        try:
            while remaining:
                signal.signal(remaining[-1], handlers[remaining[-1]])
                remaining.pop()
        except BaseException as error:
            raised = error
    if raised is not None:
        raise raised
