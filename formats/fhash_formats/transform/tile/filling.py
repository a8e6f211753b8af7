"""What stands where values do not count: whatever takes few coefficients and leaves the values that count as they are.

Of all such tiles the one of fewest large coefficients is looked for, as in compressed sensing: coefficients below a threshold become 0,
what counts is put back, and the threshold falls. A step goes on in the direction of the one before (Nesterov), which reaches further.
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

HIGHEST, LOWEST = 64.0, 0.4
"""Thresholds, in quantiser steps."""
NEARBY = 16.0
"""The first threshold where what is there is a good filling already."""
RATIOS = {1: 0.5, 2: 0.7071067811865476, 4: 0.8408964152537145, 8: 0.9170040432046712}
"""From one threshold to the next, by how many there are to the factor of two: constants, so that every machine has the same."""
MOMENTUM = 0.8
FEW_BITS = 64
"""Of the magnitudes of a tile, of which more thresholds could not save many."""


def filled(
    target: Values,
    counts: Mask,
    finite: Mask,
    transform: Transform,
    settings: TileSettings,
    density: int = 1,
) -> Values:
    """`target` (t, z, y, x) with other values where it does not count.

    finite: where it has values. density: 1, 2, 4 or 8 thresholds to each factor of two; 0 goes on from a filling that was made for other
    settings, by a few thresholds. Begins with the values that are there, because they
    often go on from what counts, or with the mean of what counts: with that which takes fewer bits. Where the values that are there
    take fewer bytes, they stay.
    """
    # A running sum has one order on every machine, a mean has not.
    mean = settings.dtype.type(
        np.cumsum(target[counts], dtype=np.float64)[-1] / np.count_nonzero(counts)
    )
    t, z, y, x = target.shape
    if density == 0:
        return _settled(np.where(finite, target, mean), counts, transform, settings, 1, NEARBY)
    own = np.where(finite, target, mean)
    starts = (own, np.where(counts, target, mean))
    settled = [_settled(start, counts, transform, settings, 1) for start in starts]
    bits = [_bits(values, transform, settings) for values in settled]
    better = bits.index(min(bits))
    enough = density == 1 or bits[better] < FEW_BITS
    found = (
        settled[better]
        if enough
        else _settled(starts[better], counts, transform, settings, density)
    )
    # Bits are a rough measure: smooth values of many bits may be coded in few.
    table = band_table(settings.transform, (t, z, y, x))
    sizes = [
        len(encode_integers(quantise(transform.forward(values), settings.step)[0], table).data)
        for values in (own, found)
    ]
    return own if sizes[0] <= sizes[1] else found


def _bits(values: Values, transform: Transform, settings: TileSettings) -> int:
    """Of all magnitudes together."""
    integers = quantise(transform.forward(values), settings.step)[0]
    return int(np.frexp(integers.astype(np.float32))[1].sum(dtype=np.int64))


def _settled(
    start: Values,
    counts: Mask,
    transform: Transform,
    settings: TileSettings,
    density: int,
    threshold: float = HIGHEST,
) -> Values:
    kind = settings.dtype.type
    now, guess = start, start
    while threshold > LOWEST:
        coefficients = transform.forward(guess)
        coefficients[np.abs(coefficients) < kind(threshold * settings.step)] = 0
        before, now = now, np.where(counts, start, transform.inverse(coefficients))
        guess = now + kind(MOMENTUM) * (now - before)
        threshold *= RATIOS[density]
    return now
