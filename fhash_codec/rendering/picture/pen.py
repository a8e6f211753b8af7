"""Texts, lines, scales and colour bars as layers of a picture, drawn by pillow.

A layer is a colour, (3,) or (H, W, 3), 0..1, and an opacity (H, W), float32; the colour is not
multiplied by the opacity.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.box import Edge
from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.colour.colours import ColourMap, parse_colour
from fhash_codec.rendering.picture.ticks import ticks
from fhash_formats.series import Coordinate

if TYPE_CHECKING:
    from PIL.Image import Image as PicturesImage
    from PIL.ImageFont import FreeTypeFont, ImageFont

    Font = FreeTypeFont | ImageFont

__all__ = ["Layer", "Pen"]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
Layer = tuple[Floats, Single]
"""Colour and opacity."""

DARK = np.array([28, 30, 36]) / 255
"""Ink on light backgrounds, and the halo of light ink."""
LIGHT = np.array([240, 241, 244]) / 255
"""Ink on dark backgrounds, and the halo of dark ink."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Share of red, green and blue in how light a colour looks."""
LIGHT_BACKGROUND = 0.45
"""Luminance above which a background takes dark ink."""
LINE_OPACITY = 0.7
"""Opacity of the edges."""
PANEL_OPACITY = 0.8
"""Opacity of the panel that a colour bar stands on."""
BAR_HEIGHT = 0.55
"""Height of a colour bar, as a share of the picture's."""


class Pen:
    """Writes and draws with the ink, font and sizes that suit a picture and its background.

    Attributes:
        ink: colour (3,) of lines and letters. halo: colour (3,) around the letters.
        paper: colour (3,) of the panel of a colour bar.
        size: height of the font in pixels.
    """

    def __init__(self, width: int, height: int, background: str) -> None:
        """Choose ink and sizes for a picture of `width` x `height` pixels."""
        from PIL import Image as Pictures
        from PIL import ImageDraw, ImageFont

        paper = None if background == "transparent" else np.array(parse_colour(background))
        light = paper is None or float(paper @ LUMINANCE) > LIGHT_BACKGROUND
        self.ink, self.halo = (DARK, LIGHT) if light else (LIGHT, DARK)
        self.paper = self.halo if paper is None else paper
        self.width, self.height = width, height
        # Larger pictures are looked at from a bit further away, or on finer screens: the square
        # root lies between both.
        self.size = max(9, round(0.62 * math.sqrt(min(width, height))))
        self._font: Font = ImageFont.load_default(self.size)
        self._stroke = max(1, self.size // 9)
        self._letters, self._halos = (Pictures.new("L", (width, height)) for _ in range(2))
        self._draw_letters = ImageDraw.Draw(self._letters)
        self._draw_halos = ImageDraw.Draw(self._halos)

    def text(self, place: tuple[float, float], text: str, anchor: str) -> None:
        """Write a text with a halo; it is moved into the picture where it would reach out of it.

        Args:
            place: pixels from the left and from the top.
            text: one line.
            anchor: the point of the text that lies at `place`, as pillow names it.
        """
        box = self._draw_letters.textbbox(
            place, text, self._font, anchor=anchor, stroke_width=self._stroke
        )
        ends = zip(box[:2], box[2:], (self.width, self.height), strict=True)
        left, top = (
            at + max(1 - low, 0) + min(size - 1 - high, 0)
            for at, (low, high, size) in zip(place, ends, strict=True)
        )
        self._draw_halos.text(
            (left, top),
            text,
            255,
            self._font,
            anchor=anchor,
            stroke_width=self._stroke,
            stroke_fill=255,
        )
        self._draw_letters.text((left, top), text, 255, self._font, anchor=anchor)

    def written(self) -> tuple[Layer, Layer]:
        """The layers of all texts so far, the lower one first."""
        return (self.halo, _opacity(self._halos)), (self.ink, _opacity(self._letters))

    def lines(self, edges: list[Edge]) -> Single:
        """The opacity (H, W) of edges; they are drawn larger and reduced, to be smooth."""
        from PIL import Image as Pictures
        from PIL import ImageDraw

        width, height = self.width, self.height
        if not edges:
            return np.zeros((height, width), dtype=np.float32)
        finer = 4 if max(width, height) <= 1024 else 2 if max(width, height) <= 4096 else 1
        mask = Pictures.new("L", (width * finer, height * finer))
        draw = ImageDraw.Draw(mask)
        far = 32.0 * max(width, height)  # an edge that passes close by the camera ends anywhere
        for edge in edges:
            ends = np.clip(edge.ends, -far, far) * finer
            draw.line([*ends[0], *ends[1]], 255, max(1, round(finer * self.size / 11)))
        return _opacity(mask.reduce(finer)) * np.float32(LINE_OPACITY)

    def scale(self, edge: Edge, coordinate: Coordinate, rays: Rays) -> None:
        """Write the scale of an axis along an edge, outside the box.

        The name stands at the middle, the first and the last coordinate at the ends. An edge that
        is seen from its end is too short for a scale and gets none.
        """
        along = edge.ends[1] - edge.ends[0]
        length = float(np.linalg.norm(along))
        if length < 4 * self.size:
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

    def colour_bar(self, colours: ColourMap, quantity: str) -> Layer:
        """Draw a colour bar at the right; its ticks and its name `quantity` are written as texts.

        Returns the layer of panel, frame, colours and tick marks.
        """
        low, high = (float(end) for end in colours.positions[[0, -1]])
        marks = ticks(low, high, max(2, round(BAR_HEIGHT * self.height / (4 * self.size))))
        thick, margin = max(8, self.size), self.size // 2
        tall = max(16, round(BAR_HEIGHT * self.height))
        lengths = [thick + margin + self._length(text) for _, text in marks]
        widest = max(self._length(quantity), *lengths)
        left = max(1, self.width - self.size - math.ceil(widest))
        top = (self.height - tall) // 2 + margin
        right, bottom = left + thick, top + tall
        canvas = _Canvas(self.width, self.height)
        panel = left - margin, top - 2 * self.size - margin, self.width - margin, bottom + margin
        canvas.fill(panel, self.paper, PANEL_OPACITY)
        canvas.fill((left - 1, top - 1, right + 1, bottom + 1), self.ink)
        share = (np.arange(tall)[::-1, None] + 0.5) / tall
        canvas.fill((left, top, right, bottom), colours(low * (1 - share) + high * share))
        stroke = max(1, self.size // 12)
        for value, text in marks:
            row = top + (tall - 1) * (1 - (value - low) / ((high - low) or 1.0))
            mark = round(row) - stroke // 2
            canvas.fill((right, mark, right + self.size // 4, mark + stroke), self.ink)
            self.text((right + margin, row), text, "lm")
        self.text((left, top - self.size), quantity, "ls")
        return canvas.colours, canvas.opacity

    def _length(self, text: str) -> float:
        """Width of a text in pixels."""
        return self._draw_letters.textlength(text, self._font)


class _Canvas:
    """A layer that rectangles are filled in."""

    def __init__(self, width: int, height: int) -> None:
        self.colours: Floats = np.zeros((height, width, 3))
        self.opacity: Single = np.zeros((height, width), dtype=np.float32)

    def fill(
        self, rectangle: tuple[int, int, int, int], colour: Floats, opacity: float = 1.0
    ) -> None:
        """Fill a rectangle, as far as it lies on the canvas.

        Args:
            rectangle: left, top, right, bottom in pixels; the last two lie outside.
            colour: (3,), or a colour for each row of the rectangle (rows, 1, 3).
            opacity: 0..1.
        """
        left, top, right, bottom = rectangle
        height, width = self.opacity.shape
        first, last = max(top, 0), max(min(bottom, height), 0)
        area = slice(first, last), slice(max(left, 0), max(min(right, width), 0))
        self.colours[area] = colour[first - top : last - top] if colour.ndim == 3 else colour
        self.opacity[area] = opacity


def _opacity(mask: PicturesImage) -> Single:
    """The opacity 0..1 of a mask of bytes."""
    return np.asarray(mask, dtype=np.float32) / np.float32(255)
