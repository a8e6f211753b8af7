"""The layout of a picture: strips for axes, colour bar and legend, and the view that is left."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.colours import ColourMap
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.scenes import Effects, LegendEntry, Scene
from fhash_codec.rendering.view import Edge, outer_edges
from fhash_formats.series import Coordinate
from fhash_formats.support.values import Double

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont, ImageFont

SMALLEST = 7
"""Height in pixels of the smallest font; smaller letters cannot be read."""
READABLE = 9
"""Height in pixels of the smallest font where there is room."""


@dataclass(frozen=True, kw_only=True)
class Label:
    """A text of one line or several, centred.

    Attributes:
        lines: of the text.
        centre: pixels from the left and from the top.
        size: height of the font in pixels.
        upright: whether the text is turned to be read from below upwards.
    """

    lines: tuple[str, ...]
    centre: tuple[float, float]
    size: int
    upright: bool = False

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height in pixels, the halo included."""
        stroke = 2 * max(1, self.size // 9)
        wide = max(length(line, self.size) for line in self.lines) + stroke
        tall = len(self.lines) * line_height(self.size) + stroke
        return (tall, wide) if self.upright else (wide, tall)

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom in pixels."""
        (wide, tall), (x, y) = self.extent, self.centre
        return x - wide / 2, y - tall / 2, x + wide / 2, y + tall / 2


def font_size(width: int, height: int) -> int:
    """Height in pixels of the font that suits a picture.

    Larger pictures are looked at from a bit further away, or on finer screens: the square root lies
    between both.
    """
    return max(READABLE, round(0.62 * math.sqrt(min(width, height))))


@cache
def font(size: int) -> FreeTypeFont | ImageFont:
    """The font of a height in pixels."""
    from PIL import ImageFont

    return ImageFont.load_default(size)


def drawable(text: str) -> str:
    """A text in letters that the font has: no accents, Greek ones by name, ? for what is left."""

    def one(letter: str) -> str:
        if letter.isascii() or letter == "\N{DEGREE SIGN}":
            return letter
        name = unicodedata.name(letter, "")
        if letter == "\N{GREEK SMALL LETTER MU}":
            return "u"
        return name.split()[-1].lower() if name.startswith("GREEK") else "?"

    parts = unicodedata.normalize("NFKD", text).replace("\N{MINUS SIGN}", "-")
    return "".join(one(each) for each in parts if not unicodedata.combining(each))


@cache
def length(text: str, size: int) -> float:
    """Length of a line in pixels."""
    left, _, right, _ = font(size).getbbox(text, anchor="ls")
    return float(max(font(size).getlength(text), right - min(left, 0)))


@cache
def line_height(size: int) -> float:
    """Distance of two lines in pixels; no letter of a line is higher."""
    _, top, _, bottom = font(size).getbbox("Ágjy|[_", anchor="ls")
    return float(bottom - top + 1)


def wrapped(text: str, size: int, limit: float) -> tuple[str, ...]:
    """Break a text into lines no longer than a limit in pixels.

    Lines break at blanks; a word that is too long after underscores, hyphens and slashes; a part of
    a word that is too long anywhere.
    """
    lines = [""]
    for word in text.split():
        if length(f"{lines[-1]} {word}".strip(), size) <= limit:
            lines[-1] = f"{lines[-1]} {word}".strip()
        else:
            parts = _broken(word, size, limit)
            lines = [*lines, *parts] if lines[-1] else [*lines[:-1], *parts]
    return tuple(lines)


def _broken(word: str, size: int, limit: float) -> list[str]:
    """Break a word into lines."""
    if length(word, size) <= limit:
        return [word]
    lines = [""]
    for part in re.findall(r"[^_\-/]*[_\-/]+|[^_\-/]+", word):
        if length(lines[-1] + part, size) <= limit:
            lines[-1] += part
            continue
        lines.append("")
        for letter in part:
            if lines[-1] and length(lines[-1] + letter, size) > limit:
                lines.append("")
            lines[-1] += letter
    return [line for line in lines if line]


def fitted(texts: Sequence[str], largest: int, limit: float) -> int:
    """The largest font, from SMALLEST on, in which every text is no longer than a limit."""
    for size in range(largest, SMALLEST, -1):
        if all(length(text, size) <= limit for text in texts):
            return size
    return min(SMALLEST, largest)


STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
"""Distances between ticks, as multiples of a power of ten."""


def ticks(low: float, high: float, count: int) -> list[tuple[float, str]]:
    """Choose round values from low to high, about `count` of them and at least one.

    Returns (value, text) in ascending order. An empty or infinite range has one tick, at `low`.
    """
    extent = high - low
    if not extent > 0 or not math.isfinite(extent):
        return [(low, f"{low:.6g}")]
    step = _round_step(extent / max(count, 1))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    values = [number * step for number in range(first, last + 1)]
    if not values:
        return [(low, f"{low:.6g}")]
    return [(value, text) for value, text in zip(values, _texts(values, step), strict=True)]


def _round_step(rough: float) -> float:
    """The smallest round distance that is not below a rough one, but for rounding."""
    power = 10.0 ** math.floor(math.log10(rough))
    return power * next(
        multiple
        for multiple in STEPS
        if multiple * power >= rough * (1 - 1e-9) or multiple == STEPS[-1]
    )


def _texts(values: list[float], step: float) -> list[str]:
    """Texts with as many decimals as the distance between the values needs."""
    largest = max(abs(value) for value in values) or step
    digits = math.floor(math.log10(step) + 1e-9)
    # A step of 2.5 needs one digit more than its power of ten.
    finer = 1 if abs(step / 10.0**digits - 2.5) < 1e-6 else 0
    if largest >= 1e6 or step < 1e-4:
        places = max(0, math.floor(math.log10(largest)) - digits + finer)
        return [f"{value:.{places}e}" if value else "0" for value in values]
    # Adding 0 turns -0.0 into 0.0.
    return [f"{value + 0.0:.{max(0, finer - digits)}f}" for value in values]


Rectangle = tuple[float, float, float, float]
"""Left, top, right and bottom in pixels."""

NAME_PLACES = (0.5, 0.42, 0.58, 0.34, 0.66, 0.26, 0.74, 0.18, 0.82)
"""Places of a name along its edge, as shares of it, in the order in which they are tried."""
NAME_DISTANCES = (0.0, 1.5, 3.5, 6.0, 9.0)
"""Distances of a name from its usual place beyond the numbers, in heights of the font."""
MARK = 0.35
"""Length of a tick mark in heights of the font."""
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
) -> tuple[list[Label], list[Double], int]:
    """Place the scales of the axes: labels without overlap, tick marks (2, 2), names left out.

    Args:
        rays: of the part of the picture that shows the volume.
        view: that part.
        frame: part that the labels should lie in; see `overflow` for what does not.
        coords: of the axes.
        size: height of the font in pixels.
        breaking: 0 for names in one line, 1 with units in a line of their own, 2 in lines no longer
            than WRAPPED of the frame.
    """
    placed: list[Label] = []
    marks: list[Double] = []
    missing = 0
    names: list[Iterator[Label]] = []
    for edge in outer_edges(rays):
        coordinate = coords["xyz"[edge.axis]]
        lines = _name(coordinate, size, breaking, WRAPPED * (frame[2] - frame[0]))
        found = _of_edge(edge, rays, view, coordinate, lines, size)
        if found is not None:
            marks += found.marks
            placed += [label for label in found.numbers if not _covered(label, placed)]
            names.append(found.names)
    for candidates in names:
        free = [label for label in candidates if not _covered(label, placed)]
        if free:
            placed.append(min(free, key=lambda label: round(sum(overflow([label], frame)), 3)))
        else:
            missing += 1
    return placed, marks, missing


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
    units = drawable(str(coordinate.attributes.get("units", "")))
    name = drawable(coordinate.name)
    if units in ("", "1"):
        lines: tuple[str, ...] = (name,)
    else:
        lines = (name, f"[{units}]")
    if breaking == 2:
        return wrapped(" ".join(lines), size, limit)
    return lines if breaking else (" ".join(lines),)


@dataclass(frozen=True, kw_only=True)
class _Scale:
    """The scale of an edge.

    Attributes:
        marks: pixels (2, 2) of the ends of each tick mark.
        numbers: labels of the ticks.
        names: places that the name of the axis may have, the best first.
    """

    marks: list[Double]
    numbers: list[Label]
    names: Iterator[Label]


def _of_edge(
    edge: Edge,
    rays: Rays,
    view: Rectangle,
    coordinate: Coordinate,
    lines: tuple[str, ...],
    size: int,
) -> _Scale | None:
    """The scale of an edge; None where it is too short for one, or out of view."""
    offset = np.array(view[:2])
    ends = _clipped(edge.ends + offset, view)
    if ends is None:
        return None
    along = ends[1] - ends[0]
    extent = float(np.linalg.norm(along))
    if extent < SHORTEST * size:
        return None
    along = along / extent
    centre = rays.project(rays.grid.bounds.mean(axis=1)[None])[0][0] + offset
    outward = np.array([-along[1], along[0]])
    outward = outward if float(outward @ (ends.mean(axis=0) - centre)) >= 0 else -outward
    upright = (
        abs(float(along[1])) > STEEP and max(length(line, size) for line in lines) > LONG * size
    )

    def beside(place: Double, label: Label, far: float = 0.5) -> Label:
        """The label outside the edge, `far` heights of the font from a place of it."""
        wide, tall = label.extent
        reach = abs(float(outward[0])) * wide / 2 + abs(float(outward[1])) * tall / 2
        x, y = place + outward * (reach + far * size)
        return replace(label, centre=(float(x), float(y)))

    marks, numbers = [], []
    for place, text in _ticks_along(edge, rays, coordinate, extent, along, size):
        at = place + offset
        if view[0] - 1 <= at[0] <= view[2] + 1 and view[1] - 1 <= at[1] <= view[3] + 1:
            marks.append(np.array([at, at + outward * MARK * size]))
            numbers.append(beside(at, Label(lines=(text,), centre=(0.0, 0.0), size=size)))
    name = Label(lines=lines, centre=(0.0, 0.0), size=size, upright=upright)
    reach = max((abs(float(outward @ np.array(label.extent))) for label in numbers), default=0.0)
    names = (
        beside(ends[0] + along * share * extent, name, 0.7 + reach / size + far)
        for far in NAME_DISTANCES
        for share in NAME_PLACES
    )
    return _Scale(marks=marks, numbers=numbers, names=names)


def _ticks_along(
    edge: Edge, rays: Rays, coordinate: Coordinate, extent: float, along: Double, size: int
) -> list[tuple[Double, str]]:
    """Pixels (2,) and texts of the ticks of an edge: as many as it has room for."""
    grid, axis = rays.grid, edge.axis
    first, last = (float(value) for value in coordinate.values[[0, -1]])
    low, high = grid.bounds[axis]
    found: list[tuple[Double, str]] = []
    for count in range(max(2, min(8, int(extent / (4 * size)))), 0, -1):
        marked = ticks(min(first, last), max(first, last), count)
        values = np.array([value for value, _ in marked])
        share = np.full(len(values), 0.5)
        if grid.counts[axis] > 1 and high > low:
            at = (values * grid.scale[axis] - grid.origin[axis]) / grid.spacing[axis]
            share = (at - low) / (high - low)
        places = edge.places[0] + share[:, None] * (edge.places[1] - edge.places[0])
        pixels, _ = rays.project(places)
        found = [(pixel, text) for pixel, (_, text) in zip(pixels, marked, strict=True)]
        widest = max(length(text, size) for _, text in found) + 0.6 * size
        needed = min(
            widest / max(abs(float(along[0])), 1e-6),
            1.3 * size / max(abs(float(along[1])), 1e-6),
        )
        apart = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
        if len(marked) < 3 or apart.min() > needed:
            break
    return found


def _covered(label: Label, others: Sequence[Label]) -> bool:
    """Whether a label would overlap any other."""
    left, top, right, bottom = label.box
    return any(
        left < box[2] and box[0] < right and top < box[3] and box[1] < bottom
        for box in (other.box for other in others)
    )


def _clipped(ends: Double, view: Rectangle) -> Double | None:
    """The part of a line (2, 2) within a rectangle; None if none is.

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
    return np.array([ends[0] + begin * along, ends[0] + end * along])


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
        beyond: whether there are values below and above the colours' ends.
    """

    box: tuple[int, int, int, int]
    marks: tuple[tuple[float, str], ...]
    title: tuple[str, ...]
    size: int
    beyond: tuple[bool, bool] = (False, False)


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
        marks: of their ticks, pixels (2, 2) of the ends of each.
        time: left, top, right and bottom of the strip of the time label; None without one.
        bar: the colour bar; None without one.
        legend: the legend; None without one.
    """

    size: tuple[int, int]
    view: tuple[int, int, int, int]
    labels: tuple[Label, ...] = ()
    marks: tuple[Double, ...] = ()
    time: Rectangle | None = None
    bar: Bar | None = None
    legend: Legend | None = None


def lay_out(
    scene: Scene,
    grid: Grid,
    coords: Mapping[str, Coordinate],
    colours: ColourMap,
    quantity: str,
    value_range: tuple[float, float] | None = None,
) -> tuple[Layout, Rays]:
    """Lay a picture out, and place the rays of the part that shows the volume.

    Args:
        scene: with the size of the picture and the effects.
        grid: of the volume.
        coords: of the axes.
        colours: of the colour bar.
        quantity: name of the colour bar, with units.
        value_range: of the series, whose ends the colour bar marks where it does not reach them.

    Raises InputError as `Rays.of` does.
    """
    layout = strips(scene.size, scene.effects, colours, quantity, value_range)
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
    best = max(tried, key=lambda one: (one.fits, one.complete, min(one.share, GOOD_VIEW)))
    return best.layout, best.rays


@dataclass(frozen=True, kw_only=True)
class _Trial:
    """A layout with scales.

    Attributes:
        fits: whether no label reaches out of the frame.
        complete: whether it does and the name of every axis is there.
        share: of the frame's area that the view keeps.
    """

    layout: Layout
    rays: Rays
    fits: bool
    complete: bool
    share: float


def quantity_of(name: str, units: str) -> str:
    """Name of a variable with its units, if it has any, as it can be drawn."""
    return drawable(name if units in ("", "1") else f"{name} [{units}]")


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
    for _ in range(TRIALS):
        view = (
            round(sides[0]),
            round(sides[1]),
            max(round(sides[2]) - round(sides[0]), 1),
            max(round(sides[3]) - round(sides[1]), 1),
        )
        rays = Rays.of(scene.camera, grid, view[2:])
        area = (float(view[0]), float(view[1]), float(view[0] + view[2]), float(view[1] + view[3]))
        labels, marks, missing = scales(rays, area, frame, coords, size, breaking=breaking)
        beyond = overflow(labels, frame)
        fits = max(beyond) < 0.5
        trial = _Trial(
            layout=replace(layout, view=view, labels=tuple(labels), marks=tuple(marks)),
            rays=rays,
            fits=fits,
            complete=fits and not missing,
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


def strips(
    size: tuple[int, int],
    effects: Effects,
    colours: ColourMap,
    quantity: str,
    value_range: tuple[float, float] | None = None,
) -> Layout:
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
        low, high = value_range or colours.positions[[0, -1]]
        beyond = bool(low < colours.positions[0]), bool(high > colours.positions[-1])
        bar = replace(bar, beyond=beyond)
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
    colours: ColourMap, quantity: str, letters: int, picture: tuple[int, int], rows: tuple[int, int]
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
