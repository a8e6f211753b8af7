"""Choice of the predictor that tiles share."""

from __future__ import annotations

import math
from dataclasses import replace
from math import prod
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Tile
from fhash_codec.compact.transform import gram_of, usual_transform
from fhash_formats.support.threads import thread_pool
from fhash_formats.support.values import Mask
from fhash_formats.transform.predict import (
    MAX_WEIGHT,
    WEIGHT_UNIT,
    Pass,
    Predictor,
    integers_of,
    passes_of,
)
from fhash_formats.transform.spec import encode_block
from fhash_formats.transform.tile import predicted_size
from fhash_formats.transform.tile_format import TileSettings

ORDERS = ((0, 1, 2, 3), (0, 3, 2, 1), (3, 2, 1, 0))
"""Orders in which axes are refined: the last axis is predicted best and makes half of all."""
PLAIN_ORDERS = ((0, 1, 2, 3), (3, 2, 1, 0))
"""Those that are tried without weights."""
DEPTHS = ((2, 3, 3, 3), (0, 3, 3, 3))
"""Refinements along each axis (t, z, y, x) that are tried."""
ROWS = 30_000
"""Vertices of a pass that its weights are trained on."""
TRIAL_ROWS = 8_000
"""Vertices of a pass that its weights are trained on for a trial."""
HOPELESS_MEAN = 1.4
"""Size without weights, as a multiple of the rival's, from which on none are trained.

Weights saved a quarter at most.
"""
HOPELESS = 1.03
"""Size by the first trained weights, as a multiple of the rival's, from which on no others help.

Other orders, depths and taps saved 1 % at most.
"""
THOROUGH = 6
"""Least effort that tries these: half of the seconds of a bound, for 0.6 % of the bytes."""
ROUNDS = 4
"""Rounds of the reweighted least squares."""
MAX_TRAINING_VERTICES = 48 << 20
"""Vertices of a series up to which the weights are trained on all of its tiles."""
RIDGE = 1e-3
"""Ridge of the least squares, as a share of the mean of the diagonal."""
MAX_INTEGER_BOUND = 2.0**40
"""Bound on integer data from which on the data are treated as real numbers."""

Axes = tuple[int, int, int, int]
"""A number per axis (t, z, y, x)."""


class IntegerTile(NamedTuple):
    """A tile of quantised values (t, z, y, x)."""

    integers: npt.NDArray[np.int32]
    counted: Mask | None
    """Mask of the vertices that count; None if all count."""


def choose_predictor(
    sample: Sample,
    parts: Sample,
    settings: TileSettings,
    rival: float,
    *,
    error: float,
    effort: int,
) -> TileSettings | None:
    """Return settings with a predictor if it takes fewer bytes of some parts than a rival.

    sample: of the series, in tiles; its weights are trained on.
    parts: of the tiles, which are coded.
    rival: bytes of all parts by the transform.
    error: strict bound in data units. The residual's quantum, which keeps the bound, is also the
        distance of predicted values.
    """
    step, origin = settings.quantum, settings.center
    if sample.blocks.dtype.kind in "iu" and error < MAX_INTEGER_BOUND:
        # Integer data: a quantum of 2 floor(error) + 1 keeps every error at or below floor(error).
        step, origin = 2.0 * int(error) + 1.0, float(round(settings.center))
    if step <= 0:
        return None
    predictor = best_predictor(sample, parts, step=step, origin=origin, effort=effort, rival=rival)
    if predictor is None:
        return None
    # The transform is unused from here on; store the cheapest description of one.
    plain = usual_transform(sample.blocks.tile)
    # Predicted values are within the range as they are.
    return replace(settings, predictor=predictor, transform=plain, head=None, clip=False)


def best_predictor(
    sample: Sample,
    parts: Sample,
    *,
    step: float,
    origin: float,
    effort: int,
    rival: float = math.inf,
) -> Predictor | None:
    """Return the predictor of the smallest streams of some parts.

    From effort 6 on, order, depth and taps are decided one after the other. Weights are trained on
    all tiles of a series that is in memory and not too large, since a few tiles are often not like
    the others.

    Returns None if the integers would be too large, or if the parts take more bytes than by the
    rival.

    sample, parts: see `choose_predictor`.
    step, origin: distance of predicted values, and one of them, in data units.
    rival: bytes of all parts by what the predictor competes with.
    """
    plain = _predictor(step, origin, (0, 0, 0, 0), ORDERS[0], 0, None)
    coded = parts.map(lambda tile: _quantised(tile, plain))
    codable = [tile for tile in coded if tile is not None]
    if len(codable) < len(coded):
        return None
    training: list[IntegerTile] = []

    def run(levels: Axes, order: Axes, reach: int, rows: int = TRIAL_ROWS) -> _Trial:
        """Code the parts by a predictor whose weights are trained on some rows; by 0 if none."""
        t, z, y, x = (
            min(level, (length - 1).bit_length())
            for level, length in zip(levels, codable[0].integers.shape, strict=True)
        )
        of_weights = training if rows else None
        predictor = _predictor(step, origin, (t, z, y, x), order, reach, of_weights, rows)
        sizes = zip(parts.weights, _coded_sizes(codable, predictor), strict=True)
        parts.tick()
        return _Trial(sum(w * n for w, n in sizes) + _weight_bytes(predictor), predictor)

    # The mean of two neighbours is best at sharp fronts: all others smear them.
    plain_trials = [run(levels, order, 0, rows=0) for order in PLAIN_ORDERS for levels in DEPTHS]
    mean = min(plain_trials, key=lambda trial: trial.size)
    if mean.size > HOPELESS_MEAN * rival:
        return None
    tiles = coded
    if sample.blocks.in_memory and prod(sample.blocks.shape) <= MAX_TRAINING_VERTICES:
        tiles = list(sample.map_all(lambda tile: _quantised(tile, plain)))
    training += [
        tile for tile in tiles if tile is not None and (tile.counted is None or tile.counted.any())
    ]
    best = run(DEPTHS[0], ORDERS[0], 1)
    if min(best.size, mean.size) > HOPELESS * rival:
        return None
    thorough = effort >= THOROUGH and best.size <= HOPELESS * mean.size
    for order in ORDERS[1:] if thorough else ():
        best = min(best, run(DEPTHS[0], order, 1), key=lambda trial: trial.size)
    for levels in DEPTHS[1:] if thorough else ():
        best = min(best, run(levels, best.predictor.order, 1), key=lambda trial: trial.size)
    for reach in (0, 2) if thorough else ():
        levels, order = best.predictor.levels, best.predictor.order
        best = min(best, run(levels, order, reach), key=lambda trial: trial.size)
    if mean.size < best.size:
        return mean.predictor if mean.size < rival else None
    last = run(best.predictor.levels, best.predictor.order, best.predictor.reach, ROWS)
    return last.predictor if last.size < rival else None


class _Trial(NamedTuple):
    """A predictor, and the bytes that all tiles take by it."""

    size: float
    predictor: Predictor


def _coded_sizes(tiles: list[IntegerTile], predictor: Predictor) -> list[int]:
    """Return the bytes of each tile, coded by a predictor."""
    with thread_pool() as workers:
        return list(
            workers.map(lambda tile: predicted_size(tile.integers, tile.counted, predictor), tiles)
        )


def _quantised(tile: Tile, predictor: Predictor) -> IntegerTile | None:
    """Return a tile as integers; None if they would be too large."""
    values = tile.values
    counted = np.isfinite(values) if values.dtype.kind == "f" else np.ones(values.shape, bool)
    if tile.counted is not None:
        counted &= tile.counted
    integers = integers_of(values, counted, predictor)
    if integers is None:
        return None
    return IntegerTile(integers, None if counted.all() else counted)


def _predictor(
    step: float,
    origin: float,
    levels: Axes,
    order: Axes,
    reach: int,
    tiles: list[IntegerTile] | None,
    rows: int = ROWS,
) -> Predictor:
    """Return a predictor trained on tiles, or with weights of 0 without tiles."""
    count = sum(len(refinement.taps) for refinement in passes_of(levels, order, reach))
    weights = (0,) * count if tiles is None else fit_weights(tiles, levels, order, reach, rows)
    return Predictor(
        step=step, origin=origin, levels=levels, order=order, reach=reach, weights=weights
    )


def _weight_bytes(predictor: Predictor) -> int:
    """Return the bytes of the weights in a file."""
    return len(encode_block(np.array(predictor.weights, np.int32).reshape(1, 1, 1, -1)))


def fit_weights(
    tiles: list[IntegerTile], levels: Axes, order: Axes, reach: int, rows: int = ROWS
) -> tuple[int, ...]:
    """Return the weights of all taps, by robust least squares.

    Large errors count little, since the bytes they cost grow with their logarithm.

    levels, order, reach: form of the predictor, see `Predictor`.
    rows: vertices of each pass that are learned from.
    """
    weights: list[int] = []
    shifts = list(levels)
    generator = np.random.default_rng(0)
    for refinement in passes_of(levels, order, reach):
        if refinement.axis >= 0:
            shifts[refinement.axis] -= 1
        share = max(1, rows // len(tiles))
        equations = [
            _equations(tile, refinement, tuple(shifts), share, generator) for tile in tiles
        ]
        solution = _robust_solution(np.concatenate(equations))
        rounded = np.clip(np.rint(solution * WEIGHT_UNIT), -MAX_WEIGHT, MAX_WEIGHT)
        weights += rounded.astype(int).tolist()
    return tuple(weights)


def _equations(
    tile: IntegerTile,
    refinement: Pass,
    shifts: tuple[int, ...],
    max_rows: int,
    generator: np.random.Generator,
) -> npt.NDArray[np.float64]:
    """Return taps and values of some vertices of a pass, less their base: (n, taps + 1).

    The base of a vertex is the mean of its two neighbours along the axis of the pass. In the first
    pass it is the neighbour before it, along the last axis that has one.
    """
    lattice = tuple(slice(None, None, 1 << shift) for shift in shifts)
    fine = tile.integers[lattice]
    counted = None if tile.counted is None else tile.counted[lattice]
    axis, strides = refinement.axis, np.ones(4, dtype=np.int64)
    shape = np.array(fine.shape)
    if axis >= 0:
        strides[axis] = 2
        shape[axis] //= 2
    if not shape.all():
        return np.zeros((0, len(refinement.taps) + 1))
    chosen = generator.integers(0, np.prod(shape), min(max_rows, int(np.prod(shape))))
    at = np.stack(np.unravel_index(chosen, shape)) * strides[:, None]
    if axis >= 0:
        at[axis] += 1
    if counted is not None:
        at = at[:, counted[tuple(at)]]

    def neighbours(
        offset: npt.NDArray[np.int64],
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """Return the values at an offset, and whether they are inside and count."""
        place = at + offset[:, None]
        valid: npt.NDArray[np.bool_] = np.all(
            (place >= 0) & (place < np.array(fine.shape)[:, None]), axis=0
        )
        place = np.where(valid, place, 0)
        if counted is not None:
            valid &= counted[tuple(place)]
        return fine[tuple(place)].astype(np.float64), valid

    units = np.eye(4, dtype=np.int64)
    base = np.zeros(at.shape[1])
    if axis >= 0:
        base, _ = neighbours(-units[axis])
        after, valid = neighbours(units[axis])
        base = np.where(valid, (base + after) / 2, base)
    else:
        for unit in units:
            before, valid = neighbours(-unit)
            base = np.where(valid, before, base)
    columns = []
    for of_this_pass, *offset in refinement.taps:
        moved = np.array(offset, dtype=np.int64) * strides
        if axis >= 0 and not of_this_pass:
            moved[axis] -= 1
        value, valid = neighbours(moved)
        columns.append(np.where(valid, value - base, 0.0))
    columns.append(fine[tuple(at)] - base)
    return np.stack(columns, axis=1)


def _robust_solution(equations: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the weights of the taps by iteratively reweighted least squares.

    equations: (n, taps + 1), the last column being the target. Zeros for too few rows.
    """
    taps, target = equations[:, :-1], equations[:, -1]
    count = taps.shape[1]
    importance: npt.NDArray[np.float64] = np.ones(len(equations))
    solution: npt.NDArray[np.float64] = np.zeros(count)
    if len(equations) < 4 * count:
        return solution
    for _ in range(ROUNDS):
        # Not by a library for matrices, whose threads would wait for processors.
        products = gram_of((equations * np.sqrt(importance)[:, None])[:, :, None], 0.0)
        gram = products[:-1, :-1]
        gram[np.diag_indices(count)] += RIDGE * np.trace(gram) / count + 1e-6
        solution = np.asarray(np.linalg.solve(gram, products[:-1, -1]), dtype=np.float64)
        importance = 1.0 / ((target - np.einsum("ij,j->i", taps, solution)) ** 2 + 0.5)
    return solution
