"""Colours by name or '#rrggbb', and colour maps.

Maps are interpolated in RGB, HSV, Lab or on Moreland's diverging scale. Colours are floats 0..1 as
a screen takes them (sRGB, not linear light): ParaView and VTK interpolate and composite these too.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import ImageColor

from fhash_codec.rendering.colour.colour_maps import COLOUR_MAPS
from fhash_codec.rendering.colour.colour_spaces import (
    hsv_to_rgb,
    lab_to_rgb,
    mix_diverging,
    rgb_to_hsv,
    rgb_to_lab,
)
from fhash_formats.errors import InputError

__all__ = ["SPACES", "ColourMap", "colour_code", "is_map", "named_map", "parse_colour"]

Floats = npt.NDArray[np.float64]

SPACES = ("RGB", "HSV", "Lab", "Diverging", "Step")
"""Spaces in which colours are interpolated; `Step` keeps the colour of the point before."""
NAN = (0.816, 0.820, 0.831)
"""Default colour of NaN, a grey."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ColourMap:
    """Colours along values.

    Attributes:
        positions: values float64 (n,), ascending; two are equal at a jump.
        points: colours float64 (n, 3), 0..1.
        space: one of SPACES.
        nan: colour of NaN.
    """

    positions: Floats
    points: Floats
    space: str = "RGB"
    nan: tuple[float, float, float] = NAN

    def __call__(self, values: npt.ArrayLike) -> Floats:
        """Look up values of any shape; colours (..., 3), 0..1.

        Values beyond the ends have the colours of the ends.
        """
        array = np.asarray(values, dtype=np.float64)
        clipped = np.clip(
            np.where(np.isnan(array), self.positions[0], array),
            self.positions[0],
            self.positions[-1],
        )
        if len(self.positions) == 1:
            mixed = np.broadcast_to(self.points[0], (*array.shape, 3)).copy()
        else:
            after = np.searchsorted(self.positions, clipped, side="right")
            before = np.clip(after - 1, 0, len(self.positions) - 2)
            # Halved, so that the width of values of the whole range of float64 does not overflow.
            width = self.positions[before + 1] / 2 - self.positions[before] / 2
            share = (clipped / 2 - self.positions[before] / 2) / np.where(width > 0, width, 1.0)
            mixed = self._mix(before, np.clip(share, 0.0, 1.0)[..., None])
        mixed[np.isnan(array)] = self.nan
        return mixed

    def _mix(self, before: npt.NDArray[np.intp], share: Floats) -> Floats:
        """Mix each point `before` (...) with the next one at `share` (..., 1)."""
        if self.space == "Step":
            return np.where(share < 1, self.points[before], self.points[before + 1])
        if self.space == "Diverging":
            return mix_diverging(self.points[before], self.points[before + 1], share)
        if self.space == "HSV":
            hsv = rgb_to_hsv(self.points)
            first, second = hsv[before], hsv[before + 1]
            # The shorter arc of the circle of hues, as in vtkColorTransferFunction.
            turn = np.where(
                first[..., 0] - second[..., 0] > 0.5,
                1.0,
                np.where(second[..., 0] - first[..., 0] > 0.5, -1.0, 0.0),
            )
            second[..., 0] += turn
            mixed = first + share * (second - first)
            mixed[..., 0] %= 1.0
            return hsv_to_rgb(mixed)
        points = rgb_to_lab(self.points) if self.space == "Lab" else self.points
        mixed = (1 - share) * points[before] + share * points[before + 1]
        return lab_to_rgb(mixed) if self.space == "Lab" else mixed

    def reversed(self) -> ColourMap:
        """Reverse the colours; the map reaches over the same values."""
        positions = (self.positions[0] + self.positions[-1]) - self.positions[::-1]
        positions[0], positions[-1] = self.positions[0], self.positions[-1]
        return ColourMap(
            positions=positions, points=self.points[::-1], space=self.space, nan=self.nan
        )

    def rescaled(self, low: float, high: float) -> ColourMap:
        """Move the colours so that they reach over the values `low` to `high`."""
        return ColourMap(
            positions=stretched(self.positions, low, high),
            points=self.points,
            space=self.space,
            nan=self.nan,
        )


def stretched(positions: Floats, low: float, high: float) -> Floats:
    """Move ascending positions so that they reach exactly from `low` to `high`.

    A single position moves to `low`.
    """
    extent = positions[-1] - positions[0]
    share = (positions - positions[0]) / (extent if extent > 0 else 1.0)
    return np.asarray(low * (1 - share) + high * share, dtype=np.float64)


def is_map(name: str) -> bool:
    """Whether a colour map has this name."""
    return _key(name) in COLOUR_MAPS


def named_map(name: str) -> ColourMap:
    """Find a colour map by name, over the values 0..1; the suffix `_r` reverses it.

    Raises InputError for an unknown name, with the nearest one.
    """
    key, reverse = _key(name), name.lower().endswith("_r")
    if key not in COLOUR_MAPS:
        near = difflib.get_close_matches(key, COLOUR_MAPS, n=1, cutoff=0.0)[0]
        near += "_r" if reverse else ""
        raise InputError(
            f"colour map '{name[:60]}' is not known; did you mean '{near}'? "
            f"Known: {', '.join(COLOUR_MAPS)}, each with _r too"
        )
    points = np.array([parse_colour(f"#{point}") for point in COLOUR_MAPS[key]])
    colours = ColourMap(positions=np.linspace(0.0, 1.0, len(points)), points=points)
    return colours.reversed() if reverse else colours


def _key(name: str) -> str:
    """The name that COLOUR_MAPS has: lower case, `grey`, without `_r`."""
    return name.lower().removesuffix("_r").replace("gray", "grey")


def parse_colour(text: str) -> tuple[float, float, float]:
    """Read '#rrggbb', '#rgb' or a name of CSS as red, green and blue, 0..1.

    Raises InputError, with the nearest name if there is one.
    """
    code = ImageColor.colormap.get(text.lower(), text)
    if not isinstance(code, str):
        # pillow replaces the code of a name by numbers once it was asked for that name.
        code = "#" + "".join(f"{channel:02x}" for channel in code[:3])
    if re.fullmatch(r"#[0-9a-fA-F]{3}", code):
        code = "#" + "".join(2 * digit for digit in code[1:])
    if re.fullmatch(r"#[0-9a-fA-F]{6}", code):
        red, green, blue = (int(code[i : i + 2], 16) / 255 for i in (1, 3, 5))
        return red, green, blue
    near = difflib.get_close_matches(text.lower(), ImageColor.colormap, n=1, cutoff=0.5)
    raise InputError(
        f"colour {text[:60]!r} is not known; write '#rrggbb' or a name"
        + (f"; did you mean '{near[0]}'?" if near else "")
    )


def colour_code(colour: Floats) -> str:
    """Write red, green and blue, 0..1, as '#rrggbb'."""
    return "#" + "".join(f"{round(255 * float(channel)):02x}" for channel in colour)
