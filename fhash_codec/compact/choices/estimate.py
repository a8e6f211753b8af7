"""Estimates of error and size at a quantiser step, from the coefficients of all tiles.

They are far cheaper than coding the tiles. A coefficient below a share of the step becomes 0 and
errs by itself; another one errs by a share of the step. Both constants are rough. Their common
error is measured on a few coded tiles, since it hardly depends on the step.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.tiles.blocks import Blocks, Index
from fhash_codec.compact.tiles.coding import MIN_STEP_SHARE, Coding, code
from fhash_codec.compact.tiles.sample import spread_order
from fhash_codec.compact.tiles.tiling import even_tile
from fhash_codec.measure.bulk import BULK_SHARE
from fhash_formats.transform.tile.decoding import transform_for
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["Magnitudes", "estimated_size", "estimated_step", "magnitudes", "tile_costs"]

DEAD_ZONE = 0.8
"""Share of the step below which a coefficient becomes 0."""
SPREAD = 0.1
"""Mean square of the error of the other coefficients, in squared steps."""
ROUGH_VERTICES = 1 << 20
"""Vertices of the tiles whose coefficients give a first idea of the size."""
TRIALS = 8
"""Tiles that are coded at most to measure the error of the estimate."""
TRIAL_VERTICES = 1 << 18
"""Vertices of a tile coded for it; larger tiles are cut to about this size."""
TRIAL_STEPS = 8
"""Time steps of such a smaller tile."""
BYTES_PER_COEFFICIENT = 0.7
"""Approximate bytes per coefficient that is not 0."""
SHIFT = 21
"""Low bits of a float32 that a bin leaves out.

The rest is the exponent and two bits of the mantissa: a bin is a quarter of an octave.
"""
BINS = 1 << (31 - SHIFT)
"""Number of bins of magnitudes."""

with np.errstate(invalid="ignore"):
    _EDGES = (np.arange(BINS, dtype=np.uint32) << SHIFT).view(np.float32).astype(np.float64)
_EDGES[~np.isfinite(_EDGES)] = np.inf


@dataclass(frozen=True, kw_only=True)
class Magnitudes:
    """Histogram of the magnitudes of coefficients, with logarithmic bins."""

    counts: npt.NDArray[np.int64]
    """Number of coefficients in each bin."""
    squares: npt.NDArray[np.float64]
    """Sum of the squares of the coefficients in each bin."""

    def error(self, step: float) -> float:
        """Return the approximate sum of the squared errors at a step."""
        limit = DEAD_ZONE * step
        number = self._bin_of(limit)
        share = (limit - _EDGES[number]) / (_EDGES[number + 1] - _EDGES[number])
        zeroed = math.fsum(self.squares[:number]) + float(share * self.squares[number])
        kept = float(self.counts[number:].sum() - share * self.counts[number])
        return zeroed + kept * SPREAD * step * step

    def size(self, step: float) -> float:
        """Return the approximate number of bytes at a step."""
        number = self._bin_of(DEAD_ZONE * step)
        return BYTES_PER_COEFFICIENT * float(self.counts[number:].sum())

    def step(self, error: float, min_step: float) -> float:
        """Return the step for a sum of squared errors, at least `min_step`."""
        low, high = min_step, min_step * 2
        while self.error(high) < error and high < min_step * 2.0**60:
            low, high = high, high * 2
        for _ in range(30):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if self.error(middle) < error else (low, middle)
        return low

    @staticmethod
    def _bin_of(magnitude: float) -> int:
        """Return the bin that holds a magnitude."""
        return int(np.searchsorted(_EDGES, min(magnitude, 1e38), side="right")) - 1


def magnitudes(coefficients: npt.NDArray[np.float32]) -> Magnitudes:
    """Return the histogram of coefficients (fhash_codec/native/quality.cpp)."""
    flat = np.ascontiguousarray(coefficients, dtype=np.float32).reshape(-1)
    histogram = Magnitudes(counts=np.zeros(BINS, np.int64), squares=np.zeros(BINS))
    native.library().fhash_magnitudes(
        ctypes.c_void_p(flat.ctypes.data),
        ctypes.c_int64(flat.size),
        ctypes.c_int64(SHIFT),
        ctypes.c_void_p(histogram.counts.ctypes.data),
        ctypes.c_void_p(histogram.squares.ctypes.data),
    )
    return histogram


def tile_costs(
    blocks: Blocks, settings: TileSettings, workers: ThreadPoolExecutor
) -> list[float] | None:
    """Return the approximate bytes of each tile, in C order; None for a series not in memory."""
    if not blocks.in_memory:
        return None
    return [tile.size(settings.step) for tile in _tile_magnitudes(blocks, settings, workers)]


def estimated_size(
    blocks: Blocks,
    settings: TileSettings,
    *,
    psnr: float,
    data_range: float,
    workers: ThreadPoolExecutor,
) -> float:
    """Return a very rough number of bytes that the tiles of a series take at a PSNR (dB).

    The series must be as in `estimated_step`.
    """
    indices = list(blocks.indices())
    count = min(len(indices), max(1, ROUGH_VERTICES // math.prod(blocks.tile)))
    some = [indices[number] for number in sorted(spread_order(len(indices))[:count])]
    share = count / len(indices)
    series = _sum(_tile_magnitudes(blocks, settings, workers, some))
    error = _squared_error(blocks, psnr, data_range) * share
    return series.size(series.step(error, data_range * MIN_STEP_SHARE)) / share


def estimated_step(
    blocks: Blocks,
    settings: TileSettings,
    coding: Coding,
    *,
    psnr: float,
    even_psnr: float | None = None,
    data_range: float,
    workers: ThreadPoolExecutor,
) -> float:
    """Return the step at which the tiles of a series should reach a PSNR (dB).

    even_psnr: PSNR that keeps the promise if errors are everywhere alike: more than `psnr`, the
        default, where the coding measures a bulk that needs it.

    The series must be in memory, all of its vertices in the coreset, and coded in float32.
    """
    min_step = data_range * MIN_STEP_SHARE
    error = _squared_error(blocks, psnr, data_range)
    tiles = _tile_magnitudes(blocks, settings, workers)
    series = _sum(tiles)
    step = series.step(_squared_error(blocks, even_psnr or psnr, data_range), min_step)
    if math.prod(blocks.tile) > TRIAL_VERTICES:
        # Large tiles take long to code, and smaller ones tell as much.
        parts = math.prod(blocks.tile) // TRIAL_VERTICES + 1
        blocks = blocks.retile(even_tile(blocks.tile, parts, TRIAL_STEPS))
        settings = replace(settings, transform=usual_transform(blocks.tile))
        tiles = _tile_magnitudes(blocks, settings, workers)
    settings = replace(settings, step=step)
    indices = list(blocks.indices())

    def measured_to_estimated(number: int) -> tuple[float, float]:
        outcome = code(blocks.read(indices[number]), settings, coding)[1]
        estimate = tiles[number].error(step)
        if estimate > 0 and outcome.squares > 0:
            return outcome.squares / estimate, outcome.bulk_squares / estimate
        return 1.0, 0.0

    # The chance of a tile is its share of the error, so that those of most error stand for all.
    sums = np.cumsum([tile.error(step) for tile in tiles])
    chosen = np.searchsorted(sums, sums[-1] * (np.arange(TRIALS) + 0.5) / TRIALS)
    numbers = np.unique(chosen.clip(0, len(tiles) - 1))
    ratios = list(workers.map(measured_to_estimated, (int(number) for number in numbers)))
    whole, bulk = (math.fsum(part) for part in zip(*ratios, strict=True))
    step = series.step(error * len(ratios) / whole, min_step)
    if bulk == 0:
        return step
    error *= BULK_SHARE
    return min(step, series.step(error * len(ratios) / bulk, min_step))


def _squared_error(blocks: Blocks, psnr: float, data_range: float) -> float:
    """Return the sum of the squared errors over a series at a PSNR (dB)."""
    return math.prod(blocks.shape) * data_range**2 * 10 ** (-psnr / 10)


def _tile_magnitudes(
    blocks: Blocks,
    settings: TileSettings,
    workers: ThreadPoolExecutor,
    indices: Sequence[Index] | None = None,
) -> list[Magnitudes]:
    """Return the magnitudes of the coefficients of some tiles; of all, in C order, if None."""
    # Only the kinds of the transform matter; float32 is precise enough.
    transform = transform_for(replace(settings, double=False, step=1.0), blocks.tile)

    def tile_magnitudes(index: Index) -> Magnitudes:
        with np.errstate(over="ignore", invalid="ignore"):
            values = blocks.read(index).values.astype(np.float32)
            values -= np.float32(settings.center)
            values[~np.isfinite(values)] = 0
            return magnitudes(transform.forward(values))

    return list(workers.map(tile_magnitudes, blocks.indices() if indices is None else indices))


def _sum(tiles: Sequence[Magnitudes]) -> Magnitudes:
    """Return the histogram of all tiles together."""
    counts, squares = np.zeros(BINS, np.int64), np.zeros(BINS)
    for tile in tiles:
        counts += tile.counts
        squares += tile.squares
    return Magnitudes(counts=counts, squares=squares)
