"""Ctrl-C that waits for a moment when nothing is half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

HELD = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""The last is not everywhere."""


@contextmanager
def signals_held() -> Iterator[None]:
    """Python's handlers of SIGINT, SIGTERM and SIGHUP run after the block and not inside it; only the main thread ever runs them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def hold(number: int, frame: FrameType | None) -> None:
        came.append(number)

    handlers = {number: handler for number in HELD if callable(handler := signal.getsignal(number))}
    try:
        for number in handlers:
            signal.signal(number, hold)
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for missed in came:
            handlers[signal.Signals(missed)](missed, None)
