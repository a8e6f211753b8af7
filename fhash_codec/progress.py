"""Progress of long work, for whoever watches it, and clocks of its stages."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from typing import Annotated, Any

Progress = Callable[[str, int, int, str], None]
"""(stage, done, total, note), e.g. ("training", 3, 20, "41.2 dB").

Within a stage `done` runs from 0 or 1 to `total`, which is at least 1. It stays where it is while
the note alone moves. A codec calls it in the thread that called the codec, never in another.
"""


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

    def _tell(self) -> None:
        note = f"{self._what}, {self._trials} tiles tried" if self._trials else self._what
        self._call(self._stage, self.done, self._total, note)

    def _call(self, stage: str, done: int, total: int, note: str) -> None:
        if threading.get_ident() == self._owner:
            self._progress(stage, done, total, note)


OTHER = "other"
"""Name of what no stage was entered for."""


@dataclass(kw_only=True)
class Stage:
    """Record of a stage."""

    stage: Annotated[str, "its name"]
    seconds: Annotated[float, "wall clock time in it, without that of the stages inside"] = 0.0
    times: Annotated[int, "how often it was entered; 0 for a stage that was left out"] = 0
    why: Annotated[str, "why it ran, or was left out"] = ""


class StageClock:
    """Clock of the stages of one job, which begins to count when it is made."""

    def __init__(self) -> None:
        self._begun = time.perf_counter()
        self._stages: dict[str, Stage] = {}
        self._inside: list[float] = []
        """Seconds of the stages inside each open stage, the innermost last."""

    @contextmanager
    def stage(self, name: str, why: str) -> Iterator[None]:
        """Count the time in the context for a stage; the first reason stays."""
        begun = time.perf_counter()
        entered = self._record(name, why)
        entered.times += 1
        self._inside.append(0.0)
        try:
            yield
        finally:
            seconds = time.perf_counter() - begun
            entered.seconds += max(seconds - self._inside.pop(), 0.0)
            self._add_inside(seconds)

    def skip(self, name: str, why: str) -> None:
        """Record that a stage is left out; one that was entered before stays as it is."""
        self._record(name, why)

    def tell(self, name: str, why: str) -> None:
        """Replace the reason of a stage by what came of it."""
        self._record(name, why).why = why

    def attribute(self, name: str, why: str, seconds: float) -> None:
        """Count seconds of the open stage for another one, whose work lies between its own."""
        part = self._record(name, why)
        part.times += 1
        part.seconds += seconds
        self._add_inside(seconds)

    def stages(self) -> list[Stage]:
        """Return the stages in the order in which they came first, and the rest as OTHER."""
        total = time.perf_counter() - self._begun
        rest = max(total - sum(stage.seconds for stage in self._stages.values()), 0.0)
        other = Stage(stage=OTHER, seconds=rest, times=1, why="all that no stage is named for")
        return [*self._stages.values(), other]

    def to_list(self) -> list[dict[str, Any]]:
        """Return the stages as JSON values, seconds to the tenth of a millisecond."""
        return [{**asdict(stage), "seconds": round(stage.seconds, 4)} for stage in self.stages()]

    def _record(self, name: str, why: str) -> Stage:
        """Return the record of a stage, made where there is none; a reason to run goes first."""
        record = self._stages.setdefault(name, Stage(stage=name))
        if record.times == 0:
            record.why = why
        return record

    def _add_inside(self, seconds: float) -> None:
        if self._inside:
            self._inside[-1] += seconds


_clock: ContextVar[StageClock | None] = ContextVar("stage clock", default=None)


@contextmanager
def recording() -> Iterator[StageClock]:
    """Record the stages that are entered in the context."""
    clock = StageClock()
    token = _clock.set(clock)
    try:
        yield clock
    finally:
        _clock.reset(token)


def _present() -> StageClock:
    """The clock of the job that is recorded; one that nobody reads where there is none."""
    return _clock.get() or StageClock()


def stage(name: str, why: str) -> AbstractContextManager[None]:
    """Enter a stage of the job that is recorded, if there is one; see `StageClock.stage`."""
    return _present().stage(name, why)


def skip(name: str, why: str) -> None:
    """Record that a stage is left out; see `StageClock.skip`."""
    _present().skip(name, why)


def attribute(name: str, why: str, seconds: float) -> None:
    """Count seconds of the open stage for another one; see `StageClock.attribute`."""
    _present().attribute(name, why, seconds)


def tell(name: str, why: str) -> None:
    """Replace the reason of a stage by what came of it; see `StageClock.tell`."""
    _present().tell(name, why)
