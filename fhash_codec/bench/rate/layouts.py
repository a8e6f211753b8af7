"""Layouts of a series for codecs of fewer axes: which parts of (t, z, y, x) are coded together.

A codec of volumes may take the steps one by one, the time course of each plane, or all steps or
planes one after the other along its first axis. Which is best depends on the series.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[Any]

LAYOUTS = {
    "frame": "(z, y, x) of each step",
    "plane": "(t, y, x) of each z",
    "series": "(t, z, y, x)",
    "folded": "(t z, y, x), frames folded into z",
    "turned": "(z t, y, x), the steps of each z one after the other",
}
"""Layouts by name, with the axes of their parts."""


def parts_of(values: Values, layout: str) -> Sequence[Values]:
    """The parts of values (t, z, y, x) that are coded apart."""
    steps, planes, *plane = values.shape
    if layout == "frame":
        return list(values)
    if layout == "plane":
        return list(np.moveaxis(values, 1, 0))
    if layout == "folded":
        return [values.reshape(steps * planes, *plane)]
    if layout == "turned":
        return [np.moveaxis(values, 1, 0).reshape(steps * planes, *plane)]
    return [values]


def joined(parts: Sequence[Values], layout: str, shape: tuple[int, ...]) -> Values:
    """Values of `shape` (t, z, y, x) from the parts that `parts_of` gives."""
    steps, planes, *plane = shape
    if layout == "frame":
        return np.stack(parts)
    if layout == "plane":
        return np.stack(parts, axis=1)
    if layout == "turned":
        return np.moveaxis(parts[0].reshape(planes, steps, *plane), 0, 1)
    return np.asarray(parts[0]).reshape(shape)
