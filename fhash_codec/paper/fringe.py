"""The fringe of the key frames in the finest table: trained, and stored in few bits.

A vertex in the coreset of one of two neighbouring key frames only needs embeddings at both, because
a value between them depends on both (`coreset.extent`). The network decodes it at the key frame
where it is in no coreset, so its finest embedding there is worth less: it weighs in only beside the
other key frame, and an error of it fades towards that one. It is therefore rounded to a coarse
step, which makes most of these numbers 0 or one of a few.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset import occupancy
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.network import Floats

__all__ = ["fringe_step", "round_fringe"]

STEP_SHARE = 0.5
"""Largest step as a share of the embeddings' root mean square. The noise is then 17 dB below them.

On a crop of a shock and a cloud, 10 key frames, it took 0.02 dB of the fringe's 34.4 dB between key
frames, and three quarters of the bytes that the fringe had added.
"""


def fringe_step(coreset: Coreset, key_frames: int, finest: Callable[[int], Floats]) -> float | None:
    """Return the step to which finest embeddings of the fringe are rounded, a power of two.

    None where there is no fringe, or nothing in it was trained.

    Args:
        coreset: the coreset.
        key_frames: number of key frames.
        finest: key frame -> finest embeddings (z, y, x, E), 0 at vertices that are no samples.
    """
    squares, count = 0.0, 0
    for key in range(key_frames):
        embeddings = finest(key)[_outside(coreset, key)].astype(np.float64)
        squares += float(np.square(embeddings).sum())
        count += int(np.count_nonzero(embeddings))
    if not count or not 0 < squares < math.inf:
        return None
    return float(2.0 ** math.floor(math.log2(STEP_SHARE * math.sqrt(squares / count))))


def round_fringe(coreset: Coreset, key: int, embeddings: Floats, step: float | None) -> Floats:
    """Return the finest embeddings (z, y, x, E) of a key frame with its fringe rounded.

    Args:
        coreset: the coreset.
        key: the key frame.
        embeddings: its finest embeddings.
        step: from `fringe_step`.
    """
    if step is None:
        return embeddings
    rounded = np.rint(embeddings / np.float32(step)) * np.float32(step)
    outside = _outside(coreset, key)[..., None]
    # Adding 0 turns -0 into 0: one pattern of bits for the most frequent number.
    result: Floats = np.where(outside, rounded + np.float32(0), embeddings)
    return result


def _outside(coreset: Coreset, key: int) -> npt.NDArray[np.bool_]:
    """Return the vertices (z, y, x) of the box that are not in the coreset of a key frame."""
    return ~occupancy.unpack(coreset.occupancy[key], coreset.box.shape)
