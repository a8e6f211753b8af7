"""Dependent quantisation: which integers a tile gets, chosen by their squared error and bits.

Two quantisers of step 2 delta share the multiples of delta: the first has the even ones, the second
the odd ones and zero. A trellis of eight states says which of them is next, by the parity of the
index before (FORMAT.md, Two quantisers). The path of least cost is found by the algorithm of
Viterbi (Forney 1973), in native/trellis.cpp. A decoder needs none of this: it follows the states.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.transform.entropy.coder import array_arguments, checked
from fhash_formats.transform.entropy.table import HIGH, LOW, Table

__all__ = ["BUCKETS", "COST", "RATES", "choose_levels", "rates_of"]

BUCKETS = 64
"""Classes of the expected magnitude of an index: 0, and half octaves."""
RATES = 24
"""Indices with a rate of their own; larger ones have the last one's."""
COST = 32768
"""Costs of a squared step; costs are whole numbers."""
MAX_RATE_COST = 1 << 19
"""Largest cost of the bits of an index, so that sums of costs stay in 32 bits."""
SIGN_BITS = 0.85
"""Bits of a sign, which contexts predict a little."""
NEIGHBOUR_SHARE = 0.3
"""Weight of the counts of the next buckets in those of a bucket."""
PRIOR_COUNT = 8.0
"""Observations that a geometric distribution of the mean of a bucket stands for."""

Integers = npt.NDArray[np.int32]


def choose_levels(
    scaled: npt.NDArray[Any], table: Table, weight: float, iterations: int = 1
) -> Integers:
    """The integers v, in units of delta, of the cheapest path through the trellis, int32.

    Args:
        scaled: coefficients / delta (t, z, y, x), float32 or float64, magnitudes below 2^30.
        table: the bands; integers outside of them are 0.
        weight: squared deltas that a bit is worth.
        iterations: how often the path is searched, each time with the bits of the indices that were
            found before.
    """
    scaled = np.ascontiguousarray(scaled)
    buckets, counts = _counted(scaled, table)
    levels = _chosen(scaled, table, buckets, rates_of(counts, weight))
    for _ in range(1, iterations):
        buckets, counts = _counted(levels, table)
        levels = _chosen(scaled, table, buckets, rates_of(counts, weight))
    return levels


def rates_of(counts: npt.NDArray[np.int64], weight: float) -> Integers:
    """The costs of the bits of indices, int32 (2, BUCKETS, RATES).

    Args:
        counts: numbers of indices by quantiser, bucket and index.
        weight: squared deltas that a bit is worth.
    """
    smooth = counts.astype(np.float64)
    smooth[:, 1:] += NEIGHBOUR_SHARE * counts[:, :-1]
    smooth[:, :-1] += NEIGHBOUR_SHARE * counts[:, 1:]
    total = smooth.sum(axis=2, keepdims=True)
    index = np.arange(RATES)
    mean = ((smooth * index).sum(axis=2, keepdims=True) + 0.02) / (total + 1)
    share = mean / (1 + mean)
    chance = (smooth + PRIOR_COUNT * (1 - share) * share**index) / (total + PRIOR_COUNT)
    bits = -np.log2(np.maximum(chance, 1e-9)) + np.where(index > 0, SIGN_BITS, 0.0)
    costs: Integers = np.minimum(np.rint(bits * weight * COST), MAX_RATE_COST).astype(np.int32)
    return costs


def _counted(
    source: npt.NDArray[Any], table: Table
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """The bucket of each vertex, in coded order, and the counts of `rates_of`.

    source: integers of the path that was found before, int32; or coefficients / delta, for which a
        path is guessed.
    """
    vertices = int(np.prod(table[:, HIGH : HIGH + 4] - table[:, LOW : LOW + 4], axis=1).sum())
    buckets = np.empty(vertices, np.uint8)
    counts = np.zeros((2, BUCKETS, RATES), np.int64)
    library = native.library()
    guess = f"fhash_trellis_guess_f{source.dtype.itemsize * 8}"
    count = library.fhash_trellis_count if source.dtype == np.int32 else getattr(library, guess)
    checked(
        count(
            _pointer(source),
            (ctypes.c_int64 * 4)(*source.shape),
            *array_arguments(table),
            _pointer(buckets),
            _pointer(counts),
        )
    )
    return buckets, counts


def _chosen(
    scaled: npt.NDArray[Any], table: Table, buckets: npt.NDArray[np.uint8], rates: Integers
) -> Integers:
    """The integers of the cheapest path."""
    levels = np.zeros(scaled.shape, np.int32)
    checked(
        getattr(native.library(), f"fhash_trellis_choose_f{scaled.dtype.itemsize * 8}")(
            _pointer(scaled),
            (ctypes.c_int64 * 4)(*scaled.shape),
            *array_arguments(table),
            _pointer(buckets),
            _pointer(rates),
            _pointer(levels),
        )
    )
    return levels


def _pointer(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
