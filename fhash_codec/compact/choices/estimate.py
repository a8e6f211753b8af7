"""The error that a quantiser step will cause, foretold from the coefficients of all tiles: far cheaper than coding them.

A coefficient below a part of the step becomes 0 and errs by itself, another one errs by a share of the step. Both constants are rough; how
far they are off is measured on a few coded tiles, and that hardly depends on the step.
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
from fhash_codec.compact.tiles.coding import SMALLEST_STEP, Coding, code
from fhash_codec.compact.tiles.tiling import even_tile
from fhash_formats.transform.tile.encoding import transform_for
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["Magnitudes", "foreseen_size", "foreseen_step", "magnitudes", "tile_costs"]

DEAD, SPREAD = 0.8, 0.1
"""Part of a step below which a coefficient becomes 0, and mean square of the other errors in squared steps."""
TRIALS, TRIAL_VERTICES, TRIAL_STEPS = 8, 1 << 18, 8
"""Tiles that are coded to see how far the foresight is off; larger tiles are cut to about so many vertices for it."""
BYTES_EACH = 0.7
"""That a coefficient which is not 0 takes, roughly."""
SHIFT = 21
"""A bin of magnitudes is a quarter of an octave: exponent and two bits of the mantissa of a float32."""
BINS = 1 << (31 - SHIFT)

with np.errstate(invalid="ignore"):
    _EDGES = (np.arange(BINS, dtype=np.uint32) << SHIFT).view(np.float32).astype(np.float64)
_EDGES[~np.isfinite(_EDGES)] = np.inf


@dataclass(frozen=True, kw_only=True)
class Magnitudes:
    """counts, squares: number and sum of squares of coefficients by magnitude."""

    counts: npt.NDArray[np.int64]
    squares: npt.NDArray[np.float64]

    def error(self, step: float) -> float:
        """The sum of squared errors at a step, roughly."""
        limit = DEAD * step
        number = int(np.searchsorted(_EDGES, min(limit, 1e38), side="right")) - 1
        part = (limit - _EDGES[number]) / (_EDGES[number + 1] - _EDGES[number])
        lost = math.fsum(self.squares[:number]) + float(part * self.squares[number])
        kept = float(self.counts[number:].sum() - part * self.counts[number])
        return lost + kept * SPREAD * step * step

    def size(self, step: float) -> float:
        """The bytes that coding takes at a step, roughly."""
        number = int(np.searchsorted(_EDGES, min(DEAD * step, 1e38), side="right")) - 1
        return BYTES_EACH * float(self.counts[number:].sum())

    def step(self, error: float, smallest: float) -> float:
        """The step at which the sum of squared errors should be as given, at least `smallest`."""
        low, high = smallest, smallest * 2
        while self.error(high) < error and high < smallest * 2.0**60:
            low, high = high, high * 2
        for _ in range(30):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if self.error(middle) < error else (low, middle)
        return low


def magnitudes(coefficients: npt.NDArray[np.float32]) -> Magnitudes:
    """How large coefficients are; the same figures native (fhash_codec/native/quality.cpp) and in numpy."""
    flat = np.ascontiguousarray(coefficients, dtype=np.float32).reshape(-1)
    library = native.library()
    if library is None:
        bins = (flat.view(np.uint32) & np.uint32(0x7FFFFFFF)) >> np.uint32(SHIFT)
        weights = np.square(flat, dtype=np.float64)
        squares = np.bincount(bins, weights=weights, minlength=BINS).astype(np.float64)
        return Magnitudes(
            counts=np.bincount(bins, minlength=BINS).astype(np.int64), squares=squares
        )
    found = Magnitudes(counts=np.zeros(BINS, np.int64), squares=np.zeros(BINS))
    pointers = (ctypes.c_void_p(array.ctypes.data) for array in (found.counts, found.squares))
    library.fhash_magnitudes(
        ctypes.c_void_p(flat.ctypes.data),
        ctypes.c_int64(flat.size),
        ctypes.c_int64(SHIFT),
        *pointers,
    )
    return found


def tile_costs(
    blocks: Blocks, settings: TileSettings, workers: ThreadPoolExecutor
) -> list[float] | None:
    """The bytes that each tile takes with the settings, roughly, in C order; None for a series that is not held in memory."""
    return (
        [found.size(settings.step) for found in _look(blocks, settings, workers)]
        if blocks.held
        else None
    )


def foreseen_size(
    blocks: Blocks,
    settings: TileSettings,
    *,
    psnr: float,
    data_range: float,
    workers: ThreadPoolExecutor,
) -> float:
    """The bytes that the tiles of a series as in `foreseen_step` take at a PSNR, very roughly."""
    seen = _together(_look(blocks, settings, workers))
    return seen.size(
        seen.step(
            math.prod(blocks.shape) * data_range**2 * 10 ** (-psnr / 10), data_range * SMALLEST_STEP
        )
    )


def foreseen_step(
    blocks: Blocks,
    settings: TileSettings,
    coding: Coding,
    *,
    psnr: float,
    data_range: float,
    workers: ThreadPoolExecutor,
) -> float:
    """The step at which the tiles of a series that is held, counts whole and is coded in float32 should reach a PSNR, in dB."""

    smallest = data_range * SMALLEST_STEP
    wanted = math.prod(blocks.shape) * data_range**2 * 10 ** (-psnr / 10)
    seen = _together(_look(blocks, settings, workers))
    step = seen.step(wanted, smallest)
    if math.prod(blocks.tile) > TRIAL_VERTICES:
        # Large tiles take long to code, and what is asked of them, parts of them can tell.
        blocks = blocks.retile(
            even_tile(blocks.tile, math.prod(blocks.tile) // TRIAL_VERTICES + 1, TRIAL_STEPS)
        )
        settings = replace(settings, transform=usual_transform(blocks.tile))
    settings, indices, tiles = (
        replace(settings, step=step),
        list(blocks.indices()),
        _look(blocks, settings, workers),
    )

    def trial(number: int) -> float:
        values, care = blocks.read(indices[number])
        found, guess = code(values, care, settings, coding)[1].squares, tiles[number].error(step)
        return found / guess if guess > 0 and found > 0 else 1.0

    # Those that err most stand for all: a tile's chance is its share of the error.
    shares = np.cumsum([tile.error(step) for tile in tiles])
    chosen = np.searchsorted(shares, shares[-1] * (np.arange(TRIALS) + 0.5) / TRIALS).clip(
        0, len(tiles) - 1
    )
    off = list(workers.map(trial, (int(number) for number in np.unique(chosen))))
    return seen.step(wanted * len(off) / math.fsum(off), smallest)


def _look(blocks: Blocks, settings: TileSettings, workers: ThreadPoolExecutor) -> list[Magnitudes]:
    """The magnitudes of each tile."""
    transform = transform_for(
        replace(settings, double=False, step=1.0), blocks.tile
    )  # only the kinds matter

    def look(index: Index) -> Magnitudes:
        with np.errstate(over="ignore", invalid="ignore"):
            values = blocks.read(index)[0].astype(np.float32)
            values -= np.float32(settings.center)
            values[~np.isfinite(values)] = 0
            return magnitudes(transform.forward(values))

    return list(workers.map(look, blocks.indices()))


def _together(tiles: Sequence[Magnitudes]) -> Magnitudes:
    counts, squares = np.zeros(BINS, np.int64), np.zeros(BINS)
    for tile in tiles:
        counts += tile.counts
        squares += tile.squares
    return Magnitudes(counts=counts, squares=squares)
