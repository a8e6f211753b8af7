"""Fill values for vertices that do not count: cheap to code, with the counted values unchanged.

The search looks for the tile with the fewest large coefficients, as in compressed sensing.
Coefficients below a threshold become 0, the counted values are put back, and the threshold falls.
Each step goes on in the direction of the step before (Nesterov), which reaches farther.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.axes.bands import band_table
from fhash_formats.transform.axes.lifting import Transform
from fhash_formats.transform.entropy.coder import encode_integers
from fhash_formats.transform.tile.settings import TileSettings
from fhash_formats.transform.values.quantise import quantise

__all__ = ["filled"]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]

HIGHEST = 64.0
"""First threshold, in quantiser steps."""
LOWEST = 0.4
"""The search ends when the threshold is at or below this many quantiser steps."""
NEARBY = 16.0
"""First threshold, in quantiser steps, where the present values are a good filling already."""
RATIOS = {1: 0.5, 2: 0.7071067811865476, 4: 0.8408964152537145, 8: 0.9170040432046712}
"""Ratio of a threshold to the one before it, by the number of thresholds per factor of two.

The ratios are constants, so that every machine has the same ones.
"""
MOMENTUM = 0.8
"""Share of the last change that is added to the next guess."""
FEW_BITS = 64
"""Tiles whose magnitudes have fewer bits in all are not searched with more thresholds."""


def filled(
    target: Values,
    counted: Mask,
    finite: Mask,
    transform: Transform,
    settings: TileSettings,
    density: int = 1,
) -> Values:
    """`target` (t, z, y, x) with fill values where it is not counted.

    The search starts from the present values, which often continue the counted ones, or from the
    mean of the counted values, whichever takes fewer bits. The present values stay where they take
    no more bytes than the result.

    Args:
        target: the tile, in the working type.
        counted: the values to keep.
        finite: where the tile has present values.
        transform: the transform of the tile.
        settings: settings of the tile; the step is the one the fill values are made for.
        density: 1, 2, 4 or 8 thresholds per factor of two. 0 goes on from a filling that was made
            for other settings, by a few thresholds.
    """
    # A running sum has one order on every machine, a mean has not.
    mean = settings.dtype.type(
        np.cumsum(target[counted], dtype=np.float64)[-1] / np.count_nonzero(counted)
    )
    present = np.where(finite, target, mean)
    if density == 0:
        return _search(present, counted, transform, settings, 1, NEARBY)
    starts = (present, np.where(counted, target, mean))
    results = [_search(start, counted, transform, settings, 1) for start in starts]
    bits = [_bits(values, transform, settings) for values in results]
    better = bits.index(min(bits))
    result = results[better]
    if density > 1 and bits[better] >= FEW_BITS:
        result = _search(starts[better], counted, transform, settings, density)
    # Bits are a rough measure: smooth values of many bits may be coded in few bytes.
    if _size(present, transform, settings) <= _size(result, transform, settings):
        return present
    return result


def _bits(values: Values, transform: Transform, settings: TileSettings) -> int:
    """Bits of the magnitudes of all quantised coefficients."""
    integers = quantise(transform.forward(values), settings.step)[0]
    return int(np.frexp(integers.astype(np.float32))[1].sum(dtype=np.int64))


def _size(values: Values, transform: Transform, settings: TileSettings) -> int:
    """Bytes of the coded coefficients."""
    table = band_table(settings.transform, values.shape)
    integers = quantise(transform.forward(values), settings.step)[0]
    return len(encode_integers(integers, table).data)


def _search(
    start: Values,
    counted: Mask,
    transform: Transform,
    settings: TileSettings,
    density: int,
    threshold: float = HIGHEST,
) -> Values:
    """The values where the search ends; `density` as in `filled`, `threshold` the first one."""
    kind = settings.dtype.type
    current, guess = start, start
    while threshold > LOWEST:
        coefficients = transform.forward(guess)
        coefficients[np.abs(coefficients) < kind(threshold * settings.step)] = 0
        before, current = current, np.where(counted, start, transform.inverse(coefficients))
        guess = current + kind(MOMENTUM) * (current - before)
        threshold *= RATIOS[density]
    return current
