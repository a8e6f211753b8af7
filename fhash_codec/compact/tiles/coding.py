"""Coding of one tile, and the size and error that it gives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.measure.sums import squared_errors
from fhash_codec.measure.value_range import power_of_two
from fhash_formats.transform.tile import encoding
from fhash_formats.transform.tile.encoding import CodedTile, encode_tile, exact_tile
from fhash_formats.transform.tile.settings import TileSettings

WEIGHT = 0.09
"""Squared quantiser steps that a bit is worth (best between 0.07 and 0.11 in experiments)."""

OFFSETS = (-5, -1, 0)
"""Shift, in 1/128 step, of the decoded magnitudes 1, 2 and more after the optimisation."""

MIN_STEP_SHARE = 2.0**-26
"""Smallest quantiser step as a share of the value range: integers beyond 2^30 cannot be coded."""


@dataclass(frozen=True, kw_only=True)
class Coding(encoding.Coding):
    """Options of the encoder for the tiles of a series.

    They change the bytes, but a decoder does not need them. What a decoder needs is in
    `TileSettings`.
    """

    weight: float = WEIGHT
    keep_missing: bool = False
    exact: bool = False
    """Whether tiles are stored without loss, by `exact_tile`; the other options are then unused."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Size and error of some coded tiles."""

    size: int
    """Bytes of the streams."""
    squares: float
    """Sum of the squared errors over the vertices that count, in squared data units."""
    count: int
    """Number of finite values that count."""
    max_error: float
    """Largest absolute error, in data units."""
    nonzero: int = 0
    """Number of coefficients that are not 0."""

    def psnr(self, data_range: float) -> float:
        """Return the PSNR in dB; infinite without error."""
        if self.squares == 0 or self.count == 0 or data_range == 0:
            return math.inf
        return 20 * math.log10(data_range) - 10 * math.log10(self.squares / self.count)


def code(tile: Tile, settings: TileSettings, coding: Coding) -> tuple[CodedTile, Outcome]:
    """Code one tile and measure its size and error."""
    values, counted = tile
    if coding.exact:
        occupied = None
        if settings.mask is not None:
            occupied = np.ones(values.shape, bool) if counted is None else counted
        coded = exact_tile(values, occupied=occupied)
        size = len(coded.data)
        return coded, Outcome(size=size, squares=0.0, count=tile.counted_vertices, max_error=0.0)
    coded = encode_tile(values, settings, coding, in_coreset=counted)
    # Scaled, so that neither huge nor tiny ranges over- or underflow.
    scale = power_of_two(settings.high - settings.low)
    count, squares, max_error = squared_errors(values, coded.decoded, counted, scale)
    outcome = Outcome(
        size=len(coded.data),
        squares=squares / scale**2,
        count=count,
        max_error=max_error / scale,
        nonzero=coded.nonzero,
    )
    return coded, outcome


def total(outcomes: Sequence[Outcome], weights: Sequence[int] | None = None) -> Outcome:
    """Sum outcomes up to one. weights: number of tiles that each stands for (default 1)."""
    pairs = list(zip(weights or [1] * len(outcomes), outcomes, strict=True))
    return Outcome(
        size=sum(weight * o.size for weight, o in pairs),
        squares=math.fsum(weight * o.squares for weight, o in pairs),
        count=sum(weight * o.count for weight, o in pairs),
        max_error=max((o.max_error for o in outcomes), default=0.0),
        nonzero=sum(weight * o.nonzero for weight, o in pairs),
    )
