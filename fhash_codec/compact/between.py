"""Choice of the rule between two steps, on steps of a series that are left out."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.model import values_between
from fhash_codec.compact.sample import GOLDEN_RATIO
from fhash_codec.features.features import Extent
from fhash_codec.features.key_frames import KeyTimes, time_axis
from fhash_codec.measure.value_range import ValueRange, power_of_two
from fhash_formats.container.header import BETWEEN, CUBIC, LINEAR
from fhash_formats.series import Series
from fhash_formats.support.values import Longs

LEFT_OUT = 16
"""Steps that are left out to choose the rule, at most."""
READ = 7
"""Frames that are held for it: of neighbours that are left out, none is read twice."""
VERTICES = 4096
"""Vertices that are compared at each of them, at most: a millisecond."""


def choose_between(series: Series, extent: Extent, value_range: ValueRange) -> dict[str, Any]:
    """Return what a header's `model` says of times between steps; nothing where none is measured.

    Some steps are left out and rebuilt from those at both sides, by each rule, at some vertices of
    the coreset. Integers stay linear.
    """
    count, width = series.shape[0], value_range.high - value_range.low
    if (series.source_dtype or series.dtype).kind != "f" or not 0 < width < math.inf or count < 5:
        return {}
    scale, squares = power_of_two(width), np.zeros(2)
    times = time_axis(series.coords["t"].values)

    frame = lru_cache(maxsize=READ)(lambda step: series.frame(step).reshape(-1))
    for left_out in np.unique(np.linspace(1, count - 2, LEFT_OUT).round().astype(int)).tolist():
        around = range(left_out - 3, left_out + 4, 2)
        keys = tuple(key for key in around if 0 <= key < count)
        vertices = _vertices(extent, range(left_out - 1, left_out + 2))
        held = {key: scale * frame(key)[vertices].astype(np.float64) for key in (*keys, left_out)}
        for key in keys:
            held[key][~_in_coreset(extent, key, vertices)] = np.nan
        frames = [held.get(key) for key in around]
        key_times, first = KeyTimes(times=times, key_frames=keys), keys.index(left_out - 1)
        distances = key_times.distances(first)
        share = np.array([key_times.key_index(left_out) - first])
        linear, _ = values_between([None, *frames[1:3], None], distances, share)
        cubic, _ = values_between(frames, distances, share)
        with np.errstate(invalid="ignore", over="ignore"):  # of values that are not finite
            errors = np.square(np.stack([linear, cubic]) - held[left_out])
        squares += errors[:, np.isfinite(errors).all(axis=0)].sum(axis=1)
    if squares[0] == squares[1]:
        return {}
    gain = 10 * math.log10(squares[0] / squares[1]) if squares.all() else None
    rule = CUBIC if squares[1] < squares[0] else LINEAR
    return {BETWEEN: {"rule": rule, "gain_db": None if gain is None else round(gain, 2)}}


def _vertices(extent: Extent, steps: range) -> Longs:
    """Return vertices of a frame that are in the coreset at all of some steps.

    They follow the golden ratio, so that no row or column is preferred.
    """
    size, vertices = math.prod(extent.domain), None
    if extent.fraction < 1:
        packed = np.bitwise_and.reduce(extent.packed[steps.start : steps.stop])
        vertices = np.flatnonzero(np.unpackbits(packed, count=size))
        size = vertices.size
    spread = np.arange(min(VERTICES, size)) * GOLDEN_RATIO % 1.0 * size
    chosen = spread.astype(np.int64)
    return chosen if vertices is None else vertices[chosen]


def _in_coreset(extent: Extent, step: int, vertices: Longs) -> npt.NDArray[np.bool_]:
    """Return which vertices of a frame are in the coreset at a step."""
    return (extent.packed[step][vertices >> 3] >> (7 - (vertices & 7)) & 1).astype(np.bool_)
