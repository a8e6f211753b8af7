"""Coding of all tiles so that they take a number of bytes, for the promise of a ratio."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from fhash_codec.compact.choices.search import EXCHANGE, SLOPE, Bracket, arithmetic_mean
from fhash_codec.compact.choices.step import MAX_STEP_SHARE, with_step
from fhash_codec.compact.coded_table import CodedTable
from fhash_codec.compact.goal import RATIO_SLACK, Goal
from fhash_codec.compact.plan import CodingPlan
from fhash_codec.compact.tiles.coding import MIN_STEP_SHARE

__all__ = ["ByteWindow", "code_to_size", "is_exact"]

PASSES = 10
"""Times that all tiles are coded at most."""
USUAL_FALL = SLOPE / EXCHANGE
"""Octaves of bytes that a step larger by a factor of e saves: the first assumption."""
CodeAll = Callable[[CodingPlan], CodedTable]
"""Function that codes all tiles by a plan."""


@dataclass(frozen=True)
class ByteWindow:
    """Bytes that the tiles of a file may take, from `low` to `high`."""

    low: float
    high: float

    @classmethod
    def of(cls, goal: Goal, overhead: float) -> ByteWindow:
        """Return the window of a promised size. overhead: bytes of the file that are no tiles."""
        assert goal.size is not None
        return cls(goal.size / RATIO_SLACK - overhead, goal.size - overhead)

    def holds(self, table: CodedTable) -> bool:
        """Whether a table lies in the window."""
        return self.low <= table.outcome.size <= self.high

    def prefers(self, table: CodedTable, other: CodedTable) -> bool:
        """Whether a table is nearer to the window; one below it is nearer than one above."""
        size, other_size = table.outcome.size, other.outcome.size
        if max(size, other_size) > self.high:
            return size < other_size
        return size > other_size


def is_exact(table: CodedTable) -> bool:
    """Whether the values decode exactly, whole numbers after rounding: more bytes give nothing."""
    limit = 0.5 if table.plan.blocks.dtype.kind in "iu" else 0.0
    error = table.outcome.max_error
    return error == 0 or error < limit


def code_to_size(table: CodedTable, window: ByteWindow, code_all: CodeAll) -> CodedTable:
    """Code all tiles again with step after step until they take the bytes of a window.

    table: of the step to begin with. It is returned if it fits already, and where it is too small
        although its values are exact. Where no step fits, the best table below the window is, or
        the smallest.
    """
    plan, best = table.plan, table
    if plan.goal.data_range <= 0:
        return table
    data_range = max(plan.goal.data_range, 1e-300)
    bracket = Bracket(
        math.log(data_range * MIN_STEP_SHARE),
        math.log(data_range * MAX_STEP_SHARE),
        middle=arithmetic_mean,
    )
    target = max((window.low + window.high) / 2, 1.0)
    fall, before = USUAL_FALL, None
    for _ in range(PASSES):
        size, log_step = table.outcome.size, math.log(table.plan.settings.step)
        if window.holds(table) or (size < window.low and is_exact(table)):
            break
        bracket = bracket.narrowed(log_step, too_low=size > window.high)
        if before is not None and (before[0] - log_step) * (size - before[1]) > 0:
            measured = math.log2(size / before[1]) / (before[0] - log_step)
            fall = min(max(measured, USUAL_FALL / 4), USUAL_FALL * 4)
        before = log_step, size
        log_step = bracket.inside(log_step + math.log2(max(size, 1) / target) / fall)
        settings = with_step(table.plan.settings, math.exp(log_step), plan.goal)
        table = code_all(replace(plan, settings=settings))
        if window.prefers(table, best):
            best = table
    return best
