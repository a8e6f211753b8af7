"""Exchange of quality for bytes between outcomes of tiles, in dB per octave of bytes."""

from __future__ import annotations

import math
from collections.abc import Sequence

from fhash_codec.compact.choices.search import EXCHANGE, exchange
from fhash_codec.compact.tiles.coding import Outcome

__all__ = ["octave_gain"]


def octave_gain(tried: Sequence[Outcome], data_range: float) -> float:
    """Return the dB that an octave of bytes buys, by outcomes of one coding at several steps.

    data_range: range of the values, in data units.
    """
    points = [
        (math.log2(outcome.size), outcome.psnr(data_range)) for outcome in tried if outcome.size
    ]
    return exchange(points, EXCHANGE)
