"""Structural similarity (SSIM) of volumes, with a Gaussian window and population covariance.

It is that of scikit-image with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False`.
Native code computes it where it is installed (fhash_codec/native/quality.cpp), else numpy. In
numpy a tile is filtered by three products with small banded matrices, since the window is separable
and short: ten times faster than adding shifted arrays. Source: Wang et al. 2004.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise, product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.measure.errors import range_and_sum
from fhash_codec.measure.value_range import pieces, power_of_two
from fhash_formats.errors import InputError
from fhash_formats.support.threads import share_out, usable_threads

SIGMA = 1.5
"""Standard deviation of the Gaussian window, in vertices."""

RADIUS = 5
"""Vertices of the window on either side of its middle."""

WINDOW = 2 * RADIUS + 1
"""Vertices of the window along each axis."""

K1 = 0.01
"""Constant of the mean, as a fraction of the range (Wang et al. 2004)."""

K2 = 0.03
"""Constant of the variance, as a fraction of the range (Wang et al. 2004)."""

TILE = (64, 32, 64)
"""Vertices (z, y, x) that native code (fhash_codec/native/quality.cpp) compares at once."""

BUDGET = 2**25
"""Vertices of all steps that are measured together, by default."""

_NOT_FINITE = "SSIM: decoded values are not finite where they are compared"

Doubles = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Tile = tuple[tuple[int, int], ...]
"""Half-open spans of vertices along z, y and x."""


def ssim(
    original: npt.NDArray[Any],
    decoded: npt.NDArray[Any],
    data_range: float,
    mask: Mask | None = None,
    *,
    threads: int | None = None,
) -> tuple[float, int]:
    """Sum of the local similarity of two frames, and the number of vertices in the sum.

    Their quotient is the mean SSIM.

    original, decoded: frames (z, y, x) of one shape.
    data_range: of the series, in data units; 0 or an infinite one has no SSIM and gives (0.0, 0).
    mask: vertices (z, y, x) to be measured. A mask of all True is no mask.
    threads: `usable_threads()` if None.

    Without a mask, the outer 5 vertices of every axis of at least 11 are left out, as scikit-image
    does; a shorter axis is measured whole, and an axis of one vertex gives the SSIM of the plane.
    With a mask, only its vertices are counted, and both frames take the original's value outside
    it. Borders are mirrored (scipy's
    'reflect'). Vertices whose original is not finite are not counted, and both frames take the mean
    of the original there. Raises InputError for frames of different shapes, and for decoded values
    that are not finite at a vertex that is compared.
    """
    if (
        original.ndim != 3
        or original.shape != decoded.shape
        or (mask is not None and mask.shape != original.shape)
    ):
        raise InputError(
            f"SSIM: the original is {original.shape}, the decoded {decoded.shape}; "
            "frames (z, y, x) of one shape are needed"
        )
    if not 0 < data_range < math.inf:
        return 0.0, 0
    if mask is not None and mask.all():
        mask = None
    margins = [RADIUS if mask is None and size >= WINDOW else 0 for size in original.shape]
    frames = _Frames(original, decoded, data_range, mask)
    spans = zip(margins, original.shape, TILE, strict=True)
    tiles = list(product(*(_cuts(margin, size - margin, limit) for margin, size, limit in spans)))
    results: dict[Tile, tuple[float, int]] = {}

    def work(share: Sequence[Tile]) -> None:
        for tile in share:
            results[tile] = frames.similarity(tile)

    share_out(work, tiles, usable_threads(threads))
    totals, counts = zip(*results.values(), strict=True)
    return math.fsum(totals), sum(counts)


def ssim_steps(steps: int, vertices_per_step: int, budget: int = BUDGET) -> list[int]:
    """Evenly spaced steps, ends included, with at most `budget` vertices together.

    At least one step is measured: the middle one.
    """
    count = max(1, min(steps, budget // max(vertices_per_step, 1)))
    if count == 1:
        return [steps // 2]
    return [(2 * number * (steps - 1) + count - 1) // (2 * (count - 1)) for number in range(count)]


class _Frames:
    """Two frames to compare, scaled by a power of two near the range and shifted by the mean.

    Their squares then stay small and exact.
    """

    def __init__(
        self,
        original: npt.NDArray[Any],
        decoded: npt.NDArray[Any],
        data_range: float,
        mask: Mask | None,
    ) -> None:
        self.scale = np.float64(power_of_two(data_range))
        self.c1, self.c2 = (K1 * data_range * self.scale) ** 2, (K2 * data_range * self.scale) ** 2
        narrow = decoded.dtype == np.float32 and (
            original.dtype == np.float32 or original.dtype.itemsize <= 2
        )
        kind = np.float32 if narrow else np.float64
        self.original, self.decoded = (
            np.ascontiguousarray(frame, dtype=kind) for frame in (original, decoded)
        )
        self.mask = None if mask is None else np.ascontiguousarray(mask)
        count, total = 0, 0.0
        for piece in pieces(self.original):
            piece_count, _, _, piece_total = range_and_sum(piece, float(self.scale))
            count, total = count + piece_count, total + piece_total
        self.mean = np.float64(total / count if count else 0.0)

    def similarity(self, tile: Tile) -> tuple[float, int]:
        """Sum of the similarity over a tile, and the number of vertices in the sum."""
        function = getattr(native.library(), f"fhash_ssim_f{8 * self.original.dtype.itemsize}")
        total = ctypes.c_double()
        numbers = (self.scale, self.mean, self.c1, self.c2, *_weights()[RADIUS:])
        count = function(
            *(
                ctypes.c_void_p(None if array is None else array.ctypes.data)
                for array in (self.original, self.decoded, self.mask)
            ),
            (ctypes.c_int64 * 3)(*self.original.shape),
            (ctypes.c_int64 * 6)(*(end for span in tile for end in span)),
            (ctypes.c_double * len(numbers))(*numbers),
            ctypes.byref(total),
        )
        if count == -1:
            raise InputError(_NOT_FINITE)
        if count < 0:
            raise MemoryError(f"no memory to compare the frames' tile {tile}")
        return total.value, count


def _cuts(start: int, stop: int, limit: int) -> list[tuple[int, int]]:
    """Spans of at most `limit` vertices that split an axis evenly."""
    count = -(-(stop - start) // limit)
    ends = [start + (stop - start) * number // count for number in range(count + 1)]
    return list(pairwise(ends))


@lru_cache(maxsize=1)
def _weights() -> Doubles:
    """The Gaussian window along one axis (WINDOW,); its sum is 1."""
    weights = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
    normalised: Doubles = weights / weights.sum()
    return normalised
