"""Search for a quantiser step by the loss in dB that coding with it costs.

The error of coded tables is their error before coding plus what coding adds. The added error grows
about as the square of the step, so its logarithm over that of the step is nearly a straight line,
which secants follow. The search ends in a window of PSNR: its lower end is what must be kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fhash_codec.compact.choices.search import Bracket, geometric_mean

AIM = 0.4
"""Place in the window at which the search aims, as a share of its width above the lower end."""
SLOPE = 2.0
"""Usual change of the logarithm of the added error for one of the logarithm of the step."""
MIN_SLOPE = 0.5
"""Smallest slope of a secant that is believed."""
MAX_SLOPE = 6.0
"""Largest slope of a secant that is believed."""
MIN_SHARE = 1e-6
"""Smallest added error that counts in the search, as a share of the allowed one."""
CLOSEST = 1 + 1e-5
"""Ratio of two steps that are too close for another one between them."""
LONGEST = 64.0
"""Largest ratio of a step to the one before it."""


@dataclass(frozen=True)
class Window:
    """Mean squared errors that end a search.

    Attributes:
        exact: error before coding.
        least: error below which a smaller file keeps the promise as well.
        allowed: largest error.
    """

    exact: float
    least: float
    allowed: float

    @classmethod
    def of(cls, exact: float, allowed: float, width: float) -> Window:
        """Return the window that begins at an allowed error and is so many dB wide.

        It is narrower where the error before coding leaves less room.
        """
        room = 10 * math.log10(allowed / exact) if exact > 0 else math.inf
        return cls(exact, allowed * 10 ** (-min(width, room / 2) / 10), allowed)

    @property
    def aim(self) -> float:
        """Error that coding should add."""
        return float(self.least**AIM * self.allowed ** (1 - AIM)) - self.exact

    def has_room(self, error: float) -> bool:
        """Return whether an error keeps the promise, and a smaller file may keep it as well."""
        return error < self.least


class StepSearch:
    """Steps to try, one after the other, until the error lies in a window.

    Attributes:
        step: the step to try next.
        best: the largest step that kept the allowed error; None for none so far.
        done: whether another trial would gain nothing.
    """

    def __init__(self, window: Window, step: float, min_step: float) -> None:
        """Begin a search at a step; no step is smaller than `min_step`."""
        self.step = max(step, min_step)
        self.best: float | None = None
        self.done = False
        self._window, self._min_step = window, min_step
        self._bracket = Bracket(min_step, math.inf, middle=geometric_mean)
        self._points: list[tuple[float, float]] = []

    def add(self, error: float) -> bool:
        """Take up the mean squared error that `step` gave, and choose the next step.

        Returns whether the search is done.
        """
        window, step = self._window, self.step
        kept = error <= window.allowed
        if kept and (self.best is None or step > self.best):
            self.best = step
        self._bracket = self._bracket.narrowed(step, too_low=kept)
        added = max(error - window.exact, MIN_SHARE * window.aim)
        self._points.append((math.log(step), math.log(added)))
        at_limit = step <= self._min_step and not kept
        if window.least <= error <= window.allowed or at_limit:
            self.done = True
            return True
        self.step = max(self._next(), self._min_step)
        self.done = self.step in (step, self.best) or self._bracket.high < CLOSEST * max(
            self._bracket.low, self._min_step
        )
        return self.done

    def _next(self) -> float:
        """Return the step at which the aim should be met, inside of what was tried."""
        log_step, log_added = self._points[-1]
        slope = SLOPE
        if len(self._points) > 1:
            other_step, other_added = min(
                self._points[:-1], key=lambda point: abs(point[0] - log_step)
            )
            if other_step != log_step:
                slope = (log_added - other_added) / (log_step - other_step)
            slope = min(max(slope, MIN_SLOPE), MAX_SLOPE)
        change = (math.log(self._window.aim) - log_added) / slope
        longest = math.log(LONGEST)
        prediction = math.exp(log_step + min(max(change, -longest), longest))
        return self._min_step if prediction <= self._min_step else self._bracket.inside(prediction)
