"""Differences of two readers of a file: none but for networks, whose sums have any order."""

from __future__ import annotations

import numpy as np

import fhash_codec
from fhash_codec.paper.model import PaperModel


def rounding(volume: fhash_codec.Volume) -> float:
    """The largest difference, in data units."""
    if not isinstance(volume._model, PaperModel):
        return 0.0
    low, high = volume.value_range.floats
    spacing = np.spacing(volume.float_dtype.type(max(abs(low), abs(high))))
    return volume._model.network.rounding() * (high - low) + float(spacing)
