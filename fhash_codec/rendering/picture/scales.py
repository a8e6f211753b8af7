"""Scales of the axes: names and end coordinates beside the volume, never over it.

A scale stands at an edge of the outline. The outline is convex, so that a text on the outer side of
the line through an edge touches nothing of the volume.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.box import Edge, outer_edges
from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.picture.lettering import Label, length, wrapped
from fhash_formats.series import Coordinate

__all__ = ["Rectangle", "end_texts", "overflow", "scales"]

Floats = npt.NDArray[np.float64]
Rectangle = tuple[float, float, float, float]
"""Left, top, right and bottom in pixels."""

NAME_PLACES = (0.5, 0.42, 0.58, 0.34, 0.66, 0.26, 0.74, 0.18, 0.82)
"""Places of a name along its edge, as shares of it, in the order in which they are tried."""
NAME_DISTANCES = (0.0, 1.5, 3.5, 6.0, 9.0)
"""Distances of a name from its usual place beside the edge, in heights of the font."""
END_PLACES = (0.5, 1.2, 2.0, 3.0, 4.0)
"""Distances of a coordinate from its end of the edge, in heights of the font."""
SHORTEST = 2.5
"""Length of an edge below which it has no scale, in heights of the font."""
LONG = 4
"""Length of a name above which it may be turned, in heights of the font."""
WRAPPED = 0.4
"""Length of the lines of a long name, as a share of the frame's width, at most."""
STEEP = 0.9
"""Sine of the slope of an edge above which a long name is turned along it."""


def scales(
    rays: Rays,
    view: Rectangle,
    frame: Rectangle,
    coords: Mapping[str, Coordinate],
    size: int,
    *,
    breaking: int,
) -> tuple[list[Label], int]:
    """Place the scales of the axes: labels without overlap, and the number of all labels.

    Args:
        rays: of the part of the picture that shows the volume.
        view: that part.
        frame: part that the labels should lie in; see `overflow` for what does not.
        coords: of the axes.
        size: height of the font in pixels.
        breaking: 0 for names in one line, 1 with units in a line of their own, 2 in lines no longer
            than WRAPPED of the frame.
    """
    wanted: list[list[Label]] = []
    for edge in outer_edges(rays):
        coordinate = coords["xyz"[edge.axis]]
        lines = _name(coordinate, size, breaking, WRAPPED * (frame[2] - frame[0]))
        wanted += _of_edge(edge, rays, view, coordinate, lines, size)
    placed: list[Label] = []
    for candidates in wanted:
        free = [label for label in candidates if not _covered(label, placed)]
        if free:
            placed.append(min(free, key=lambda label: round(sum(overflow([label], frame)), 3)))
    return placed, len(wanted)


def overflow(labels: Sequence[Label], frame: Rectangle) -> tuple[float, float, float, float]:
    """Lengths by which labels reach out of a rectangle: left, top, right, bottom, at least 0."""
    boxes = [label.box for label in labels]
    return (
        max([frame[0] - box[0] for box in boxes] + [0.0]),
        max([frame[1] - box[1] for box in boxes] + [0.0]),
        max([box[2] - frame[2] for box in boxes] + [0.0]),
        max([box[3] - frame[3] for box in boxes] + [0.0]),
    )


def _name(coordinate: Coordinate, size: int, breaking: int, limit: float) -> tuple[str, ...]:
    """The lines of an axis' name with its units."""
    units = str(coordinate.attributes.get("units", ""))
    if units in ("", "1"):
        lines: tuple[str, ...] = (coordinate.name,)
    else:
        lines = (coordinate.name, f"[{units}]")
    if breaking == 2:
        return wrapped(" ".join(lines), size, limit)
    return lines if breaking else (" ".join(lines),)


def end_texts(first: float, last: float) -> tuple[str, str]:
    """Texts of the first and the last coordinate, with 4 digits of their distance or more."""
    extent = abs(last - first)
    if not (math.isfinite(first) and math.isfinite(last)) or extent == 0:
        return f"{first:.6g}", f"{last:.6g}"
    places = 3 - math.floor(math.log10(extent))
    largest = max(abs(first), abs(last))
    if places > 8 or largest >= 1e9:
        digits = min(max(math.ceil(math.log10(largest / extent)) + 3, 3), 15)
        return f"{first:.{digits}g}", f"{last:.{digits}g}"
    texts = [f"{round(value, places) + 0.0:.{max(places, 0)}f}" for value in (first, last)]
    first_text, last_text = (
        text.rstrip("0").rstrip(".") if "." in text else text for text in texts
    )
    return first_text, last_text


def _of_edge(
    edge: Edge,
    rays: Rays,
    view: Rectangle,
    coordinate: Coordinate,
    lines: tuple[str, ...],
    size: int,
) -> Iterator[list[Label]]:
    """Yield the places that each label of an edge may have, the best first."""
    offset = np.array(view[:2])
    visible = _clipped(edge.ends + offset, view)
    if visible is None:
        return
    ends, whole = visible
    along = ends[1] - ends[0]
    extent = float(np.linalg.norm(along))
    if extent < SHORTEST * size:
        return
    along = along / extent
    centre = rays.project(rays.grid.bounds.mean(axis=1)[None])[0][0] + offset
    outward = np.array([-along[1], along[0]])
    outward = outward if float(outward @ (ends.mean(axis=0) - centre)) >= 0 else -outward
    upright = (
        abs(float(along[1])) > STEEP and max(length(line, size) for line in lines) > LONG * size
    )

    def beside(place: Floats, label: Label) -> Label:
        """The label outside the edge, at a place of it."""
        wide, tall = label.extent
        reach = abs(float(outward[0])) * wide / 2 + abs(float(outward[1])) * tall / 2
        x, y = place + outward * (reach + 0.5 * size)
        return replace(label, centre=(float(x), float(y)))

    name = Label(lines=lines, centre=(0.0, 0.0), size=size, upright=upright)
    first, last = end_texts(*(float(value) for value in coordinate.values[[0, -1]]))
    for end, text, there, back in (
        (ends[0], first, whole[0], along),
        (ends[1], last, whole[1], -along),
    ):
        if there:
            number = Label(lines=(text,), centre=(0.0, 0.0), size=size)
            yield [
                beside(end + back * min(far * size, 0.45 * extent), number) for far in END_PLACES
            ]
    # A long name lies beyond the numbers, if it must.
    yield [
        replace(
            label,
            centre=(
                label.centre[0] + float(outward[0]) * far * size,
                label.centre[1] + float(outward[1]) * far * size,
            ),
        )
        for far in NAME_DISTANCES
        for label in (beside(ends[0] + along * share * extent, name) for share in NAME_PLACES)
    ]


def _covered(label: Label, others: Sequence[Label]) -> bool:
    """Whether a label would overlap any other."""
    left, top, right, bottom = label.box
    return any(
        left < box[2] and box[0] < right and top < box[3] and box[1] < bottom
        for box in (other.box for other in others)
    )


def _clipped(ends: Floats, view: Rectangle) -> tuple[Floats, tuple[bool, bool]] | None:
    """The part of a line (2, 2) within a rectangle, and whether each end is in it; None if none is.

    Liang and Barsky's method.
    """
    if not np.isfinite(ends).all():
        return None
    along = ends[1] - ends[0]
    begin, end = 0.0, 1.0
    for axis in range(2):
        for limit, sign in ((view[axis], 1.0), (view[axis + 2], -1.0)):
            inside, change = sign * (ends[0, axis] - limit), sign * along[axis]
            if change == 0:
                if inside < -1:
                    return None
            elif change > 0:
                begin = max(begin, -inside / change)
            else:
                end = min(end, -inside / change)
    if not begin < end or not math.isfinite(begin + end):
        return None
    return np.array([ends[0] + begin * along, ends[0] + end * along]), (
        begin < 1e-6,
        end > 1 - 1e-6,
    )
