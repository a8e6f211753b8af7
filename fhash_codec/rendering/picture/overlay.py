"""What a scene asks for around the volume: box, axes, colour bar, time label; drawn by pillow, composited in floats."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.box import Edge, edges, outer_edges
from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.colour.colours import ColourMap, parse_colour
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.scene.scene import Effects
from fhash_formats.series import Coordinate

if TYPE_CHECKING:
    from PIL.Image import Image as PicturesImage
    from PIL.ImageFont import FreeTypeFont, ImageFont

    Font = FreeTypeFont | ImageFont

__all__ = ["overlay", "ticks", "time_text"]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

DARK, LIGHT = np.array([28, 30, 36]) / 255, np.array([240, 241, 244]) / 255
LINE = 0.7
"""Opacity of the edges."""
PANEL = 0.8
"""Opacity of what a colour bar stands on."""
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)


def overlay(
    image: Image,
    effects: Effects,
    rays: Rays,
    *,
    colours: ColourMap,
    quantity: str,
    coords: Mapping[str, Coordinate],
    label: str = "",
) -> Image:
    """The picture with what `effects` names of box, axes, colour bar and time label; itself where it names none.

    quantity: what the colour bar is of, with units. coords: of the axes. label: the text for the time label.
    """
    if not (effects.box or effects.axes or effects.colour_bar or effects.time_label):
        return image
    height, width = image.rgba.shape[:2]
    pen, axes = (_Pen(width, height, image.background) for _ in range(2))
    under = over = np.zeros((height, width), dtype=np.float32)
    outer = outer_edges(rays) if effects.axes else []
    if effects.box or effects.axes:
        drawn = edges(rays) if effects.box else outer
        # The volume lies inside the box: an edge of two faces that look away is behind all of it, any other before all of it.
        under = pen.lines([edge for edge in drawn if edge.fronts == 0])
        over = pen.lines([edge for edge in drawn if edge.fronts > 0])
    canvas = np.zeros((height, width, 3)), np.zeros((height, width), dtype=np.float32)
    if effects.axes:
        for edge in outer:
            axes.scale(edge, coords["xyz"[edge.axis]], rays)
    if effects.colour_bar:
        pen.colour_bar(*canvas, colours, quantity)
    if effects.time_label and label:
        pen.text((pen.size, pen.size), label, "la")
    result = image.rgba.copy()
    where = under > 0
    result[where] += (1 - result[where][:, 3:]) * _flat(pen.ink, under[where])
    for layer in ((pen.ink, over), *axes.written(), canvas, *pen.written()):
        _paint(result, *layer)
    return dataclasses.replace(image, rgba=result)


def _share(mask: PicturesImage) -> Single:
    return np.asarray(mask, dtype=np.float32) / np.float32(255)


def _flat(colour: Floats, opacity: Single) -> Single:
    return np.concatenate([opacity[..., None] * colour, opacity[..., None]], axis=-1).astype(
        np.float32
    )


def _paint(picture: Single, colour: Floats, opacity: Single) -> None:
    """Put a layer before a picture (H, W, 4), in place; `colour` (3,) or (H, W, 3), not multiplied by its opacity (H, W)."""
    where = opacity > 0
    front = _flat(colour if colour.ndim == 1 else colour[where], opacity[where])
    picture[where] = front + (1 - front[:, 3:]) * picture[where]


class _Pen:
    """Ink, font and sizes that suit a picture and its background; `letters` and `halos` are where it has written, masks (H, W)."""

    def __init__(self, width: int, height: int, background: str) -> None:
        from PIL import Image as Pictures
        from PIL import ImageDraw, ImageFont

        paper = None if background == "transparent" else np.array(parse_colour(background))
        light = paper is None or float(paper @ [0.2126, 0.7152, 0.0722]) > 0.45
        self.ink, self.halo = (DARK, LIGHT) if light else (LIGHT, DARK)
        self.paper = self.halo if paper is None else paper
        self.width, self.height = width, height
        # Larger pictures are looked at from a bit further away, or on finer screens: the root lies between both.
        self.size = max(9, round(0.62 * math.sqrt(min(width, height))))
        self.font: Font = ImageFont.load_default(self.size)
        self.stroke = max(1, self.size // 9)
        self.letters, self.halos = (Pictures.new("L", (width, height)) for _ in range(2))
        self._letter, self._halo = ImageDraw.Draw(self.letters), ImageDraw.Draw(self.halos)

    def text(self, place: tuple[float, float], text: str, anchor: str) -> None:
        """A text with a halo, moved into the picture where it would reach out of it."""
        box = self._letter.textbbox(place, text, self.font, anchor=anchor, stroke_width=self.stroke)
        ends = zip(box[:2], box[2:], (self.width, self.height), strict=True)
        left, top = (
            at + max(1 - low, 0) + min(size - 1 - high, 0)
            for at, (low, high, size) in zip(place, ends, strict=True)
        )
        self._halo.text(
            (left, top),
            text,
            255,
            self.font,
            anchor=anchor,
            stroke_width=self.stroke,
            stroke_fill=255,
        )
        self._letter.text((left, top), text, 255, self.font, anchor=anchor)

    def written(self) -> tuple[tuple[Floats, Single], ...]:
        """The layers of what it has written, the lowest first: colour (3,) and opacity (H, W)."""
        return (self.halo, _share(self.halos)), (self.ink, _share(self.letters))

    def lines(self, drawn: list[Edge]) -> Single:
        """Opacity (H, W) of edges, smooth by drawing them larger."""
        from PIL import Image as Pictures
        from PIL import ImageDraw

        width, height = self.width, self.height
        if not drawn:
            return np.zeros((height, width), dtype=np.float32)
        finer = 4 if max(width, height) <= 1024 else 2 if max(width, height) <= 4096 else 1
        mask = Pictures.new("L", (width * finer, height * finer))
        draw = ImageDraw.Draw(mask)
        far = 32.0 * max(width, height)  # an edge that passes close by the camera ends anywhere
        for edge in drawn:
            ends = np.clip(edge.ends, -far, far) * finer
            draw.line([*ends[0], *ends[1]], 255, max(1, round(finer * self.size / 11)))
        return _share(mask.reduce(finer)) * np.float32(LINE)

    def scale(self, edge: Edge, coordinate: Coordinate, rays: Rays) -> None:
        """The name of an axis at the middle of an edge and its first and last coordinate at the ends, all outside the box."""
        along = edge.ends[1] - edge.ends[0]
        length = float(np.linalg.norm(along))
        if length < 4 * self.size:  # seen from its end
            return
        middle = edge.ends.mean(axis=0)
        centre = rays.project(rays.grid.bounds.mean(axis=1)[None])[0][0]
        outward = np.array([-along[1], along[0]]) / length
        outward = outward if float(outward @ (middle - centre)) >= 0 else -outward
        anchor = ("l" if outward[0] > 0.4 else "r" if outward[0] < -0.4 else "m") + "m"
        inward = along / length * self.size
        units = coordinate.attributes.get("units", "")
        name = f"{coordinate.name} [{units}]" if units else coordinate.name
        first, last = (f"{value:.6g}" for value in coordinate.values[[0, -1]])
        gap = outward * self.size * (1.0 if anchor[0] == "m" else 0.6)
        for place, text in (
            (edge.ends[0] + inward, first),
            (middle + gap * 0.6, name),
            (edge.ends[1] - inward, last),
        ):
            left, top = place + gap
            self.text((float(left), float(top)), text, anchor)

    def colour_bar(self, inks: Floats, cover: Single, colours: ColourMap, quantity: str) -> None:
        """A bar at the right with ticks and name; shapes go onto a layer of colours (H, W, 3) and opacity (H, W)."""
        low, high = (float(end) for end in colours.positions[[0, -1]])
        marks = ticks(low, high, max(2, round(0.55 * self.height / (4 * self.size))))
        thick, tall, margin = max(8, self.size), max(16, round(0.55 * self.height)), self.size // 2
        lengths = [thick + margin + self._letter.textlength(text, self.font) for _, text in marks]
        left = max(
            1,
            self.width
            - self.size
            - math.ceil(max(self._letter.textlength(quantity, self.font), *lengths)),
        )
        top = (self.height - tall) // 2 + margin
        _fill(
            inks,
            cover,
            left - margin,
            top - 2 * self.size - margin,
            self.width - margin,
            top + tall + margin,
            self.paper,
            PANEL,
        )
        _fill(inks, cover, left - 1, top - 1, left + thick + 1, top + tall + 1, self.ink)
        share = (np.arange(tall)[::-1, None] + 0.5) / tall
        _fill(
            inks,
            cover,
            left,
            top,
            left + thick,
            top + tall,
            colours(low * (1 - share) + high * share),
        )
        for value, text in marks:
            row = top + (tall - 1) * (1 - (value - low) / ((high - low) or 1.0))
            tick = round(row) - max(1, self.size // 12) // 2
            _fill(
                inks,
                cover,
                left + thick,
                tick,
                left + thick + self.size // 4,
                tick + max(1, self.size // 12),
                self.ink,
            )
            self.text((left + thick + margin, row), text, "lm")
        self.text((left, top - self.size), quantity, "ls")


def _fill(
    inks: Floats,
    cover: Single,
    left: int,
    top: int,
    right: int,
    bottom: int,
    colour: Floats,
    opacity: float = 1.0,
) -> None:
    """Fill a rectangle of a layer; `colour` (..., 3) is one, or one for each row (rows, 1, 3)."""
    height, width = cover.shape
    first, last = max(top, 0), max(min(bottom, height), 0)
    area = slice(first, last), slice(max(left, 0), max(min(right, width), 0))
    inks[area] = colour[first - top : last - top] if colour.ndim == 3 else colour
    cover[area] = opacity


def ticks(low: float, high: float, count: int) -> list[tuple[float, str]]:
    """Round values from low to high, about `count` and at least one, with texts that tell them apart."""
    extent = high - low
    if not extent > 0 or not math.isfinite(extent):
        return [(low, f"{low:.6g}")]
    rough = extent / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * next(
        part for part in STEPS if part * power >= rough * (1 - 1e-9) or part == STEPS[-1]
    )
    values = [
        number * step
        for number in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    ]
    if not values:
        return [(low, f"{low:.6g}")]
    largest = max(abs(value) for value in values) or step
    digits = math.floor(math.log10(step) + 1e-9)
    finer = 1 if abs(step / 10.0**digits - 2.5) < 1e-6 else 0
    if largest >= 1e6 or step < 1e-4:
        places = max(0, math.floor(math.log10(largest)) - digits + finer)
        return [(value, f"{value:.{places}e}" if value else "0") for value in values]
    return [(value, f"{value + 0.0:.{max(0, finer - digits)}f}") for value in values]


def time_text(step: float, time: float, units: str) -> str:
    """The time label: step and physical time."""
    return f"step {step:g}   t = {time:.6g}{f' {units}' if units else ''}"
