"""Quality at the key frames and between them, beside linear interpolation of the source in time.

Interpolation of the source is what a reader could do with the key frames alone, uncompressed. A
model of key frames is worth its name where it does not fall far below that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.errors import Errors
from fhash_codec.measure.sums import ErrorSums, Values

__all__ = ["BetweenErrors", "BetweenQuality", "Neighbours", "NeighboursOf", "neighbours_of"]

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class BetweenQuality:
    """PSNR in dB over parts of the coreset; None if a part is empty or its error is 0.

    Attributes:
        psnr_key_frames: at the steps that are key frames.
        psnr: at the other steps.
        psnr_linear: there, of the source interpolated linearly in time between its key frames.
        psnr_fringe: there, at vertices in the coreset of only one of the two key frames around.
        psnr_fringe_linear: there, of the interpolated source.
        fringe_fraction: share of these vertices in the coreset of those steps.
    """

    psnr_key_frames: float | None
    psnr: float | None
    psnr_linear: float | None
    psnr_fringe: float | None
    psnr_fringe_linear: float | None
    fringe_fraction: float


class Neighbours(NamedTuple):
    """The key frames around a step that is none.

    Attributes:
        before, after: frames (z, y, x) of the source at the two key frames.
        after_weight: weight in [0, 1] of the later one in a linear interpolation.
        fringe: vertices (z, y, x) in the coreset of only one of the two.
    """

    before: Values
    after: Values
    after_weight: float
    fringe: Mask

    def interpolated(self) -> npt.NDArray[np.float64]:
        """The source at the step by linear interpolation, float64 (z, y, x)."""
        weight = self.after_weight
        if weight == 0:
            return self.before.astype(np.float64)
        # Values near the ends of float64 overflow in no product, since both weights are below 1.
        with np.errstate(invalid="ignore"):
            return (1 - weight) * self.before.astype(np.float64) + weight * self.after.astype(
                np.float64
            )


NeighboursOf = Callable[[int], Neighbours | None]
"""Step -> its neighbours; None for a key frame."""


def neighbours_of(
    key_frames: tuple[int, ...],
    key_index: Callable[[float], float],
    read: Callable[[int], Values],
    occupancy: Callable[[float], Mask],
) -> NeighboursOf:
    """A function that gives the neighbours of a step, with the frames of two key frames held.

    key_frames: the steps that are key frames, ascending.
    key_index: step -> key index, as `KeyTimes.key_index`.
    read, occupancy: step -> frame of the source, and -> mask (z, y, x) of the coreset.
    """
    held = lru_cache(maxsize=2)(lambda step: (read(step), occupancy(step)))

    def neighbours(step: int) -> Neighbours | None:
        if step in key_frames:
            return None
        index = key_index(step)
        first = int(index)
        before, in_before = held(key_frames[first])
        after, in_after = held(key_frames[min(first + 1, len(key_frames) - 1)])
        if index == first:  # before the first key frame, or after the last one
            return Neighbours(before, before, 0.0, np.zeros_like(in_before))
        return Neighbours(before, after, index - first, in_before ^ in_after)

    return neighbours


class BetweenSums(NamedTuple):
    """Scaled differences of one step that is no key frame.

    Attributes:
        linear: of the interpolated source, over the coreset.
        fringe, fringe_linear: over the fringe, of decoded values and of the interpolated source.
    """

    linear: ErrorSums
    fringe: ErrorSums
    fringe_linear: ErrorSums


class BetweenErrors:
    """Errors of a series at key frames and between them, step by step."""

    def __init__(self, data_range: float) -> None:
        self._key_frames, self._between, self._linear, self._fringe, self._fringe_linear = (
            Errors(data_range) for _ in range(5)
        )

    def compare(
        self, step: int, original: Values, decoded: Values, mask: Mask, neighbours: Neighbours
    ) -> BetweenSums:
        """The differences of a step that is no key frame, for `add`; safe in any thread.

        mask: vertices (z, y, x) of the coreset.
        """
        linear = neighbours.interpolated()
        # The source may have no finite value at a key frame where it has one at the step.
        known = mask & np.isfinite(linear)
        fringe = mask & neighbours.fringe
        original_wide = original.astype(np.float64)
        return BetweenSums(
            linear=self._linear.compare(step, original_wide, linear, known),
            fringe=self._fringe.compare(step, original, decoded, fringe),
            fringe_linear=self._fringe_linear.compare(
                step, original_wide, linear, known & neighbours.fringe
            ),
        )

    def add(self, step: int, coreset: ErrorSums, between: BetweenSums | None) -> None:
        """Add a step; `between` is None for a key frame."""
        if between is None:
            self._key_frames.take(step, coreset)
            return
        self._between.take(step, coreset)
        self._linear.take(step, between.linear)
        self._fringe.take(step, between.fringe)
        self._fringe_linear.take(step, between.fringe_linear)

    def quality(self) -> BetweenQuality | None:
        """The figures of all steps added; None without a step between key frames."""
        if not self._between.steps:
            return None
        return BetweenQuality(
            psnr_key_frames=self._key_frames.psnr,
            psnr=self._between.psnr,
            psnr_linear=self._linear.psnr,
            psnr_fringe=self._fringe.psnr,
            psnr_fringe_linear=self._fringe_linear.psnr,
            fringe_fraction=self._fringe.count / max(self._between.count, 1),
        )
