"""Boxes of vertices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Box = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
"""((z0, z1), (y0, y1), (x0, x1)) in vertices of the domain, half-open."""


Sizes = tuple[int, int, int]
"""One number per axis, (z, y, x)."""


def bounding_box(mask: npt.NDArray[np.bool_]) -> Box | None:
    """The smallest box around the vertices of a mask (z, y, x), or None if there are none (paper, Bounding Box)."""
    plane: npt.NDArray[np.bool_] = np.any(mask, axis=0)
    lines = [np.any(mask, axis=(1, 2)), np.any(plane, axis=1), np.any(plane, axis=0)]
    if not plane.any():
        return None
    z, y, x = ((int(line.argmax()), int(line.size - line[::-1].argmax())) for line in lines)
    return z, y, x


def fuse(boxes: Sequence[Box | None]) -> Box | None:
    """The smallest box that holds all the boxes (paper, Temporal Fusion); None if there are none."""
    there = [box for box in boxes if box is not None]
    if not there:
        return None
    z, y, x = (
        (min(low for low, _ in spans), max(high for _, high in spans))
        for spans in zip(*there, strict=True)
    )
    return z, y, x


def box_size(box: Box) -> Sizes:
    """Vertices of a box along each axis."""
    (z0, z1), (y0, y1), (x0, x1) = box
    return z1 - z0, y1 - y0, x1 - x0


def crop(frame: npt.NDArray[Any], box: Box) -> npt.NDArray[Any]:
    """The part of a frame (z, y, x) inside a box, a view."""
    return frame[tuple(slice(low, high) for low, high in box)]
