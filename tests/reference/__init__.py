"""A readable decoder of one tile of `fhash.transform`: FORMAT.md as numpy and plain Python.

It decodes only, checks little and is some thousand times slower than the product. The tests compare
the product with it bit for bit. Read it in this order:

1. tile.py: flags, sections, settings, and the order of the steps that make values.
2. adaptive.py: the range coder, estimates, and how they are mixed.
3. bands.py, integers.py: where coefficients lie, and how they and other integers are coded.
4. transform.py: weights, the inverse of wavelets and of bases of the data.
5. head.py: the trained correction.
6. masks.py, labels.py, predictor.py: the other kinds of tiles.

`value_between` is the rule between two steps of a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, nan

import numpy as np

import fhash_codec
from fhash_codec.paper.model import PaperModel


def rounding(volume: fhash_codec.Volume) -> float:
    """The largest difference of two readers of a file, in data units.

    It is 0 but for networks, whose sums have any order.
    """
    if not isinstance(volume._model, PaperModel):
        return 0.0
    low, high = volume.value_range.floats
    spacing = np.spacing(volume.float_dtype.type(max(abs(low), abs(high))))
    return volume._model.network.rounding() * (high - low) + float(spacing)


def slope_at(rise: float, other: float, distance: float) -> float:
    """The slope at a step, in the distance of the two; see `value_between`.

    Args:
        rise: from the first of the two steps to the second.
        other: the rise on the other side of the step, NaN for none.
        distance: the time that it takes, in the distance of the two.
    """
    if not isfinite(other):
        return rise
    beside = other / distance
    if beside * rise <= 0:
        return 0.0
    return (3 + 3 * distance) / ((2 + distance) / beside + (1 + 2 * distance) / rise)


def value_between(values: Sequence[float], times: Sequence[float], step: float, rule: str) -> float:
    """The value of a vertex at a step that may be fractional.

    Args:
        values: at each step; NaN where there is none.
        times: of the steps, ascending.
        step: at which a value is wanted.
        rule: "linear" or "cubic".
    """
    first = int(step)
    share = step - first
    if not share:
        return values[first]
    one, two = values[first], values[first + 1]
    even = one * (1 - share) + two * share
    before = after = nan
    between, distances = times[first + 1] - times[first], [1.0, 1.0]
    if rule == "cubic" and first > 0:
        before = one - values[first - 1]
        distances[0] = (times[first] - times[first - 1]) / between
    if rule == "cubic" and first + 2 < len(values):
        after = values[first + 2] - two
        distances[1] = (times[first + 2] - times[first + 1]) / between
    left = slope_at(two - one, before, distances[0]) - (two - one)
    right = slope_at(two - one, after, distances[1]) - (two - one)
    bent = even + share * (1 - share) * (left * (1 - share) - right * share)
    return min(max(bent, min(one, two)), max(one, two)) if left or right else even
