"""The layout of a picture: strips for what stands around the volume, and the view that is left.

Nothing that stands in a strip covers the volume, and every text has the room that it needs in a
picture of 256 pixels or more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.camera.grid import Grid
from fhash_codec.rendering.colour.colours import ColourMap
from fhash_codec.rendering.picture.lettering import (
    SMALLEST,
    Label,
    fitted,
    font_size,
    length,
    line_height,
    wrapped,
)
from fhash_codec.rendering.picture.scales import Rectangle, overflow, scales
from fhash_codec.rendering.picture.ticks import ticks
from fhash_codec.rendering.scene.scene import Effects, LegendEntry, Scene
from fhash_formats.series import Coordinate

__all__ = ["Bar", "Layout", "Legend", "lay_out", "quantity_of", "strips"]

BAR_HEIGHT = 0.55
"""Height of a colour bar, as a share of the picture's."""
BAR_WIDTH = 0.36
"""Width of a colour bar with its texts, as a share of the picture's, at most."""
TITLE_GAP = 1.1
"""Distance from the upper end of a colour bar to the middle of its name's last line, in heights
of a line: a tick may stand at the end."""
TITLE_WIDTH = 0.28
"""Width of the lines of a colour bar's name, as a share of the picture's, where ticks need less."""
SMALLEST_VIEW = 0.3
"""Share of the picture's width and height that the volume keeps, at least."""
GOOD_VIEW = 0.6
"""Share of its frame, in area, that the view keeps before the font of the scales gets smaller."""
SIZES = (1.0, 0.85, 0.7, 0.5)
"""Fonts that the scales of axes are tried in, as shares of the picture's font."""
TRIALS = 14
"""Times that the view is moved to make room for the scales."""


@dataclass(frozen=True, kw_only=True)
class Bar:
    """A colour bar with its texts.

    Attributes:
        box: left, top, right and bottom of the colours, in pixels.
        marks: values with their texts, ascending.
        title: lines of the name, above the colours.
        size: height of the font in pixels.
    """

    box: tuple[int, int, int, int]
    marks: tuple[tuple[float, str], ...]
    title: tuple[str, ...]
    size: int


@dataclass(frozen=True, kw_only=True)
class Legend:
    """Colours and their meaning.

    Attributes:
        entries: left and top of the square of each entry in pixels, and the entry.
        size: height of the font and side of a square in pixels.
    """

    entries: tuple[tuple[float, float, LegendEntry], ...]
    size: int


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Places of everything in a picture, in pixels.

    Attributes:
        size: width and height of the picture.
        view: left, top, width and height of the part that shows the volume.
        labels: of the axes.
        time: left, top, right and bottom of the strip of the time label; None without one.
        bar: the colour bar; None without one.
        legend: the legend; None without one.
    """

    size: tuple[int, int]
    view: tuple[int, int, int, int]
    labels: tuple[Label, ...] = ()
    time: Rectangle | None = None
    bar: Bar | None = None
    legend: Legend | None = None


def lay_out(
    scene: Scene,
    grid: Grid,
    coords: Mapping[str, Coordinate],
    colours: ColourMap,
    quantity: str,
) -> tuple[Layout, Rays]:
    """Lay a picture out, and place the rays of the part that shows the volume.

    Args:
        scene: with the size of the picture and the effects.
        grid: of the volume.
        coords: of the axes.
        colours: of the colour bar.
        quantity: name of the colour bar, with units.

    Raises InputError as `Rays.of` does.
    """
    layout = strips(scene.size, scene.effects, colours, quantity)
    rays = Rays.of(scene.camera, grid, layout.view[2:])
    if not scene.effects.axes:
        return layout, rays
    largest = font_size(*scene.size)
    tried: list[_Trial] = []
    for size in sorted({max(SMALLEST, round(largest * share)) for share in SIZES}, reverse=True):
        for breaking in range(3):
            tried.append(_with_scales(layout, scene, grid, coords, size, breaking))
            if tried[-1].complete and tried[-1].share >= GOOD_VIEW:
                return tried[-1].layout, tried[-1].rays
    # Every text first, then the volume.
    best = max(
        tried,
        key=lambda one: (one.fits, len(one.layout.labels), min(one.share, GOOD_VIEW)),
    )
    return best.layout, best.rays


@dataclass(frozen=True, kw_only=True)
class _Trial:
    """A layout with scales.

    Attributes:
        fits: whether no label reaches out of the frame.
        complete: whether it does and every label of the largest view is there.
        share: of the frame's area that the view keeps.
    """

    layout: Layout
    rays: Rays
    fits: bool
    complete: bool
    share: float


def quantity_of(name: str, units: str) -> str:
    """Name of a variable with its units, if it has any."""
    return name if units in ("", "1") else f"{name} [{units}]"


def _with_scales(
    layout: Layout,
    scene: Scene,
    grid: Grid,
    coords: Mapping[str, Coordinate],
    size: int,
    breaking: int,
) -> _Trial:
    """Make room for scales in a font, by a smaller view; breaking: see `scales`."""
    left, top, width, height = layout.view
    frame = (float(left), float(top), float(left + width), float(top + height))
    sides = list(frame)
    least = SMALLEST_VIEW * width, SMALLEST_VIEW * height
    most = 0
    for _ in range(TRIALS):
        view = (
            round(sides[0]),
            round(sides[1]),
            max(round(sides[2]) - round(sides[0]), 1),
            max(round(sides[3]) - round(sides[1]), 1),
        )
        rays = Rays.of(scene.camera, grid, view[2:])
        area = (float(view[0]), float(view[1]), float(view[0] + view[2]), float(view[1] + view[3]))
        labels, wanted = scales(rays, area, frame, coords, size, breaking=breaking)
        most = max(most, wanted)
        beyond = overflow(labels, frame)
        fits = max(beyond) < 0.5
        trial = _Trial(
            layout=replace(layout, view=view, labels=tuple(labels)),
            rays=rays,
            fits=fits,
            complete=fits and len(labels) == most,
            share=view[2] * view[3] / (width * height),
        )
        if fits:
            break
        # A bit more than is missing: the volume gets smaller too, and the labels move with it.
        sides[0] += beyond[0] + 0.5 * (beyond[0] > 0)
        sides[1] += beyond[1] + 0.5 * (beyond[1] > 0)
        sides[2] -= beyond[2] + 0.5 * (beyond[2] > 0)
        sides[3] -= beyond[3] + 0.5 * (beyond[3] > 0)
        if sides[2] - sides[0] < least[0] or sides[3] - sides[1] < least[1]:
            break
    return trial


def strips(size: tuple[int, int], effects: Effects, colours: ColourMap, quantity: str) -> Layout:
    """Lay out the strips of time label, colour bar and legend; the view is the rest.

    In a picture that is too small for them the view is all of it, and they lie over it.
    """
    width, height = size
    letters = font_size(*size)
    top = round(1.9 * letters) if effects.time_label else 0
    legend = _legend(effects.legend, letters, size) if effects.legend else None
    bottom = 0 if legend is None else height - round(legend.entries[0][1] - letters / 2)
    bar = None
    right = 0
    if effects.colour_bar:
        bar = _bar(colours, quantity, letters, size, (top, height - bottom))
        right = width - bar.box[0] + letters // 2
    view = (0, top, width - right, height - top - bottom)
    if view[2] < SMALLEST_VIEW * width or view[3] < SMALLEST_VIEW * height:
        view = (0, 0, width, height)
    return Layout(
        size=size,
        view=view,
        time=(0.0, 0.0, float(width), float(max(top, 1))) if effects.time_label else None,
        bar=bar,
        legend=legend,
    )


def _bar(
    colours: ColourMap,
    quantity: str,
    letters: int,
    picture: tuple[int, int],
    rows: tuple[int, int],
) -> Bar:
    """The colour bar at the right of a picture, in a font that leaves room for the volume.

    rows: first row of the part of the picture that it stands in, and the one after the last.
    """
    width, _ = picture
    low, high = (float(end) for end in colours.positions[[0, -1]])
    room = rows[1] - rows[0]
    for size in range(letters, SMALLEST - 1, -1):
        margin = letters // 2
        thick = max(8, letters)
        tall = max(16, round(BAR_HEIGHT * room))
        marks = _marks(low, high, max(2, round(tall / (4 * size))))
        widest = thick + margin + max(length(text, size) for _, text in marks)
        title = wrapped(quantity, size, max(widest, TITLE_WIDTH * width)) if quantity else ()
        above = (len(title) - 0.5 + TITLE_GAP) * line_height(size)
        tall = max(16, min(tall, round(room - above - 1.5 * size)))
        widest = max([widest, *(length(line, size) for line in title)])
        if widest + 2 * margin <= BAR_WIDTH * width and tall >= 0.35 * room:
            break
    left = max(1, round(width - margin - widest - 2))
    top = rows[0] + max(1, round((room - tall - above - size / 2) / 2 + above))
    return Bar(
        box=(left, top, left + thick, top + tall), marks=tuple(marks), title=title, size=size
    )


def _marks(low: float, high: float, count: int) -> list[tuple[float, str]]:
    """About `count` ticks; more are tried where fewer than two round values lie in the range."""
    for tried in (count, 2 * count, 4 * count):
        marks = ticks(low, high, tried)
        if len(marks) > 1:
            break
    return marks


def _legend(entries: Sequence[LegendEntry], letters: int, picture: tuple[int, int]) -> Legend:
    """The legend at the foot of a picture, in as many rows as it needs."""
    width, height = picture
    margin = letters / 2
    size = fitted([entry.text for entry in entries], letters, width - 4 * margin - 2 * letters)
    rows: list[list[tuple[float, LegendEntry]]] = [[]]
    left = margin
    for entry in entries:
        wide = 1.6 * size + length(entry.text, size)
        if rows[-1] and left + wide > width - margin:
            rows.append([])
            left = margin
        rows[-1].append((left, entry))
        left += wide + 1.5 * size
    pitch = max(1.5 * size, line_height(size) + 2)
    first = height - len(rows) * pitch - size * 0.2
    return Legend(
        entries=tuple(
            (left, first + number * pitch, entry)
            for number, row in enumerate(rows)
            for left, entry in row
        ),
        size=size,
    )
