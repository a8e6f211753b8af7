"""Colours by name or '#rrggbb', colour spaces, colour maps, and the preset files of ParaView."""

from __future__ import annotations

import difflib
import json
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import ImageColor

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.support.values import Double

# They are sampled from matplotlib: interpolated in RGB they are nowhere further than 6/255 from the
# original. viridis, plasma, inferno, magma and cividis are CC0; coolwarm is by Kenneth Moreland,
# turbo by Anton Mikhailov of Google, Apache 2.0; blues to rdbu are by Cynthia Brewer,
# colorbrewer2.org, Apache 2.0. `balance` and the nine points of `jet` are our own.
_ANCHORS = {
    "viridis": (
        "440154 471163 481f71 472d7b 443a83 404688 3b528b 355d8d 31688e 2c728e 287c8e 24868e "
        "21908c 1f9a8a 20a486 28ae80 35b779 47c06f 5dc963 75d054 8fd744 abdc32 c7e020 e3e418 "
        "fde725"
    ),
    "plasma": (
        "0d0887 220690 310596 3f049c 4c02a1 5901a5 6600a7 7201a8 7e03a8 8909a6 9511a2 9f1a9c "
        "a92396 b22c8e bb3587 c33e80 cb4778 d25071 d9596a e06263 e66c5c eb7555 f07f4f f48a48 "
        "f89441 fb9f3a fdab33 feb72d fdc328 fcd025 f9dd25 f5eb27 f0f921"
    ),
    "inferno": (
        "000004 040312 0b0724 150b37 210c4a 2e0a5a 3c0965 4a0c6b 57106d 63146e 70196e 7d1e6d "
        "89226a 962766 a32b61 af315c bb3755 c63e4d d14644 db4f3b e35932 eb6528 f1711e f67f14 "
        "f98d0a fb9c06 fcab0f fbba1f f9ca32 f5d949 f2e865 f3f586 fcffa4"
    ),
    "magma": (
        "000004 050417 100c2d 1d1146 2d1160 3f0f73 50127c 611980 721f81 822681 932b80 a4317e "
        "b63779 c73d73 d7456c e65163 f1605d f8735c fb8761 fd9b6b feaf78 fec387 fed698 fde9ab "
        "fcfdbf"
    ),
    "cividis": (
        "00224e 00285b 002e6a 043371 1a386f 273e6e 32436d 3b496c 434e6c 4b546c 52596d 5a5f6e "
        "61656f 686a71 6f7073 757676 7c7b78 848179 8b8778 938d78 9b9376 a39a75 aba072 b3a670 "
        "bbad6c c3b469 ccba64 d4c15f ddc958 e6d051 efd748 f8df3c fee838"
    ),
    "turbo": (
        "30123b 392a73 4040a1 4456c7 466be3 467ff6 4293ff 37a7fa 29bbec 1dcdd8 18dcc3 1ee8b0 "
        "31f299 4cf97e 6bfd64 8aff4d a3fd3c b8f735 cced34 dee037 edd03a f8c03a fdae35 fe982c "
        "fb8022 f56817 ec520f e04009 d23105 c02302 ac1701 950d01 7a0403"
    ),
    "coolwarm": (
        "3b4cc0 445acc 4d68d7 5775e1 6282ea 6c8ef1 779af7 82a5fb 8db0fe 98b9ff a3c2ff aec9fd "
        "b8d0f9 c2d5f4 ccd9ee d5dbe6 dddddd e5d8d1 ecd3c5 f1ccb9 f4c4ad f7bba0 f7b194 f7a687 "
        "f49a7b f18d6f ec7f63 e57058 de604d d55042 cb3e38 c0282f b40426"
    ),
    "grey": "000000 ffffff",
    "rainbow": (
        "8000ff 6032fe 4062fa 208ef4 00b4ec 20d4e1 40ecd4 60fac5 80ffb4 9ffaa2 bfec8e dfd478 "
        "ffb462 ff8e4a ff6232 ff3219 ff0000"
    ),
    "hot": (
        "0b0000 200000 340000 490000 5e0000 730000 880000 9d0000 b20000 c70000 dc0000 f10000 "
        "ff0700 ff1c00 ff3000 ff4500 ff5a00 ff6f00 ff8400 ff9900 ffae00 ffc300 ffd800 ffed00 "
        "ffff04 ffff23 ffff43 ffff62 ffff81 ffffa1 ffffc0 ffffe0 ffffff"
    ),
    "bone": "000000 1c1c27 38384e 545574 707b8f 8ba1ab a8c7c7 d3e3e3 ffffff",
    "copper": (
        "000000 140c08 271910 3b2518 4f3220 623e28 764b30 8a5738 9d643f b17047 c57d4f d98957 "
        "ec955f ffa267 ffae6f ffbb77 ffc77f"
    ),
    "blues": "f7fbff deebf7 c6dbef 9ecae1 6baed6 4292c6 2171b5 08519c 08306b",
    "greens": "f7fcf5 e5f5e0 c7e9c0 a1d99b 74c476 41ab5d 238b45 006d2c 00441b",
    "reds": "fff5f0 fee0d2 fcbba1 fc9272 fb6a4a ef3b2c cb181d a50f15 67000d",
    "ylgnbu": "ffffd9 edf8b1 c7e9b4 7fcdbb 41b6c4 1d91c0 225ea8 253494 081d58",
    "spectral": "9e0142 d53e4f f46d43 fdae61 fee08b ffffbf e6f598 abdda4 66c2a5 3288bd 5e4fa2",
    "rdbu": "67001f b2182b d6604d f4a582 fddbc7 f7f7f7 d1e5f0 92c5de 4393c3 2166ac 053061",
    "twilight": (
        "e2d9e2 d6d7dd c3ced4 abc2cc 94b4c7 81a6c3 7297c1 6886be 6275ba 5f63b5 5e51ad 5d3da1 "
        "592a8f 521b77 45135c 381146 2f1437 3a113a 4b1342 5f174a 741e4f 872750 983550 a64550 "
        "b25652 bb6858 c27c62 c78f72 cca388 d1b5a2 d8c6bd ded3d5 e2d9e2"
    ),
    "ocean": (
        "008000 00700b 006015 005020 00402a 003035 002040 00104a 000055 001060 00206a 003075 "
        "004080 00508a 006095 00709f 0080aa 208fb5 409fbf 60afca 7fbfd4 9fcfdf bfdfea dfeff4 "
        "ffffff"
    ),
    "balance": "1b4f8c 4a86c0 9cc3df f7f7f5 f1b08a d1604b 93202c",
    "jet": "000080 0000ff 0080ff 00ffff 80ff80 ffff00 ff8000 ff0000 800000",
}
COLOUR_MAPS = {name: tuple(anchors.split()) for name, anchors in _ANCHORS.items()}
"""Colours 'rrggbb' of each map by its name."""

WHITE = (0.9505, 1.0, 1.089)
"""The white point D65 in XYZ, rounded as in VTK."""
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""Matrix from linear RGB to XYZ."""
FROM_XYZ = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
"""Matrix from XYZ to linear RGB."""


def rgb_to_hsv(rgb: Double) -> Double:
    """Convert to hue, saturation and value, each 0..1."""
    value = rgb.max(axis=-1)
    spread = value - rgb.min(axis=-1)
    safe = np.where(spread > 0, spread, 1.0)
    red, green, blue = np.moveaxis(rgb, -1, 0)
    hue = np.where(
        value == red,
        ((green - blue) / safe) % 6,
        np.where(value == green, 2 + (blue - red) / safe, 4 + (red - green) / safe),
    )
    return np.stack(
        [np.where(spread > 0, hue / 6, 0.0), spread / np.where(value > 0, value, 1.0), value],
        axis=-1,
    )


def hsv_to_rgb(hsv: Double) -> Double:
    """Invert `rgb_to_hsv`."""
    hue, saturation, value = (channel[..., None] for channel in np.moveaxis(hsv, -1, 0))
    pure = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0.0, 1.0)
    return np.asarray(value * (1 + saturation * (pure - 1)), dtype=np.float64)


def rgb_to_lab(rgb: Double) -> Double:
    """Convert to CIE Lab: lightness 0..100, a and b."""
    linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    xyz = linear @ TO_XYZ.T / WHITE
    x, y, z = np.moveaxis(np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def lab_to_rgb(lab: Double) -> Double:
    """Invert `rgb_to_lab`.

    A colour that no screen has is dimmed until its brightest channel is 1, and channels below 0
    become 0.
    """
    lightness, a, b = np.moveaxis(lab, -1, 0)
    y = (lightness + 16) / 116
    roots = np.stack([y + a / 500, y, y - b / 200], axis=-1)
    xyz = np.where(roots**3 > 0.008856, roots**3, (roots - 16 / 116) / 7.787) * WHITE
    linear = xyz @ FROM_XYZ.T
    rgb = np.where(
        linear > 0.0031308, 1.055 * np.maximum(linear, 0.0) ** (1 / 2.4) - 0.055, 12.92 * linear
    )
    return np.asarray(
        np.maximum(rgb / np.maximum(rgb.max(axis=-1, keepdims=True), 1.0), 0.0), dtype=np.float64
    )


def mix_diverging(first: Double, second: Double, share: Double) -> Double:
    """Mix two colours on Moreland's diverging scale.

    The scale passes through white where both colours are saturated and their hues are far apart.

    Args:
        first: sRGB (..., 3), at share 0.
        second: sRGB (..., 3), at share 1.
        share: (..., 1), 0..1.
    """
    start, end = _lab_to_msh(rgb_to_lab(first)), _lab_to_msh(rgb_to_lab(second))
    share = np.array(np.broadcast_to(share, (*start.shape[:-1], 1)))[..., 0]
    turn = np.abs(start[..., 2] - end[..., 2])
    turn = np.where(turn > np.pi, 2 * np.pi - turn, turn)
    apart = (start[..., 1] > 0.05) & (end[..., 1] > 0.05) & (turn > 0.33 * np.pi)
    white = np.stack(
        [np.maximum(np.maximum(start[..., 0], end[..., 0]), 88.0), *[np.zeros_like(share)] * 2],
        axis=-1,
    )
    lower = share < 0.5
    end = np.where((apart & lower)[..., None], white, end)
    start = np.where((apart & ~lower)[..., None], white, start)
    share = np.where(apart, np.where(lower, 2 * share, 2 * share - 1), share)
    grey_start = (start[..., 1] < 0.05) & (end[..., 1] > 0.05)
    grey_end = (end[..., 1] < 0.05) & (start[..., 1] > 0.05)
    start[..., 2], end[..., 2] = (
        np.where(grey_start, _hue(end, start[..., 0]), start[..., 2]),
        np.where(grey_end, _hue(start, end[..., 0]), end[..., 2]),
    )
    mixed = start + share[..., None] * (end - start)
    m, s, h = np.moveaxis(mixed, -1, 0)
    return lab_to_rgb(
        np.stack([m * np.cos(s), m * np.sin(s) * np.cos(h), m * np.sin(s) * np.sin(h)], axis=-1)
    )


def _lab_to_msh(lab: Double) -> Double:
    """Convert to Moreland's polar Lab: magnitude, saturation angle and hue angle."""
    m = np.sqrt((lab**2).sum(axis=-1))
    s = np.where(
        m > 0.001, np.arccos(np.clip(lab[..., 0] / np.where(m > 0.001, m, 1.0), -1.0, 1.0)), 0.0
    )
    h = np.where(s > 0.001, np.arctan2(lab[..., 2], lab[..., 1]), 0.0)
    return np.stack([m, s, h], axis=-1)


def _hue(msh: Double, unsaturated: Double) -> Double:
    """Choose the hue of an unsaturated colour so that the scale to a saturated one is even.

    Args:
        msh: the saturated colour (..., 3).
        unsaturated: magnitude (...) of the other colour.
    """
    m, s, h = np.moveaxis(msh, -1, 0)
    spin = s * np.sqrt(np.maximum(unsaturated**2 - m**2, 0.0)) / np.maximum(m * np.sin(s), 1e-30)
    return np.asarray(
        np.where(m >= unsaturated - 0.1, h, np.where(h > -0.3 * np.pi, h + spin, h - spin)),
        dtype=np.float64,
    )


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

    positions: Double
    points: Double
    space: str = "RGB"
    nan: tuple[float, float, float] = NAN

    def __call__(self, values: npt.ArrayLike) -> Double:
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

    def _mix(self, before: npt.NDArray[np.intp], share: Double) -> Double:
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


def stretched(positions: Double, low: float, high: float) -> Double:
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


def colour_code(colour: Double) -> str:
    """Write red, green and blue, 0..1, as '#rrggbb'."""
    return "#" + "".join(f"{round(255 * float(channel)):02x}" for channel in colour)


MAX_BYTES = 16 * 2**20
"""Most bytes of a preset file; all of ParaView's own presets in one file are below 1 MiB."""
PIECES = 128
"""Straight pieces that stand for one curved piece of an opacity."""
SPACE_NAMES = {"rgb": "RGB", "hsv": "HSV", "lab": "Lab", "diverging": "Diverging", "step": "Step"}
"""Colour spaces by ParaView's names for them, in lower case."""
PLAIN = (0.5, 0.0)
"""Midpoint and sharpness of a straight piece."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Preset:
    """A preset.

    Attributes:
        name: of the preset, else of its file.
        colours: the colour map.
        opacity: points (value, opacity), float64 (n, 2), values strictly ascending; or None.
    """

    name: str
    colours: ColourMap
    opacity: Double | None

    @property
    def is_relative(self) -> bool:
        """Whether the preset reaches from 0 or -1 to 1, as ParaView's own do, not over data."""
        return (
            float(self.colours.positions[0]) in (0.0, -1.0)
            and float(self.colours.positions[-1]) == 1.0
        )

    def rescaled(self, low: float, high: float) -> Preset:
        """Move the preset to the values `low` to `high`; the opacities move with the colours."""
        opacity = None
        if self.opacity is not None:
            first, last = self.colours.positions[[0, -1]]
            share = (self.opacity[:, 0] - first) / ((last - first) or 1.0)
            opacity = np.stack([low * (1 - share) + high * share, self.opacity[:, 1]], axis=-1)
        return Preset(name=self.name, colours=self.colours.rescaled(low, high), opacity=opacity)


def read_preset(path: str | Path) -> Preset:
    """Read the first preset with colours of a file, which holds one preset or a list of them.

    Raises InputError with one line for anything else.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: larger than {MAX_BYTES >> 20} MiB; not a preset of ParaView")
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise MissingInputError(f"{path}: no such preset") from error
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a preset of ParaView: {error}") from error
    for preset in content if isinstance(content, list) else [content]:
        if isinstance(preset, dict) and "RGBPoints" in preset:
            return _preset(path, preset)
    raise InputError(
        f"{path}: holds no preset with RGBPoints"
        + (" (IndexedColors are for categories)" if "IndexedColors" in str(content)[:10000] else "")
    )


def _preset(path: Path, preset: dict[str, Any]) -> Preset:
    """Check a preset and convert it; raises InputError."""
    rows = _rows(path, "RGBPoints", preset["RGBPoints"])
    positions, points = rows[:, 0], rows[:, 1:]
    if np.any(np.diff(positions) < 0) or (len(positions) > 1 and positions[0] == positions[-1]):
        raise InputError(f"{path}: the values of RGBPoints do not ascend")
    if np.any((points < 0) | (points > 1)):
        raise InputError(f"{path}: RGBPoints has a colour outside 0 to 1")
    stated = preset.get("ColorSpace", "RGB")
    space = SPACE_NAMES.get(str(stated).lower().replace("cielab", "lab"))
    if space is None:
        raise InputError(f"{path}: ColorSpace is '{stated!s:.40}'; allowed: {', '.join(SPACES)}")
    nan = (
        _rows(path, "NanColor", preset["NanColor"], columns=3)[0]
        if "NanColor" in preset
        else np.array(NAN)
    )
    colours = ColourMap(
        positions=positions, points=points, space=space, nan=tuple(np.clip(nan, 0.0, 1.0).tolist())
    )
    opacity = (
        _opacity(path, _rows(path, "Points", preset["Points"])) if preset.get("Points") else None
    )
    return Preset(name=str(preset.get("Name", path.stem)), colours=colours, opacity=opacity)


def _rows(path: Path, key: str, values: Any, columns: int = 4) -> Double:
    """The flat list of a key as rows of finite numbers; raises InputError for anything else."""
    is_list = isinstance(values, list) and all(
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
        for value in values
    )
    if not is_list or not values or len(values) % columns:
        raise InputError(f"{path}: {key} is not a list of finite numbers, {columns} for each point")
    return np.array(values, dtype=np.float64).reshape(-1, columns)


def _opacity(path: Path, rows: Double) -> Double:
    """Opacities as straight pieces (n, 2); a curved piece becomes PIECES of them.

    Args:
        path: of the file, for messages.
        rows: value, opacity, midpoint and sharpness, as vtkPiecewiseFunction takes them.
    """
    if np.any(np.diff(rows[:, 0]) <= 0):
        raise InputError(f"{path}: the values of Points do not ascend")
    if np.any((rows[:, 1:] < 0) | (rows[:, 1:] > 1)):
        raise InputError(f"{path}: Points has an opacity, midpoint or sharpness outside 0 to 1")
    pieces = [rows[:1, :2]]
    for first, second in pairwise(rows):
        if (first[2], first[3]) != PLAIN and first[1] != second[1]:
            pieces.append(_between(first, second))
        pieces.append(second[None, :2])
    return np.concatenate(pieces)


def _between(first: Double, second: Double) -> Double:
    """Points (n, 2) of the curve between two rows, without its ends; values strictly ascending."""
    share = np.arange(1, PIECES) / PIECES
    values = first[0] * (1 - share) + second[0] * share
    # Rounding may make values equal where the rows lie close together.
    ascending = (
        np.concatenate([[True], np.diff(values) > 0]) & (values > first[0]) & (values < second[0])
    )
    opacities = _curve(share, float(first[1]), float(second[1]), float(first[2]), float(first[3]))
    return np.asarray(np.stack([values, opacities], axis=-1)[ascending], dtype=np.float64)


def _curve(share: Double, first: float, second: float, midpoint: float, sharpness: float) -> Double:
    """Opacities between `first` and `second` at shares 0..1, as vtkPiecewiseFunction::GetTable."""
    midpoint = min(max(midpoint, 1e-5), 1 - 1e-5)
    share = np.where(
        share < midpoint, 0.5 * share / midpoint, 0.5 + 0.5 * (share - midpoint) / (1 - midpoint)
    )
    if sharpness < 0.01:
        return first + share * (second - first)
    power = 1 + 10 * sharpness
    share = np.where(share < 0.5, 0.5 * (2 * share) ** power, 1 - 0.5 * (2 * (1 - share)) ** power)
    square, cube = share**2, share**3
    slope = (1 - sharpness) * (second - first)
    mixed = (
        (2 * cube - 3 * square + 1) * first
        + (3 * square - 2 * cube) * second
        + (cube - 2 * square + share) * slope
    )
    mixed += (cube - square) * slope
    return np.clip(mixed, min(first, second), max(first, second))
