"""Pictures of `fhash demo`: the series and commands of the gallery, and original beside decoded."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from fhash_codec.rendering.colours import COLOUR_MAPS
from fhash_codec.simulation.simulate import simulate
from fhash_formats.series import ArraySeries, Coordinate, Series
from fhash_formats.support.values import Double

DAY = 86400.0
"""Seconds of a day."""


@dataclass(frozen=True, kw_only=True)
class GallerySeries:
    """A series of the gallery.

    Attributes:
        make: simulates it.
        options: of `fhash encode`.
    """

    make: Callable[[], Series]
    options: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture of the gallery.

    Attributes:
        name: of its file, without the suffix.
        title: one line.
        series: name of its series.
        options: of `fhash render`.
    """

    name: str
    title: str
    series: str
    options: tuple[str, ...]


def _sea() -> ArraySeries:
    """Sea surface temperature on a grid of 2 degrees, every 30 days of a year."""
    latitude, longitude = np.linspace(89, -89, 90), np.arange(0.0, 360.0, 2.0)
    y, x = np.meshgrid(np.radians(latitude), np.radians(longitude), indexing="ij")
    days = np.arange(12) * 30.0
    season = np.cos(2 * np.pi * days / 360)[:, None, None]
    waves = np.sin(3 * x + 2 * np.sin(y) + days[:, None, None] / 60) * np.cos(4 * y - x)
    values = 29 * np.cos(y) ** 1.6 - 1.5 - 5 * season * np.sin(y) * np.cos(y) + 1.2 * waves
    land = np.cos(2 * x - 0.7) * np.cos(y) + 0.6 * np.sin(3 * x + 3 * y) * np.cos(y - 0.3)
    values = np.where((land > 0.62) | (y < -1.25), np.nan, values)
    return _series(
        values[:, None],
        "sea_surface_temperature",
        "degree_Celsius",
        t=_at("time", days * DAY, "s"),
        z=_at("level", [0.0], "1"),
        y=_at("latitude", latitude, "degrees_north"),
        x=_at("longitude", longitude, "degrees_east"),
    )


def _ocean() -> ArraySeries:
    """Temperature of a basin at 28 depths from 5 m to 5000 m, with a warm pool and a ridge."""
    depth = 5 * 1000 ** np.linspace(0, 1, 28)
    latitude, longitude = np.linspace(-40, 40, 64), np.linspace(120, 240, 96)
    z, y, x = np.meshgrid(depth, latitude, longitude, indexing="ij", sparse=True)
    steps = np.arange(4.0)[:, None, None, None]
    thermocline = (
        280 - 1.6 * (x - 120) + 90 * np.cos(np.radians(4 * y)) + 12 * np.sin(x / 9 + steps)
    )
    values = 2 + (27 - 0.008 * y**2) / (1 + np.exp((z - thermocline) / 140))
    floor = (
        4300 - 2600 * np.exp(-(((x - 175 - 0.4 * y) / 9) ** 2)) - 3600 * (np.abs(x - 180) / 62) ** 6
    )
    values = np.where(z > floor + 500 * np.sin(y / 9) * np.cos(x / 11), np.nan, values)
    return _series(
        values,
        "sea_water_temperature",
        "degree_Celsius",
        t=_at("time", np.arange(4) * 30 * DAY, "s"),
        z=_at("depth", depth, "m", positive="down", standard_name="depth"),
        y=_at("latitude", latitude, "degrees_north"),
        x=_at("longitude", longitude, "degrees_east"),
    )


def _jet() -> ArraySeries:
    """Wind speed at uneven pressure levels from 1000 to 20 hPa: two meandering jet streams."""
    levels = np.array(
        [*range(1000, 875, -25), 850, 800, 700, 600, 500, *range(400, 50, -50), 70, 50, 20],
        dtype=np.float64,
    )
    latitude, longitude = np.linspace(80, -80, 81), np.arange(0.0, 360.0, 3.0)
    z, y, x = np.meshgrid(levels, latitude, np.radians(longitude), indexing="ij", sparse=True)
    phase = np.arange(4.0)[:, None, None, None] * 0.5
    north = 42 + 9 * np.sin(4 * x + phase) + 4 * np.sin(7 * x - phase)
    south = -45 + 6 * np.sin(5 * x - phase)
    strength = 1 + 0.25 * np.sin(2 * x + phase)
    height = np.exp(-(((z - 240) / 150) ** 2))
    values = 4 + 60 * height * (
        strength * np.exp(-(((y - north) / 9) ** 2)) + 0.8 * np.exp(-(((y - south) / 10) ** 2))
    )
    return _series(
        values + 3 * np.sin(2 * x) * np.cos(np.radians(3 * y)) * z / 1000,
        "wind_speed",
        "m s-1",
        t=_at("time", np.arange(4) * DAY, "s"),
        z=_at("air_pressure", levels, "hPa", positive="down", standard_name="air_pressure"),
        y=_at("latitude", latitude, "degrees_north"),
        x=_at("longitude", longitude, "degrees_east"),
    )


def _series(values: Double, name: str, units: str, **coords: Coordinate) -> ArraySeries:
    return ArraySeries(values.astype(np.float32), name=name, units=units, coords=coords)


def _at(name: str, values: npt.ArrayLike, units: str, **attributes: str) -> Coordinate:
    return Coordinate(
        name=name,
        values=np.asarray(values, dtype=np.float64),
        attributes={"units": units, **attributes},
    )


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


GALLERY_SERIES = {
    "sea": GallerySeries(make=_sea, options=_words("--max-error 0.05 --effort 1")),
    "ocean": GallerySeries(make=_ocean, options=_words("--max-error 0.05 --effort 1")),
    "jet": GallerySeries(make=_jet, options=_words("--psnr 55 --effort 1")),
    "blast": GallerySeries(
        make=lambda: simulate("front", (12, 48, 48, 48)),
        options=_words("--max-error-rel 0.005 --effort 1"),
    ),
}
"""Series of the gallery by name."""

PICTURES = (
    Picture(
        name="plane",
        title="Sea surface temperature: a plane from above",
        series="sea",
        options=_words("--size 960x540 --cmap turbo"),
    ),
    Picture(
        name="depth",
        title="Ocean temperature at uneven depths",
        series="ocean",
        options=_words("--size 800x600 --cmap turbo --opacity 2:0.02,6:0.12,30:0.25 --azimuth -75"),
    ),
    Picture(
        name="pressure",
        title="Isosurfaces of jet streams at uneven pressure levels",
        series="jet",
        options=_words(
            "--size 800x600 --no-volume --isosurface 50,#d95f02 --isosurface 30,#3182bd,0.4"
            " --scale 1,1,0.1 --azimuth -75 --antialiasing 2"
        ),
    ),
    Picture(
        name="shaded",
        title="Blast wave with shadows",
        series="blast",
        options=_words("--size 760x760 --t 8 --cmap plasma --density 2 --effect shadows"),
    ),
    Picture(
        name="surface",
        title="Transparent isosurface on a dark background",
        series="blast",
        options=_words(
            "--size 800x800 --t 6 --no-volume --isosurface 0.35,#e6550d"
            " --isosurface 0.24,#9ecae1,0.35 --antialiasing 2 --background #101520"
        ),
    ),
    Picture(
        name="track",
        title="Tracked features over several steps",
        series="blast",
        options=_words(
            "--size 320x300 --evolution 1:12:3 --columns 4 --track interval:0.25:0.35"
            " --track isosurface:0.4"
        ),
    ),
)
"""Pictures of the gallery."""


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


def page(folder: str) -> str:
    """The page of the gallery in Markdown; folder: of the pictures, beside the page."""
    lines = [
        "# Gallery",
        "",
        f"`fhash demo --gallery {folder}` simulates these series, encodes and draws them: the",
        f"pictures into `{folder}`, the series and their files into `{folder}/series`, where the",
        "commands below give the same again.",
    ]
    for picture in PICTURES:
        lines += ["", f"## {picture.title}", "", f"![{picture.title}]({folder}/{picture.name}.png)"]
        lines += ["", "```", *commands(picture), "```"]
    return "\n".join(lines) + "\n"


def commands(picture: Picture) -> list[str]:
    """The two commands of a picture, as they are typed in the folder of the series."""
    name = picture.series
    encode = ["fhash", "encode", f"{name}.h5", "-o", f"{name}.fhz", *GALLERY_SERIES[name].options]
    render = ["fhash", "render", f"{name}.fhz", "-o", f"{picture.name}.png", *picture.options]
    return [shlex.join(encode), shlex.join(render)]
