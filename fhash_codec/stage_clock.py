"""Record of the stages of an encoding: the seconds that each took, and why it ran or did not.

The encoder enters a stage wherever its work begins:

    with stage("head", "--effort 5 trains one"):
        ...

A stage inside another takes its seconds from that one, so that the seconds of all stages add up to
the whole. Without a recording clock a stage costs nothing and leaves no trace, and neither does one
that other threads enter.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from typing import Any

OTHER = "other"
"""Name of what no stage was entered for."""


@dataclass(kw_only=True)
class Stage:
    """Record of a stage.

    Attributes:
        stage: its name.
        seconds: wall clock time in it, without that of the stages inside.
        times: how often it was entered; 0 for a stage that was left out.
        why: why it ran, or was left out.
    """

    stage: str
    seconds: float = 0.0
    times: int = 0
    why: str = ""


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


@contextmanager
def stage(name: str, why: str) -> Iterator[None]:
    """Enter a stage of the job that is recorded, if there is one; see `StageClock.stage`."""
    clock = _clock.get()
    if clock is None:
        yield
        return
    with clock.stage(name, why):
        yield


def skip(name: str, why: str) -> None:
    """Record that a stage is left out; see `StageClock.skip`."""
    clock = _clock.get()
    if clock is not None:
        clock.skip(name, why)


def attribute(name: str, why: str, seconds: float) -> None:
    """Count seconds of the open stage for another one; see `StageClock.attribute`."""
    clock = _clock.get()
    if clock is not None:
        clock.attribute(name, why, seconds)


def tell(name: str, why: str) -> None:
    """Replace the reason of a stage by what came of it; see `StageClock.tell`."""
    clock = _clock.get()
    if clock is not None:
        clock.tell(name, why)
