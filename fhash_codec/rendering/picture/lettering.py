"""Sizes of texts: fonts, lengths, and lines that fit."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont, ImageFont

    Font = FreeTypeFont | ImageFont

__all__ = ["SMALLEST", "Label", "fitted", "font", "font_size", "length", "line_height", "wrapped"]

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
def font(size: int) -> Font:
    """The font of a height in pixels."""
    from PIL import ImageFont

    return ImageFont.load_default(size)


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
