"""Coding of one tile, and the size and error that it gives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.measure.sums import error_sums
from fhash_codec.measure.value_range import power_of_two
from fhash_formats.transform.tile import encoding
from fhash_formats.transform.tile.decoding import decode_tile
from fhash_formats.transform.tile.encoding import CodedTile, encode_tile, exact_tile
from fhash_formats.transform.tile.integers import WEIGHT
from fhash_formats.transform.tile.settings import TileSettings

MIN_STEP_SHARE = 2.0**-26
"""Smallest quantiser step as a share of the value range: integers beyond 2^30 cannot be coded."""


@dataclass(frozen=True, kw_only=True)
class BulkPart:
    """The part of a promise that is about the bulk of the values, as tiles measure it."""

    low: float
    """Least value of the bulk, in data units."""
    high: float
    """Greatest value of the bulk, in data units."""
    weight: float = 1.0
    """Mean squared error that is promised of all values, as a multiple of that of the bulk."""
    alone: bool = False
    """Whether nothing is promised of the other values; the weight is then 1."""


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
    bulk: BulkPart | None = None
    """Part of the promise about the bulk, which changes what is measured and no byte."""


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
    bulk_squares: float = 0.0
    """Sum of the squared errors in the bulk times its weight; 0 without a promise about it."""
    bulk_count: int = 0
    """Number of the values that this sum is over."""

    def psnr(self, data_range: float) -> float:
        """Return the PSNR in dB; infinite without error.

        Where a promise about the bulk is harder to keep than that about all values, it is the PSNR
        over all values that would be as far from its promise.
        """
        mean = self.squares / self.count if self.count else 0.0
        if self.bulk_count:
            mean = max(mean, self.bulk_squares / self.bulk_count)
        if mean == 0 or data_range == 0:
            return math.inf
        return 20 * math.log10(data_range) - 10 * math.log10(mean)


def code(tile: Tile, settings: TileSettings, coding: Coding) -> tuple[CodedTile, Outcome]:
    """Code one tile and measure its size and error."""
    values, counted = tile
    if coding.exact:
        occupied = None
        if settings.mask is not None:
            occupied = np.ones(values.shape, bool) if counted is None else counted
        coded = exact_tile(values, occupied=occupied, origin=settings.origin)
        size = len(coded.data)
        return coded, Outcome(size=size, squares=0.0, count=tile.counted_vertices, max_error=0.0)
    coded = encode_tile(values, settings, coding, in_coreset=counted)
    return coded, measured(tile, coded, settings, coding)


def recoded(tile: Tile, data: bytes, settings: TileSettings, nonzero: int = 0) -> CodedTile:
    """Return a tile whose stream is known, as these settings decode it."""
    t, z, y, x = tile.values.shape
    decoded = decode_tile(data, (t, z, y, x), tile.values.dtype, settings)
    return CodedTile(data=data, decoded=decoded, nonzero=nonzero)


def measured(tile: Tile, coded: CodedTile, settings: TileSettings, coding: Coding) -> Outcome:
    """Return size and error of a tile that was coded with these settings."""
    values, counted = tile
    # Scaled, so that neither huge nor tiny ranges over- or underflow.
    scale = power_of_two(settings.high - settings.low)
    bulk = coding.bulk
    ends = None if bulk is None else (bulk.low, bulk.high)
    sums = error_sums(values, coded.decoded, counted, scale, ends)
    squares, count = sums.squares, sums.number
    bulk_squares, bulk_count = sums.bulk_squares, sums.bulk_count
    if bulk is not None and bulk.alone:
        squares, count, bulk_squares, bulk_count = bulk_squares, bulk_count, 0.0, 0
    return Outcome(
        size=len(coded.data),
        # Divided twice: the square of the largest scale is no float.
        squares=squares / scale / scale,
        count=count,
        max_error=sums.largest / scale,
        nonzero=coded.nonzero,
        bulk_squares=bulk_squares * (1.0 if bulk is None else bulk.weight) / scale / scale,
        bulk_count=bulk_count,
    )


def total(outcomes: Sequence[Outcome], weights: Sequence[int] | None = None) -> Outcome:
    """Sum outcomes up to one. weights: number of tiles that each stands for (default 1)."""
    pairs = list(zip(weights or [1] * len(outcomes), outcomes, strict=True))
    return Outcome(
        size=sum(weight * o.size for weight, o in pairs),
        squares=math.fsum(weight * o.squares for weight, o in pairs),
        count=sum(weight * o.count for weight, o in pairs),
        max_error=max((o.max_error for o in outcomes), default=0.0),
        nonzero=sum(weight * o.nonzero for weight, o in pairs),
        bulk_squares=math.fsum(weight * o.bulk_squares for weight, o in pairs),
        bulk_count=sum(weight * o.bulk_count for weight, o in pairs),
    )
