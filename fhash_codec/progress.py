"""Progress of long work: one callback, called with the stage, what is done of it, and a note."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int, str], None]
"""(stage, done, total, note), e.g. ("training", 3, 20, "41.2 dB").

Within a stage `done` runs from 1 to `total`.
"""


def silent(stage: str, done: int, total: int, note: str) -> None:
    """A Progress that reports nothing."""
