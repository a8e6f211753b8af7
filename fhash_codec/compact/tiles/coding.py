"""Coding one tile, and measuring what that gave."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fhash_codec.compact.tiles.blocks import Care, Values
from fhash_codec.measure.sums import squared_errors
from fhash_codec.measure.value_range import power_of_two
from fhash_formats.transform.tile import encoding
from fhash_formats.transform.tile.encoding import CodedTile, encode_tile, exact_tile
from fhash_formats.transform.tile.settings import TileSettings

WEIGHT = 0.09
"""Squared steps that a bit is worth to the quantiser (findings: best between 0.07 and 0.11)."""


OFFSETS = (-5, -1, 0)
"""Where magnitudes of 1, 2 and more stand after rate-distortion optimisation, in 1/128 step."""


SMALLEST_STEP = 2.0**-26
"""Of the range: integers beyond 2^30 cannot be coded."""


@dataclass(frozen=True, kw_only=True)
class Coding(encoding.Coding):
    """Options with which the tiles of a series are coded, besides their settings.

    Attributes:
        exact: whether tiles are stored without loss; the other options then have no effect.
    """

    weight: float = WEIGHT
    keep_missing: bool = False
    exact: bool = False


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What coding some tiles gave: bytes of the streams, squared error and number of the values that count, the largest error."""

    size: int
    squares: float
    count: int
    largest: float
    nonzero: int = 0

    def psnr(self, data_range: float) -> float:
        """In dB; infinite without error."""
        if self.squares == 0 or self.count == 0 or data_range == 0:
            return math.inf
        return 20 * math.log10(data_range) - 10 * math.log10(self.squares / self.count)


def code(
    values: Values, care: Care, settings: TileSettings, coding: Coding
) -> tuple[CodedTile, Outcome]:
    """Code one tile and measure it."""
    if coding.exact:
        count = values.size if care is None else int(np.count_nonzero(care))
        coded = exact_tile(
            values,
            occupied=None
            if settings.mask is None
            else np.ones(values.shape, bool)
            if care is None
            else care,
        )
        return coded, Outcome(size=len(coded.data), squares=0.0, count=count, largest=0.0)
    coded = encode_tile(values, settings, coding, in_coreset=care)
    # Scaled, so that neither huge nor tiny ranges over- or underflow.
    scale = power_of_two(settings.high - settings.low)
    count, squares, largest = squared_errors(values, coded.decoded, care, scale)
    outcome = Outcome(
        size=len(coded.data),
        squares=squares / scale**2,
        count=count,
        largest=largest / scale,
        nonzero=coded.nonzero,
    )
    return coded, outcome


def total(outcomes: Sequence[Outcome], weights: Sequence[int] | None = None) -> Outcome:
    """All of them as one. weights: how many tiles each stands for, 1 if left out."""
    pairs = list(zip(weights or [1] * len(outcomes), outcomes, strict=True))
    return Outcome(
        size=sum(weight * o.size for weight, o in pairs),
        squares=math.fsum(weight * o.squares for weight, o in pairs),
        count=sum(weight * o.count for weight, o in pairs),
        largest=max((o.largest for o in outcomes), default=0.0),
        nonzero=sum(weight * o.nonzero for weight, o in pairs),
    )
