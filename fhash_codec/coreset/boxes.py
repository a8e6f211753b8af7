"""Boxes of vertices: the one type for feature bounding boxes and for regions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Sizes = tuple[int, int, int]
"""One number per axis, (z, y, x)."""

Span = tuple[int, int]
"""(first, end) along one axis in vertices; `end` is the vertex after the last one."""

Spans = tuple[Span, Span, Span]
"""Spans along z, y and x: a `Box`, or a plain tuple that stands for one."""


class Box(NamedTuple):
    """A box of vertices: one half-open span along each axis.

    It equals the plain tuple of its spans. Feature bounding boxes count vertices of the domain.
    Regions count vertices of the domain, or of the feature bounding box: the function that takes a
    region says which.
    """

    z: Span
    y: Span
    x: Span

    @classmethod
    def of(cls, spans: Iterable[Sequence[int]]) -> Box:
        """The box of three spans (first, end) in the order z, y, x."""
        z, y, x = ((first, end) for first, end in spans)
        return cls(z, y, x)

    @classmethod
    def of_shape(cls, shape: Iterable[int]) -> Box:
        """The box that holds every vertex of a grid of this shape (z, y, x)."""
        return cls.of((0, length) for length in shape)

    @property
    def first(self) -> Sizes:
        """The lowest vertex (z, y, x)."""
        return self.z[0], self.y[0], self.x[0]

    @property
    def shape(self) -> Sizes:
        """Vertices along each axis (z, y, x)."""
        (z0, z1), (y0, y1), (x0, x1) = self
        return z1 - z0, y1 - y0, x1 - x0

    def slices(self) -> tuple[slice, slice, slice]:
        """The index of the box's vertices in an array (z, y, x): `frame[box.slices()]`."""
        return slice(*self.z), slice(*self.y), slice(*self.x)

    def shift(self, offset: Iterable[int]) -> Box:
        """The box moved by an offset (z, y, x) in vertices."""
        moves = zip(self, offset, strict=True)
        return Box.of((first + move, end + move) for (first, end), move in moves)

    def intersect(self, other: Spans) -> Box | None:
        """The vertices that both boxes hold; None if there are none."""
        common = [
            (max(first, other_first), min(end, other_end))
            for (first, end), (other_first, other_end) in zip(self, other, strict=True)
        ]
        return Box.of(common) if all(first < end for first, end in common) else None


def bounding_box(mask: npt.NDArray[np.bool_]) -> Box | None:
    """The smallest box around the True vertices of a mask (z, y, x) (paper, Bounding Box).

    None if no vertex is True.
    """
    plane: npt.NDArray[np.bool_] = np.any(mask, axis=0)
    lines = [np.any(mask, axis=(1, 2)), np.any(plane, axis=1), np.any(plane, axis=0)]
    if not plane.any():
        return None
    return Box.of((int(line.argmax()), int(line.size - line[::-1].argmax())) for line in lines)


def fuse(boxes: Sequence[Box | None]) -> Box | None:
    """The smallest box that holds all boxes (paper, Temporal Fusion); None if all are None."""
    some = [box for box in boxes if box is not None]
    if not some:
        return None
    return Box.of(
        (min(first for first, _ in spans), max(end for _, end in spans))
        for spans in zip(*some, strict=True)
    )
