"""A picture of original values, decoded values and their error, with colour bars, by pillow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from fhash_codec.rendering.colour.colour_maps import COLOUR_MAPS

Slice = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

VIRIDIS = COLOUR_MAPS["viridis"]
"""Colours of values."""
BALANCE = COLOUR_MAPS["balance"]
"""Colours of errors: blue, near white for no error, red."""
OUTSIDE = (208, 209, 212)
"""Grey of vertices outside the coreset (NaN)."""

_PAPER = (255, 255, 255)
_INK = (28, 30, 36)
_FAINT = (112, 116, 126)
# Lengths in pixels: margins, gap between slices, and the width aimed at.
_LEFT = 112
_RIGHT = 132
_TOP = 106
_FOOT = 52
_GAP = 10
_WIDTH = 1240


@dataclass(frozen=True, kw_only=True)
class Pair:
    """One step of the comparison.

    Attributes:
        label: text such as "t = 0.25 s".
        original: values (y, x).
        decoded: values (y, x), NaN outside the coreset.
    """

    label: str
    original: Slice
    decoded: Slice


def colours(values: npt.ArrayLike, low: float, high: float, points: Sequence[str]) -> Pixels:
    """Colour values of any shape; result (..., 3) uint8.

    Colours run from `low` to `high` along the hexadecimal colours `points`; NaN becomes OUTSIDE.
    """
    table = np.array(
        [[int(point[i : i + 2], 16) for i in (0, 2, 4)] for point in points], dtype=np.float64
    )
    array = np.asarray(values, dtype=np.float64)
    where = np.clip((np.nan_to_num(array) - low) / ((high - low) or 1.0), 0.0, 1.0) * (
        len(table) - 1
    )
    mixed = np.stack(
        [np.interp(where, np.arange(len(table)), channel) for channel in table.T], axis=-1
    )
    mixed[np.isnan(array)] = OUTSIDE
    return np.asarray(np.rint(mixed), dtype=np.uint8)


def compare(
    pairs: Sequence[Pair], *, title: str, subtitle: str, quantity: str, footer: str = ""
) -> Image.Image:
    """Draw three rows (original, decoded, error = decoded - original) with a column for each pair.

    The picture is about 1240 pixels wide. x points to the right and y upwards. A vertex is a square
    of whole pixels; nothing is smoothed. The first two rows share the colour bar of `quantity`; the
    error has its own, symmetric about 0.
    """
    rows, columns = pairs[0].original.shape
    errors = [pair.decoded - pair.original for pair in pairs]
    low = min(float(pair.original.min()) for pair in pairs)
    high = max(float(pair.original.max()) for pair in pairs)
    worst = max(
        (float(np.nanmax(np.abs(error))) for error in errors if not np.isnan(error).all()),
        default=0.0,
    )
    scale = max(1, (_WIDTH - _LEFT - _RIGHT - _GAP * (len(pairs) - 1)) // (len(pairs) * columns))
    wide, tall = columns * scale, rows * scale
    inner = len(pairs) * (wide + _GAP) - _GAP
    height = _TOP + 3 * (tall + _GAP) - _GAP + _FOOT
    image = Image.new("RGB", (_LEFT + inner + _RIGHT, height), _PAPER)
    draw = ImageDraw.Draw(image)
    draw.text((_LEFT, 20), title, _INK, _font(26))
    draw.text((_LEFT, 54), subtitle, _FAINT, _font(16))
    for row, name in enumerate(("original", "decoded", "error")):
        middle = _TOP + row * (tall + _GAP) + tall // 2
        draw.text((_LEFT - 16, middle), name, _INK, _font(18), anchor="rm")
    for column, (pair, error) in enumerate(zip(pairs, errors, strict=True)):
        left = _LEFT + column * (wide + _GAP)
        draw.text((left + wide // 2, _TOP - 8), pair.label, _INK, _font(16), anchor="ms")
        tiles = (
            colours(pair.original, low, high, VIRIDIS),
            colours(pair.decoded, low, high, VIRIDIS),
            colours(error, -worst, worst, BALANCE),
        )
        for row, tile in enumerate(tiles):
            enlarged = Image.fromarray(tile[::-1]).resize((wide, tall), Image.Resampling.NEAREST)
            image.paste(enlarged, (left, _TOP + row * (tall + _GAP)))
    bars = _LEFT + inner + 18
    _bar(image, (bars, _TOP, 2 * tall + _GAP), VIRIDIS, (low, (low + high) / 2, high), quantity)
    _bar(image, (bars, _TOP + 2 * (tall + _GAP), tall), BALANCE, (-worst, 0.0, worst), "")
    if footer:
        below = height - _FOOT + 26
        draw.rectangle((_LEFT, below - 7, _LEFT + 14, below + 7), OUTSIDE)
        draw.text((_LEFT + 22, below), footer, _FAINT, _font(15), anchor="lm")
    return image


def _bar(
    image: Image.Image,
    place: tuple[int, int, int],
    points: Sequence[str],
    ticks: Sequence[float],
    name: str,
) -> None:
    """Draw a vertical colour bar at (left, top, height), with labels from the bottom up and its
    name."""
    left, top, height = place
    ramp = colours(np.linspace(1.0, 0.0, height)[:, None].repeat(18, axis=1), 0.0, 1.0, points)
    image.paste(Image.fromarray(ramp), (left, top))
    draw = ImageDraw.Draw(image)
    draw.text((left, top - 8), name, _INK, _font(15), anchor="ls")
    for index, tick in enumerate(ticks):
        share = index / (len(ticks) - 1)
        inset = 8 - round(16 * share)  # keeps the outer labels within the bar's length
        draw.text(
            (left + 26, top + height - round(height * share) - inset),
            f"{tick:.3g}",
            _FAINT,
            _font(15),
            anchor="lm",
        )


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
