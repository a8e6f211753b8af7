"""The time that `fhash cost` may take: shares of its parts, and an end to work that overruns."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fhash_codec.cost.results import LeftOut
from fhash_codec.progress import Progress
from fhash_formats.errors import FhashError

OVERRUN = 0.25
"""Share of its time by which work that has begun may exceed it."""


class BudgetSpentError(Exception):
    """The end of work whose time is over; it never leaves this room."""


class Allowance:
    """A number of seconds that is spent part by part.

    Attributes:
        seconds: all of them.
        left_out: what was not measured so far, and why.
        interrupted: whether Ctrl-C ended the measurements.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.perf_counter) -> None:
        """Begin to spend; clock gives seconds."""
        self.seconds, self._clock = seconds, clock
        self._begun = clock()
        self._end = seconds
        self.left_out: list[LeftOut] = []
        self.interrupted = False

    @property
    def spent(self) -> float:
        """Seconds since the beginning."""
        return self._clock() - self._begun

    @property
    def left(self) -> float:
        """Seconds until the end of the present part, 0 at least."""
        return max(self._end - self.spent, 0.0)

    def part(self, end: float) -> None:
        """Begin a part that ends at a share of all seconds, 0 to 1."""
        self._end = end * self.seconds

    def has(self, what: str, seconds: float, *, share: float = 1.0) -> bool:
        """Whether work of some seconds fits in a share of what is left of the part.

        Where it does not, it is noted as left out; where it does, an older note of it is dropped.
        """
        if self.interrupted:
            self.leave_out(what, "interrupted")
            return False
        allowed = share * self.left
        if seconds <= allowed and allowed > 0:
            self.left_out = [entry for entry in self.left_out if entry.what != what]
            return True
        why = f"needs about {seconds:.3g} s; {allowed:.3g} s were left for it"
        self.leave_out(what, why, late=True)
        return False

    def leave_out(self, what: str, why: str, *, late: bool = False) -> None:
        """Note what is not measured, in place of an older note; late: time alone is wanting."""
        self.left_out = [entry for entry in self.left_out if entry.what != what]
        self.left_out.append(LeftOut(what=what, why=why, late=late))

    @contextmanager
    def work(self, what: str) -> Iterator[None]:
        """A block of work; noted as left out where it fails, its time is over or Ctrl-C comes."""
        try:
            yield
        except BudgetSpentError:
            self.leave_out(what, "took longer than its share of the time; stopped", late=True)
        except FhashError as error:
            self.leave_out(what, str(error))
        except KeyboardInterrupt:
            self.interrupted = True
            self.leave_out(what, "interrupted")

    def guard(self, progress: Progress, *, share: float = 1.0) -> Progress:
        """A progress callback that raises BudgetSpentError where its time is over.

        share: share of what is left of the part now; OVERRUN of it is added.
        """
        end = self.spent + share * self.left * (1 + OVERRUN)

        def guarded(stage: str, done: int, total: int, note: str) -> None:
            progress(stage, done, total, note)
            if self.spent > end:
                raise BudgetSpentError

        return guarded
