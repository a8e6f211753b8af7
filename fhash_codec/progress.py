"""Progress of long work: one callback, called with the stage, what is done of it, and a note."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from typing import Any

Progress = Callable[[str, int, int, str], None]
"""(stage, done, total, note), e.g. ("training", 3, 20, "41.2 dB").

Within a stage `done` runs from 0 or 1 to `total`, which is at least 1. It stays where it is while
the note alone moves. A codec calls it in the thread that called the codec, never in another.
"""

POLL_SECONDS = 0.2
"""Seconds after which a wait for other threads looks for news."""


def silent(stage: str, done: int, total: int, note: str) -> None:
    """A Progress that reports nothing."""


class Parts:
    """A stage of several parts, whose trials are counted since their number is not known before.

    Attributes:
        done: number of finished parts.
    """

    def __init__(self, stage: str = "working", total: int = 1, progress: Progress = silent) -> None:
        """Begin a stage of `total` parts. The calling thread alone will call `progress`."""
        self.done = 0
        self._stage, self._total, self._progress = stage, total, progress
        self._what, self._trials = "", 0
        self._reported = "", 0
        self._owner = threading.get_ident()

    def begin(self, what: str) -> None:
        """Report that a part begins, named `what`; all before it are finished."""
        self.done += bool(self._what)
        self._what, self._trials = what, 0
        self._tell()

    def tick(self) -> None:
        """Count a finished trial of the part; any thread may do so."""
        self._trials += 1
        self._tell()

    def end(self) -> None:
        """Report that all parts are finished."""
        self.done, self._what = self._total, ""
        self._tell()

    def report(self, stage: str, share: float) -> None:
        """Report the share that is done of a stage whose end is known, in percent."""
        percent = int(100 * min(max(share, 0.0), 1.0))
        if (stage, percent) != self._reported:
            self._reported = stage, percent
            self._call(stage, percent, 100, "")

    def wait(
        self,
        works: Sequence[Future[Any]],
        stage: str,
        share: Callable[[], float],
        *,
        poll_seconds: float = POLL_SECONDS,
    ) -> None:
        """Wait until all works of other threads are done or one has failed, and report them.

        stage: the work until `share` is 1; then it goes on with trials of the present part.
        share: share of the stage that is done, 0 to 1.
        """
        pending: set[Future[Any]] = set(works)
        while pending and not any(work.done() and work.exception() for work in works):
            pending = wait(pending, timeout=poll_seconds)[1]
            if (done := share()) < 1:
                self.report(stage, done)
            else:
                self._tell()

    def _tell(self) -> None:
        note = f"{self._what}, {self._trials} tiles tried" if self._trials else self._what
        self._call(self._stage, self.done, self._total, note)

    def _call(self, stage: str, done: int, total: int, note: str) -> None:
        if threading.get_ident() == self._owner:
            self._progress(stage, done, total, note)
