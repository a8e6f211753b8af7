"""Progress and messages on stderr: a bar that moves on a terminal, lines now and then elsewhere."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
import unicodedata
from types import TracebackType

import click

QUIET_SECONDS = 1.0
"""Seconds of a command that show no progress, so that short commands stay silent."""
LINES_AFTER = 2.0
"""Seconds of a stage from which on it prints lines where there is no terminal."""
LINE_SECONDS = 10.0
"""Seconds after which a line is printed at the latest where there is no terminal."""
BEAT_SECONDS = 0.5
"""Seconds between two looks at the clock while no report comes."""
DRAW_SECONDS = 0.1
"""Seconds between two drawings of the bar at least."""
BAR_CELLS = 24
"""Characters of a full bar."""
UNEVEN_STAGES = frozenset({"planning"})
"""Stages whose parts take different times, so that no time left is foretold."""


def one_line(text: str) -> str:
    """The text with an escape such as "\\n" for each character that a terminal would obey.

    Names and texts of a file could otherwise forge lines, and clear or colour the screen.
    """
    if text.isprintable():
        return text
    return "".join(
        char
        if char.isprintable() or unicodedata.category(char) == "Zs"
        else char.encode("unicode_escape").decode("ascii")
        for char in text
    )


def say(message: str) -> None:
    """One line on stderr, in place of a bar that is drawn there."""
    for bar in tuple(_drawn):
        bar.erase()
    click.echo(f"fhash: {one_line(message)}", err=True)


def clock(seconds: float) -> str:
    """Seconds as minutes and seconds, such as 2:20 or 1:02:20."""
    minutes, rest = divmod(round(seconds), 60)
    return (
        f"{minutes // 60}:{minutes % 60:02}:{rest:02}" if minutes >= 60 else f"{minutes}:{rest:02}"
    )


class Progress:
    """The codec's progress callback (stage, done, total, note), as a context manager.

    On a terminal it draws a bar from QUIET_SECONDS on. The bar shows the time that passed, so that
    it moves even while no report comes. Elsewhere it prints a line every 10 % of a stage that takes
    longer than LINES_AFTER, and one every LINE_SECONDS. `quiet` shows nothing at all. Leaving the
    context removes the bar.
    """

    def __init__(self, *, quiet: bool) -> None:
        self.quiet = quiet
        self.terminal = sys.stderr is not None and sys.stderr.isatty()
        self._stage, self._done, self._total, self._note = "", 0, 1, ""
        self._begun = self._stage_begun = self._last = time.monotonic()
        self._shown = self._said = self._begun
        self._tenth = 0
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Progress:
        if not self.quiet and sys.stderr is not None:
            self._thread = threading.Thread(target=self._watch, name="fhash-progress", daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        self.erase()

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Report that `done` of `total` parts of a stage are done.

        note: a remark such as "41.2 dB".
        """
        if self.quiet:
            return
        with self._lock:
            now = time.monotonic()
            if stage != self._stage:
                # The first report may follow the first part: the stage began after the last.
                self._stage, self._stage_begun, self._tenth = stage, self._last, 0
            self._last = now
            self._done, self._total, self._note = done, max(total, 1), note
            if self.terminal:
                self._draw(now, whole=done == total)
            else:
                self._line(now)

    def beat(self) -> None:
        """Show that time passes, where no report came."""
        with self._lock:
            now = time.monotonic()
            if self.terminal:
                self._draw(now)
            elif self._stage and now - self._said >= LINE_SECONDS:
                self._print(now)

    def erase(self) -> None:
        """Remove the bar; the next report draws it again."""
        with self._lock:
            if self in _drawn:
                _drawn.remove(self)
                click.echo("\r\x1b[K", err=True, nl=False)

    def _watch(self) -> None:
        while not self._ended.wait(BEAT_SECONDS):
            try:
                self.beat()
            except (OSError, ValueError):  # stderr was closed
                return

    def _line(self, now: float) -> None:
        """Print a line if a stage that takes long has come to another tenth."""
        tenth = math.floor(10 * self._done / self._total)
        if now - self._stage_begun < LINES_AFTER:
            self._tenth = tenth
        elif tenth > self._tenth or now - self._said >= LINE_SECONDS:
            self._tenth = max(tenth, self._tenth)
            self._print(now)

    def _print(self, now: float) -> None:
        self._said = now
        share = f" {self._done / self._total:.0%}" if self._total > 1 else ""
        say(f"{self._stage}{share}{self._remarks(now)}")

    def _draw(self, now: float, *, whole: bool = False) -> None:
        """Draw the bar, unless it was drawn a moment ago."""
        if now - self._begun < QUIET_SECONDS:
            return
        if self in _drawn and now - self._shown < DRAW_SECONDS and not whole:
            return
        remarks = self._remarks(now)
        if self._total == 1:
            bar, remarks = "", remarks.replace(", ", " ", 1)
        else:
            filled = round(BAR_CELLS * self._done / self._total)
            bar = f" {'#' * filled}{'-' * (BAR_CELLS - filled)} {self._done / self._total:4.0%}"
        stage = self._stage or "starting"
        passed = clock(now - self._begun)
        text = f"{stage:10}{bar}{remarks} [{passed}]"
        click.echo(f"\r{text[: _columns()]}\x1b[K", err=True, nl=False)
        self._shown = now
        if self not in _drawn:
            _drawn.append(self)

    def _remarks(self, now: float) -> str:
        """The note, and the time left where the parts of the stage take equally long."""
        share = self._done / self._total
        passed = now - self._stage_begun
        note = f", {one_line(self._note)}" if self._note else ""
        if not 0 < share < 1 or self._stage in UNEVEN_STAGES:
            return note
        # Reckoned to the last report, and less what passed since then: it counts down.
        reported = self._last - self._stage_begun
        return f"{note}, {clock(max(reported / share - passed, 0))} left"


def _columns() -> int:
    """Characters that fit into a line of the terminal: a longer line could not be drawn anew."""
    try:
        columns = os.get_terminal_size(sys.stderr.fileno()).columns
    except (OSError, ValueError):
        columns = 0
    return columns - 1 if columns > 1 else 120


_drawn: list[Progress] = []
"""Bars that are drawn on the terminal: one at most, but tests may run several commands."""
