"""Frames of a series with uneven axes, resampled to the even grid that is drawn."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.axes import Warp
from fhash_codec.rendering.task.task import Frame

__all__ = ["warped"]

Single = npt.NDArray[np.float32]


def warped(frame: Frame, warp: Warp | None) -> Frame:
    """Resample a frame of the series to the vertices that are drawn, linearly along each axis.

    The result has every `stride`-th drawn vertex between the first and the last value of the frame.
    A drawn vertex has no value where a vertex of weight beside it has none. Without a warp the
    frame itself is returned.
    """
    if warp is None:
        return frame
    values, first = frame.values, list(frame.first)
    for axis, number in ((0, 2), (1, 1), (2, 0)):
        places = warp.places[number]
        if places is not None:
            drawn = _drawn(places, frame, axis, warp.counts[number])
            at = (
                places[drawn.start : drawn.stop : frame.stride] - frame.first[axis]
            ) / frame.stride
            values = _resampled(values, np.clip(at, 0, values.shape[axis] - 1), axis)
            first[axis] = drawn.start
    return Frame(
        values=np.ascontiguousarray(values),
        first=(first[0], first[1], first[2]),
        stride=frame.stride,
    )


def _drawn(places: npt.NDArray[np.float64], frame: Frame, axis: int, count: int) -> range:
    """The drawn vertices within a frame along an axis (0, 1, 2 for z, y, x), at least one.

    A frame reaches to the end of the domain where no further vertex of it would fit.
    """
    low = frame.first[axis]
    end = low + frame.values.shape[axis] * frame.stride
    high = count - 1 if end > count - 1 else end - frame.stride
    begin = int(np.searchsorted(places, low - 1e-9, side="left"))
    stop = int(np.searchsorted(places, high + 1e-9, side="right"))
    begin = min(begin, len(places) - 1)
    return range(begin, max(stop, begin + 1), frame.stride)


def _resampled(values: Single, at: npt.NDArray[np.float64], axis: int) -> Single:
    """Values at places along an axis, in vertices of the frame."""
    before = np.minimum(at.astype(np.int64), max(values.shape[axis] - 2, 0))
    after = np.minimum(before + 1, values.shape[axis] - 1)
    shape = [1, 1, 1]
    shape[axis] = len(at)
    share = (at - before).astype(np.float32).reshape(shape)
    low = np.take(values, before, axis=axis)
    mixed: Single = np.take(values, after, axis=axis)
    # A missing vertex of no weight does not matter.
    with np.errstate(invalid="ignore", over="ignore"):
        mixed -= low
        mixed *= share
        mixed += low
    if np.isnan(mixed).any():
        np.copyto(mixed, low, where=share == 0)
        np.copyto(mixed, np.take(values, after, axis=axis), where=share == 1)
    return mixed
