"""Places of the samples of a coreset, and the part of a coreset that is of one key frame."""

from __future__ import annotations

from dataclasses import replace
from math import prod

import numpy as np
import numpy.typing as npt

from fhash_codec.features.bricks import Coreset


def sample_places(coreset: Coreset) -> npt.NDArray[np.int32]:
    """Places (samples, 4) of the samples in their order: (key, z, y, x) in vertices of the box."""
    vertices = prod(coreset.brick_shape)
    mask = np.unpackbits(coreset.mask_bits, axis=1, count=vertices).astype(bool)
    brick, vertex = np.nonzero(mask)
    inside = np.stack(np.unravel_index(vertex, coreset.brick_shape), axis=1)
    corner = coreset.bricks[brick, 1:] * np.array(coreset.brick_shape, np.int32)
    return np.concatenate(
        [coreset.bricks[brick, :1], (corner + inside).astype(np.int32)], axis=1, dtype=np.int32
    )


def of_key_frame(coreset: Coreset, key: int) -> Coreset:
    """The samples of one key frame, as a coreset of this frame alone in the same box."""
    rows = np.flatnonzero(coreset.bricks[:, 0] == key)
    bricks = coreset.bricks[rows].copy()
    bricks[:, 0] = 0
    counts = np.diff(coreset.offsets)[rows]
    return replace(
        coreset,
        key_frames=(coreset.key_frames[key],),
        bricks=bricks,
        mask_bits=coreset.mask_bits[rows],
        values=coreset.values[coreset.places(rows)] if len(rows) else coreset.values[:0],
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        occupancy=(coreset.occupancy[key],),
        apart=(),
        fringe=None,
    )
