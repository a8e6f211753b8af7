"""The predictor of a series: trained on a sample, tried in several forms, and raced against the transform under a bound."""

from __future__ import annotations

import math
from dataclasses import replace
from math import prod

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.tiles.blocks import Care, Values
from fhash_codec.compact.tiles.sample import Sample, pool
from fhash_formats.transform.entropy.predict import encode_predicted, integers_of
from fhash_formats.transform.entropy.predictor import (
    MAX_WEIGHT,
    WEIGHT_UNIT,
    Pass,
    Predictor,
    passes_of,
)
from fhash_formats.transform.tile.settings import TileSettings

ORDERS = ((0, 1, 2, 3), (0, 3, 2, 1), (3, 2, 1, 0))
"""In which order the axes are refined: what comes last is predicted best, and is half of all."""
DEPTHS = ((2, 3, 3, 3), (0, 3, 3, 3))
ROWS, TRIED_ROWS = 30_000, 8_000
"""Vertices of a pass that its weights are trained on, and for a trial."""
HOPELESS = 1.3
"""By what factor the first trial may be larger than what it competes with: the others differ by less."""
ROUNDS = 4
MAX_VERTICES, TRIED_VERTICES = 48 << 20, 4 << 20
"""Of a series that the weights are trained on as a whole, and of the tiles that are coded by each trial."""
RIDGE = 1e-3
WHOLE = 2.0**40
"""Bounds on whole numbers from here on are treated as those of real ones."""

Integers = npt.NDArray[np.int32]
Four = tuple[int, int, int, int]


def race(
    sample: Sample, settings: TileSettings, size: int, *, error: float, effort: int
) -> tuple[TileSettings, int]:
    """Settings with a predictor, and the bytes of all tiles, where that is less than `size`; else as they were.

    error: the strict bound. The residual's quantum, which keeps it, is also the distance of predicted values.
    """
    whole = sample.blocks.dtype.kind in "iu" and error < WHOLE
    # Whole numbers stand at whole distances: those of an odd number keep the whole part of half of it.
    step, origin = (
        (2.0 * int(error) + 1.0, float(round(settings.center)))
        if whole
        else (settings.quantum, settings.center)
    )
    found = (
        choose_predictor(sample, step=step, origin=origin, effort=effort, rival=size)
        if step > 0
        else None
    )
    if found is None or found[1] >= size:
        return settings, size
    # The transform is not used any more: one that needs no bytes.
    plain = usual_transform(sample.tiles[0][0].shape)
    return replace(settings, predictor=found[0], transform=plain, head=None), found[1]


def fit(
    tiles: list[tuple[Integers, Care]], levels: Four, order: Four, reach: int, number: int = ROWS
) -> tuple[int, ...]:
    """Weights of all taps, by least squares that count large errors little: what they cost grows with their logarithm.

    number: vertices of each pass that are learnt from.
    """
    weights: list[int] = []
    shift = list(levels)
    generator = np.random.default_rng(0)
    for part in passes_of(levels, order, reach):
        if part.axis >= 0:
            shift[part.axis] -= 1
        share = max(1, number // len(tiles))
        rows = [
            _rows(integers, care, part, tuple(shift), share, generator) for integers, care in tiles
        ]
        found = _solve(np.concatenate(rows))
        weights += (
            np.clip(np.rint(found * WEIGHT_UNIT), -MAX_WEIGHT, MAX_WEIGHT).astype(int).tolist()
        )
    return tuple(weights)


def choose_predictor(
    sample: Sample, *, step: float, origin: float, effort: int, rival: float = math.inf
) -> tuple[Predictor, int] | None:
    """The predictor whose streams are smallest, and the bytes of all tiles by it, roughly.

    None where the integers would be too large, and where a first trial says that more bytes than those of the rival will be needed.

    Order, depth and taps are decided one after the other. Trained on all tiles of a series that is in memory and not too large, and tried
    on some of them: a few tiles are often not like the others.
    """
    plain = _predictor(step, origin, (0, 0, 0, 0), ORDERS[0], 0, None)
    known = sample.map(lambda tile: _whole(tile[0], tile[1], plain))
    every = known
    if sample.blocks.held and prod(sample.blocks.shape) <= MAX_VERTICES:
        every = list(sample.map_all(lambda tile: _whole(tile[0], tile[1], plain)))
    counting = [
        (integers, care)
        for integers, care in every
        if integers is not None and (care is None or care.any())
    ]
    if not counting or any(integers is None for integers, _ in known):
        return None
    few = counting[:: -(-sum(integers.size for integers, _ in counting) // TRIED_VERTICES)]

    ahead = sample.counted / sum(
        integers.size if care is None else int(np.count_nonzero(care)) for integers, care in few
    )

    def sizes(tiles: list[tuple[Integers, Care]], predictor: Predictor) -> list[int]:
        with pool() as workers:
            return list(
                workers.map(
                    lambda tile: len(encode_predicted(tile[0], tile[1], predictor)[0]), tiles
                )
            )

    def trial(levels: Four, order: Four, reach: int) -> tuple[float, Predictor]:
        t, z, y, x = (
            min(level, (length - 1).bit_length())
            for level, length in zip(levels, few[0][0].shape, strict=True)
        )
        now = _predictor(step, origin, (t, z, y, x), order, reach, counting, TRIED_ROWS)
        return sum(sizes(few, now)) * ahead + len(now.to_dict()["weights"]), now

    best = trial(DEPTHS[0], ORDERS[0], 1)
    if best[0] > HOPELESS * rival:
        return None
    for order in ORDERS[1:] if effort > 2 else ():
        best = min(best, trial(DEPTHS[0], order, 1), key=lambda pair: pair[0])
    for levels in DEPTHS[1:] if effort > 2 else ():
        best = min(best, trial(levels, best[1].order, 1), key=lambda pair: pair[0])
    for taps in (0, 2) if effort > 3 else ():
        best = min(best, trial(best[1].levels, best[1].order, taps), key=lambda pair: pair[0])
    predictor = _predictor(step, origin, best[1].levels, best[1].order, best[1].reach, counting)
    coded = sizes([(integers, care) for integers, care in known if integers is not None], predictor)
    return predictor, sum(w * n for w, n in zip(sample.weights, coded, strict=True)) + len(
        predictor.to_dict()["weights"]
    )


def _predictor(
    step: float,
    origin: float,
    levels: Four,
    order: Four,
    reach: int,
    tiles: list[tuple[Integers, Care]] | None,
    number: int = ROWS,
) -> Predictor:
    """Trained on tiles, or with weights of 0."""
    count = sum(len(part.taps) for part in passes_of(levels, order, reach))
    weights = (0,) * count if tiles is None else fit(tiles, levels, order, reach, number)
    return Predictor(
        step=step, origin=origin, levels=levels, order=order, reach=reach, weights=weights
    )


def _whole(values: Values, care: Care, predictor: Predictor) -> tuple[Integers | None, Care]:
    counts = np.isfinite(values) if values.dtype.kind == "f" else np.ones(values.shape, bool)
    if care is not None:
        counts &= care
    return integers_of(values, counts, predictor), None if counts.all() else counts


def _rows(
    integers: Integers,
    care: Care,
    part: Pass,
    shift: tuple[int, ...],
    most: int,
    generator: np.random.Generator,
) -> npt.NDArray[np.float64]:
    """Some vertices of a pass: how far their taps and they themselves lie from the base, (n, taps + 1)."""
    fine = integers[tuple(slice(None, None, 1 << s) for s in shift)]
    counts = None if care is None else care[tuple(slice(None, None, 1 << s) for s in shift)]
    axis, steps = part.axis, np.ones(4, dtype=np.int64)
    shape = np.array(fine.shape)
    if axis >= 0:
        steps[axis] = 2
        shape[axis] //= 2
    if not shape.all():
        return np.zeros((0, len(part.taps) + 1))
    chosen = generator.integers(0, np.prod(shape), min(most, int(np.prod(shape))))
    at = np.stack(np.unravel_index(chosen, shape)) * steps[:, None]
    if axis >= 0:
        at[axis] += 1
    if counts is not None:
        at = at[:, counts[tuple(at)]]

    def take(
        offset: npt.NDArray[np.int64],
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        place = at + offset[:, None]
        there: npt.NDArray[np.bool_] = np.all(
            (place >= 0) & (place < np.array(fine.shape)[:, None]), axis=0
        )
        place = np.where(there, place, 0)
        if counts is not None:
            there &= counts[tuple(place)]
        return fine[tuple(place)].astype(np.float64), there

    one = np.eye(4, dtype=np.int64)
    base = np.zeros(at.shape[1])
    if axis >= 0:
        base, _ = take(-one[axis])
        other, there = take(one[axis])
        base = np.where(there, (base + other) / 2, base)
    else:
        for near in range(4):
            value, there = take(-one[near])
            base = np.where(there, value, base)
    columns = []
    for own, *offset in part.taps:
        moved = np.array(offset, dtype=np.int64) * steps
        if axis >= 0 and not own:
            moved[axis] -= 1
        value, there = take(moved)
        columns.append(np.where(there, value - base, 0.0))
    columns.append(fine[tuple(at)] - base)
    return np.stack(columns, axis=1)


def _solve(rows: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    taps, target = rows[:, :-1], rows[:, -1]
    count = taps.shape[1]
    weights: npt.NDArray[np.float64] = np.ones(len(rows))
    found: npt.NDArray[np.float64] = np.zeros(count)
    if len(rows) < 4 * count:
        return found
    for _ in range(ROUNDS):
        scaled = taps * weights[:, None]
        gram = scaled.T @ taps
        gram[np.diag_indices(count)] += RIDGE * np.trace(gram) / count + 1e-6
        found = np.asarray(np.linalg.solve(gram, scaled.T @ target), dtype=np.float64)
        weights = 1.0 / ((target - taps @ found) ** 2 + 0.5)
    return found
