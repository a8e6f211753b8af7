"""Arrays of dask as series: some steps are computed at a time, and never the whole."""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries, Series

__all__ = ["DaskSeries", "LazyFrames", "is_lazy"]

SLAB_BYTES = 64 << 20
"""Bytes of the steps of a chunk that are computed together, so that it is not computed again."""


def is_lazy(array: Any) -> bool:
    """Whether an array is one of dask, whose values are computed when they are asked for."""
    graph = getattr(array, "__dask_graph__", None)
    return graph is not None and graph() is not None


def _require_lengths(array: Any) -> None:
    """Raise InputError for a dask array with lengths that are not known before it is computed."""
    if any(length != length for length in array.shape):
        raise InputError(
            f"the dask array has shape {array.shape}; compute_chunk_sizes() finds the lengths"
        )


class LazyFrames:
    """The frames of a dask array.

    Attributes:
        array: the dask array (t, z, y, x).
    """

    def __init__(self, array: Any) -> None:
        """Take an array of 4 axes; raises InputError for lengths that are not known."""
        _require_lengths(array)
        self.array = array
        self._held: tuple[range, npt.NDArray[Any]] = range(0), np.empty(0)

    def read(self, step: int) -> npt.NDArray[Any]:
        """A frame (z, y, x); the other steps of its chunk, up to SLAB_BYTES, are kept for later."""
        held = self._held
        if step not in held[0]:
            self._held = range(0), np.empty(0)  # its memory is free before more is computed
            steps = self._slab(step)
            held = self._held = steps, np.asarray(self.array[steps.start : steps.stop])
        frame: npt.NDArray[Any] = held[1][step - held[0].start]
        return frame

    def _slab(self, step: int) -> range:
        """The steps that are computed with a step: those of its chunk, as far as they fit."""
        frame = self.array.dtype.itemsize * prod(self.array.shape[1:])
        most, first = max(1, SLAB_BYTES // frame), 0
        for length in self.array.chunks[0]:
            if step < first + length:
                start = first + (step - first) // most * most
                return range(start, min(start + most, first + length))
            first += length
        raise AssertionError("the step is in a chunk")


class DaskSeries(Series):
    """A dask array (t, z, y, x) or (z, y, x) without labels as a series.

    Attributes:
        lazy: its frames.
    """

    def __init__(self, array: Any) -> None:
        """Take an array; raises InputError for one that cannot be a series."""
        _require_lengths(array)
        # An array in memory of this shape and type, which takes no room, has the same labels.
        labels = ArraySeries(np.broadcast_to(np.zeros((), array.dtype), array.shape))
        self.source, self.name, self.units = labels.source, labels.name, labels.units
        self.dtype, self.shape, self.coords = labels.dtype, labels.shape, labels.coords
        self.attributes = labels.attributes
        self.lazy = LazyFrames(array if array.ndim == 4 else array[None])

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        return np.ascontiguousarray(self.lazy.read(step), dtype=self.dtype)
