"""Search for the coarsest setting of a codec that still reaches a quality, in few trials.

Every trial is kept, and helps the next search. Unlike the searches of `compact/choices`, this one
knows nothing of the codec: it brackets the level from both sides.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from fhash_codec.measure.errors import Errors

UNIFORM = 20 * math.log10(math.sqrt(3))
"""dB by which the RMSE of a uniformly distributed error lies below the tolerance."""
EXACT = 400.0
"""PSNR in dB that stands for no error at all."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Figures of a codec at one level.

    psnr: dB over every finite value of all frames, EXACT where nothing differs. max_error: the
    largest difference as a share of the range.
    """

    level: float
    bytes: int
    psnr: float
    max_error: float

    def quality(self, goal: str) -> float:
        """Quality in dB: the PSNR, or for "bound" the largest error on the same scale."""
        if goal == "psnr":
            return self.psnr
        return EXACT if self.max_error == 0 else -20 * math.log10(self.max_error)


class Search:
    """The trials of one variant of a codec."""

    def __init__(
        self, measure: Callable[[float], Trial], *, step: float = 0.0, fixed: bool = False
    ) -> None:
        """Prepare the search.

        Args:
            measure: makes a trial at a level.
            step: levels are multiples of it; 0 for any level.
            fixed: every level gives the same trial.
        """
        self._measure = measure
        self._step = step
        self._fixed = fixed
        self.trials: dict[float, Trial] = {}

    def try_level(self, level: float) -> Trial:
        """The trial at a level, or at the next of the steps above it."""
        level = (
            0.0
            if self._fixed
            else math.ceil(level / self._step - 1e-9) * self._step
            if self._step
            else math.ceil(1e4 * level) / 1e4
        )
        if level not in self.trials:
            self.trials[level] = self._measure(level)
        return self.trials[level]

    def find(
        self, goal: str, asked: float, *, first: float, slack: float, most: int
    ) -> Trial | None:
        """The smallest trial whose quality is at least `asked`, None where no trial reached it.

        The search ends once a trial exceeds `asked` by no more than `slack`.

        Args:
            goal: "psnr" or "bound".
            asked: quality in dB.
            first: level to begin with before any trial.
            slack: dB.
            most: limit of new trials.
        """
        before = len(self.trials)
        last = None
        while len(self.trials) - before < most:
            level = self._next(goal, asked, first, slack)
            if level is None or level == last:
                break
            last = level
            self.try_level(level)
        reached = [trial for trial in self.trials.values() if trial.quality(goal) >= asked]
        return min(reached, key=lambda trial: (trial.bytes, -trial.psnr), default=None)

    def _next(self, goal: str, asked: float, first: float, slack: float) -> float | None:
        """The level to try, None once it is found."""
        if not self.trials:
            return first
        if self._fixed:
            return None
        tried = sorted(self.trials.values(), key=lambda trial: trial.level)
        good = next((trial for trial in tried if trial.quality(goal) >= asked), None)
        bad = next(
            (
                trial
                for trial in reversed(tried)
                if trial.quality(goal) < asked and (good is None or trial.level < good.level)
            ),
            None,
        )
        if good is not None and good.quality(goal) <= asked + slack:
            return None
        aim = asked + slack / 2
        if good is None or bad is None:
            nearest = tried[:2] if good is not None else tried[:-3:-1]
            away = (aim - nearest[0].quality(goal)) / _slope(nearest, goal)
            return nearest[0].level + math.copysign(
                min(max(abs(away), self._step, 0.05), 60.0), away
            )
        if self._step:
            between = round((good.level - bad.level) / self._step)
            return None if between <= 1 else bad.level + between // 2 * self._step
        if good.level - bad.level < 1e-3:
            return None
        share = (aim - bad.quality(goal)) / (good.quality(goal) - bad.quality(goal))
        return bad.level + (good.level - bad.level) * min(max(share, 0.08), 0.92)


def _slope(nearest: list[Trial], goal: str) -> float:
    """dB of quality for each dB of level between two trials, within 0.2 to 4.

    It is 1 for a single trial, and where one trial is exact.
    """
    qualities = [trial.quality(goal) for trial in nearest]
    if len(nearest) < 2 or EXACT in qualities:
        return 1.0
    return min(max((qualities[1] - qualities[0]) / (nearest[1].level - nearest[0].level), 0.2), 4.0)


def trial_of(errors: Errors, level: float, count: int) -> Trial:
    """The Trial that stands for measured errors and a number of bytes."""
    exact = errors.rmse == 0 or errors.psnr is None
    largest = errors.max_abs_error or 0.0
    return Trial(
        level=level,
        bytes=count,
        psnr=EXACT if exact else float(errors.psnr or 0.0),
        max_error=largest / errors.data_range,
    )
