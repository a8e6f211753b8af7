"""A readable decoder of one tile of `fhash.transform`: FORMAT.md as numpy and plain Python.

It decodes only, checks little and is some thousand times slower than the product. The tests compare
the product with it bit for bit. Read it in this order:

1. tile.py: flags, sections, settings, and the order of the steps that make values.
2. adaptive.py: the range coder, estimates, and how they are mixed.
3. bands.py, integers.py: where coefficients lie, and how they and other integers are coded.
4. transform.py: weights, the inverse of wavelets and of bases of the data.
5. head.py: the trained correction.
6. masks.py, labels.py, predictor.py: the other kinds of tiles.
"""

from __future__ import annotations

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
