"""A picture: pixels and buffers with the scene that they show, and what is drawn around the volume.

A PNG holds the scene as JSON in an iTXt chunk `fhash.scene`, the name of the volume's file in
`fhash.source` and its digest in `fhash.digest`. A JPEG holds the pixels alone.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fhash_codec import times
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.colours import ColourMap, parse_colour
from fhash_codec.rendering.layout import (
    TITLE_GAP,
    Bar,
    Label,
    Layout,
    Legend,
    Rectangle,
    fitted,
    font,
    font_size,
    length,
    line_height,
    strips,
    wrapped,
)
from fhash_codec.rendering.scenes import DIGEST_KEY, SCENE_KEY, SOURCE_KEY, Effects, Scene
from fhash_codec.rendering.view import Body, edges, outer_edges
from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate
from fhash_formats.support.files import check_output, replacing_all
from fhash_formats.support.values import Double, Single

if TYPE_CHECKING:
    from PIL.Image import Image as PicturesImage

PICTURES = (".png", ".jpg", ".jpeg")
"""Suffixes of pictures, in lower case."""
JPEG_QUALITY = 92
"""Quality of a JPEG, 1..95, at which letters and edges stay clean."""


def check_picture_name(path: Path, background: str) -> None:
    """Raise InputError for a name that no picture with this background can have."""
    suffix = path.suffix.lower()
    if suffix not in PICTURES:
        raise InputError(
            f"{path}: pictures are written as {', '.join(PICTURES[:-1])} or {PICTURES[-1]}; "
            "use such a name"
        )
    if suffix != ".png" and background == "transparent":
        raise InputError(
            f"{path}: a JPEG cannot be transparent; choose a background, or a name in .png"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """A rendered picture.

    Attributes:
        rgba: float32 (H, W, 4), 0..1, colours multiplied by the opacity; the first row is the top.
        depth: float32 (H, W), distance from the eye along the ray in units of the coordinates,
            infinite where nothing is; or None.
        normal: float32 (H, W, 3), unit vectors in physical x, y, z, 0 where nothing is; or None.
        counters: what the picture took: rays, passes, samples and so on.
        scene: as `Scene.to_dict` gives it.
        source: name of the volume's file.
        digest: `Container.digest` of the volume.
        seconds: time that rendering took.
        ink: share of the view's pixels that differ from the background, before words and frames.
    """

    rgba: Single
    depth: Single | None = None
    normal: Single | None = None
    counters: Mapping[str, int] = field(default_factory=dict)
    scene: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""
    digest: str = ""
    seconds: float = 0.0
    ink: float = 1.0

    @property
    def background(self) -> str:
        """Background of the scene: '#rrggbb', a name, or 'transparent'."""
        return str(self.scene.get("background", Scene().background))

    def ink_share(self) -> float:
        """Share of the pixels that differ from the background."""
        empty = replace(self, rgba=np.zeros((1, 1, 4), np.float32)).to_uint8()
        return float(np.any(self.to_uint8() != empty, axis=-1).mean())

    def to_uint8(self, background: str | None = None) -> npt.NDArray[np.uint8]:
        """Convert to uint8 pixels over a background, that of the scene if None.

        The pixels are (H, W, 3); over 'transparent' (H, W, 4), with colours not multiplied by the
        opacity. Numbers that are not finite count as 0. Raises InputError for an unknown colour.
        """
        name = self.background if background is None else background
        rgba = np.clip(np.nan_to_num(self.rgba, nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)
        colour, opacity = rgba[..., :3], rgba[..., 3:]
        if name == "transparent":
            unmultiplied = np.minimum(colour / np.where(opacity > 0, opacity, np.float32(1)), 1.0)
            mixed = np.concatenate([unmultiplied, opacity], axis=-1)
        else:
            mixed = np.minimum(
                colour + (1 - opacity) * np.array(parse_colour(name), dtype=np.float32), 1.0
            )
        return np.asarray(np.rint(mixed * 255), dtype=np.uint8)

    def save(self, path: str | Path, *, force: bool = False) -> list[Path]:
        """Write NAME.png, and the buffers as NAME.depth.npy and NAME.normal.npy; return the paths.

        A name in .jpg or .jpeg gives a JPEG, which holds no scene. All files are written
        completely, or none is. Raises InputError for another suffix and for a transparent picture
        as JPEG, OutputExistsError unless `force`, OutputError for what cannot be written.
        """
        path = Path(path)
        outputs = self.outputs(path)
        for output in outputs:
            check_output(output, force)
        with replacing_all(outputs, force=force) as temporaries:
            buffers = [buffer for buffer in (self.depth, self.normal) if buffer is not None]
            for temporary, buffer in zip(temporaries[:-1], buffers, strict=True):
                with temporary.open("xb") as file:
                    np.save(file, np.ascontiguousarray(buffer, dtype="<f4"))
            with temporaries[-1].open("xb") as file:
                self._write(file, "PNG" if path.suffix.lower() == ".png" else "JPEG")
        return outputs

    def outputs(self, path: Path) -> list[Path]:
        """List every path that `save` writes, the picture last."""
        check_picture_name(path, self.background)
        named = (("depth", self.depth), ("normal", self.normal))
        return [
            *(
                path.with_name(f"{path.stem}.{name}.npy")
                for name, buffer in named
                if buffer is not None
            ),
            path,
        ]

    def _write(self, file: BinaryIO | io.BytesIO, form: str) -> None:
        from PIL import Image as Pictures
        from PIL.PngImagePlugin import PngInfo

        if form == "JPEG":
            # Colours at full resolution: thin lines would get coloured fringes.
            Pictures.fromarray(self.to_uint8()).save(
                file, format=form, quality=JPEG_QUALITY, subsampling=0
            )
            return
        info = PngInfo()
        info.add_itxt(SCENE_KEY, json.dumps(dict(self.scene)))
        if self.source:
            info.add_itxt(SOURCE_KEY, Path(self.source).name)
        if self.digest:
            info.add_itxt(DIGEST_KEY, self.digest)
        Pictures.fromarray(self.to_uint8()).save(file, format="PNG", pnginfo=info)

    def _repr_png_(self) -> bytes:
        """PNG bytes, for notebooks."""
        file = io.BytesIO()
        self._write(file, "PNG")
        return file.getvalue()

    def __repr__(self) -> str:
        height, width = self.rgba.shape[:2]
        source = Path(self.source).name or "a volume"
        return f"<fhash Image {width}x{height} of {source} in {self.seconds:.3g} s>"


Layer = tuple[Double, Single]
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


class Pen:
    """Writes and draws with the ink that suits a background.

    Attributes:
        ink: colour (3,) of lines and letters. halo: colour (3,) around the letters.
    """

    def __init__(self, width: int, height: int, background: str) -> None:
        """Choose the ink for a picture of `width` x `height` pixels."""
        from PIL import Image as Pictures

        paper = None if background == "transparent" else np.array(parse_colour(background))
        light = paper is None or float(paper @ LUMINANCE) > LIGHT_BACKGROUND
        self.ink, self.halo = (DARK, LIGHT) if light else (LIGHT, DARK)
        self.width, self.height = width, height
        self._letters, self._halos = (Pictures.new("L", (width, height)) for _ in range(2))

    def write(self, label: Label) -> None:
        """Write a label with a halo."""
        from PIL import Image as Pictures
        from PIL import ImageChops, ImageDraw

        wide, tall = (math.ceil(side) + 2 for side in replace(label, upright=False).extent)
        stroke = max(1, label.size // 9)
        pitch = line_height(label.size)
        left, top, _, _ = label.box
        place = round(left) - 1, round(top) - 1
        for mask, width in ((self._halos, stroke), (self._letters, 0)):
            text = Pictures.new("L", (wide, tall))
            draw = ImageDraw.Draw(text)
            for number, line in enumerate(label.lines):
                row = tall / 2 + (number - (len(label.lines) - 1) / 2) * pitch
                draw.text(
                    (wide / 2, row),
                    line,
                    255,
                    font(label.size),
                    anchor="mm",
                    stroke_width=width,
                    stroke_fill=255,
                )
            if label.upright:
                text = text.transpose(Pictures.Transpose.ROTATE_90)
            whole = Pictures.new("L", mask.size)
            whole.paste(text, place)
            mask.paste(ImageChops.lighter(mask, whole))

    def text(self, place: tuple[float, float], text: str, size: int) -> None:
        """Write a line to the right of a place, centred on it vertically."""
        half = Label(lines=(text,), centre=place, size=size).extent[0] / 2
        self.write(Label(lines=(text,), centre=(place[0] + half, place[1]), size=size))

    def written(self) -> tuple[Layer, Layer]:
        """The layers of all texts so far, the lower one first."""
        return (self.halo, _opacity(self._halos)), (self.ink, _opacity(self._letters))

    def lines(self, lines: Sequence[Double], view: tuple[int, int, int, int]) -> Single:
        """The opacity (H, W) of lines (2, 2); they are drawn larger and reduced, to be smooth.

        view: left, top, width and height of the part that their ends are counted in, and beyond
        which nothing is drawn.
        """
        from PIL import Image as Pictures
        from PIL import ImageDraw

        opacity = np.zeros((self.height, self.width), dtype=np.float32)
        left, top, width, height = view
        if not lines:
            return opacity
        finer = 4 if max(width, height) <= 1024 else 2 if max(width, height) <= 4096 else 1
        mask = Pictures.new("L", (width * finer, height * finer))
        draw = ImageDraw.Draw(mask)
        far = 32.0 * max(width, height)  # an edge that passes close by the camera ends anywhere
        thick = max(1, round(finer * font_size(self.width, self.height) / 11))
        for line in lines:
            ends = np.clip(line, -far, far) * finer
            draw.line([*ends[0], *ends[1]], 255, thick)
        inner = _opacity(mask.reduce(finer)) * np.float32(LINE_OPACITY)
        opacity[top : top + height, left : left + width] = inner
        return opacity

    def colour_bar(self, bar: Bar, colours: ColourMap) -> Layer:
        """Draw a colour bar; its ticks and its name are written as texts.

        Returns the layer of frame, colours and tick marks.
        """
        low, high = (float(end) for end in colours.positions[[0, -1]])
        left, top, right, bottom = bar.box
        tall = bottom - top
        canvas = _Canvas(self.width, self.height)
        canvas.fill((left - 1, top - 1, right + 1, bottom + 1), self.ink)
        share = (np.arange(tall)[::-1, None] + 0.5) / tall
        canvas.fill(bar.box, colours(low * (1 - share) + high * share))
        for end, there in enumerate(bar.beyond):  # a triangle where values lie beyond the colours
            for step in range(thick := (right - left) // 2 if there else 0):
                at = top - 2 - step if end else bottom + 1 + step
                inner = left - 1 + step, right + 1 - step
                canvas.fill((inner[0], at, inner[1], at + 1), self.ink)
                if step + 1 < thick:
                    shown = colours(np.array(high if end else low))
                    canvas.fill((inner[0] + 1, at, inner[1] - 1, at + 1), shown)
        stroke, pitch = max(1, bar.size // 12), line_height(bar.size)
        for value, text in bar.marks:
            row = top + (tall - 1) * (1 - (value - low) / ((high - low) or 1.0))
            mark = round(row) - stroke // 2
            canvas.fill((right, mark, right + bar.size // 4, mark + stroke), self.ink)
            self.text((right + bar.size // 4 + 2, row), text, bar.size)
        for number, line in enumerate(reversed(bar.title)):
            over = (right - left) / 2 if bar.beyond[1] else 0.0
            self.text((left - 2, top - over - (number + TITLE_GAP) * pitch), line, bar.size)
        return canvas.colours, canvas.opacity

    def legend(self, legend: Legend) -> Layer:
        """Draw a legend; its texts are written. Returns the layer of its squares."""
        canvas, side = _Canvas(self.width, self.height), legend.size
        for left, top, entry in legend.entries:
            box = round(left), round(top), round(left) + side, round(top) + side
            canvas.fill((box[0] - 1, box[1] - 1, box[2] + 1, box[3] + 1), self.ink)
            canvas.fill(box, np.array(parse_colour(entry.colour)))
            self.text((left + 1.4 * side, top + side / 2), entry.text, side)
        return canvas.colours, canvas.opacity

    def time_label(self, strip: Rectangle, text: str) -> None:
        """Write the time label in its strip: smaller where it is long, in two lines if need be."""
        size = font_size(self.width, self.height)
        room = strip[2] - strip[0] - size
        size = fitted([text], size, room)
        lines = (text,) if length(text, size) <= room else wrapped(text, size, room)
        label = Label(lines=lines, centre=(0.0, 0.0), size=size)
        wide, _ = label.extent
        left = strip[0] + font_size(self.width, self.height) / 2
        self.write(replace(label, centre=(left + wide / 2, (strip[1] + strip[3]) / 2)))


class _Canvas:
    """A layer that rectangles are filled in."""

    def __init__(self, width: int, height: int) -> None:
        self.colours: Double = np.zeros((height, width, 3))
        self.opacity: Single = np.zeros((height, width), dtype=np.float32)

    def fill(self, rectangle: tuple[int, int, int, int], colour: Double) -> None:
        """Fill a rectangle, as far as it lies on the canvas.

        Args:
            rectangle: left, top, right, bottom in pixels; the last two lie outside.
            colour: (3,), or a colour for each row of the rectangle (rows, 1, 3).
        """
        left, top, right, bottom = rectangle
        height, width = self.opacity.shape
        first = max(top, 0)
        last = max(min(bottom, height), first)  # a rectangle below the canvas has no row on it
        area = slice(first, last), slice(max(left, 0), max(min(right, width), 0))
        self.colours[area] = colour[first - top : last - top] if colour.ndim == 3 else colour
        self.opacity[area] = 1


def _opacity(mask: PicturesImage) -> Single:
    """The opacity 0..1 of a mask of bytes."""
    return np.asarray(mask, dtype=np.float32) / np.float32(255)


def overlay(
    image: Image,
    effects: Effects,
    rays: Rays,
    layout: Layout,
    *,
    colours: ColourMap,
    label: str = "",
    body: Body | None = None,
) -> Image:
    """Draw box, axes, colour bar, legend and time label, as far as the effects ask for them.

    Args:
        image: the picture of the volume; returned itself if no effect asks for anything.
        effects: of the scene.
        rays: of the part of the picture that shows the volume.
        layout: of the picture.
        colours: of the colour bar.
        label: text of the time label.
        body: what a clip leaves of the volume, whose edges are the box; None without one.
    """
    if not any((effects.box, effects.axes, effects.colour_bar, effects.time_label, effects.legend)):
        return image
    height, width = image.rgba.shape[:2]
    pen = Pen(width, height, image.background)
    picture = image.rgba.copy()
    layers: list[Layer] = []
    if effects.box or effects.axes:
        shown = edges(rays, body) if effects.box else outer_edges(rays)
        if body is not None and effects.box and effects.axes:
            shown += outer_edges(rays)  # of all of the volume
        # The volume lies inside the box: an edge between two faces that look away lies behind all
        # of the volume, any other edge before all of it.
        behind = pen.lines([edge.ends for edge in shown if edge.fronts == 0], layout.view)
        _paint_behind(picture, pen.ink, behind)
        before = pen.lines([edge.ends for edge in shown if edge.fronts > 0], layout.view)
        layers.append((pen.ink, before))
        layers.append((pen.ink, pen.lines(layout.marks, (0, 0, width, height))))
    for text in layout.labels:
        pen.write(text)
    if layout.time is not None and label:
        pen.time_label(layout.time, label)
    layers += _around(pen, layout, colours)
    for colour, opacity in layers:
        _paint_before(picture, colour, opacity)
    return dataclasses.replace(image, rgba=picture)


def surrounded(image: Image, effects: Effects, *, colours: ColourMap, quantity: str) -> Image:
    """Put the colour bar and the legend of a scene beside and below a picture of several panels.

    Args:
        image: the panels; returned itself if no effect asks for anything.
        effects: of the scene.
        colours: of the colour bar.
        quantity: name of the colour bar, with units.
    """
    wanted = Effects(colour_bar=effects.colour_bar, legend=effects.legend)
    if wanted == Effects():
        return image
    height, width = image.rgba.shape[:2]
    # The strips take their widths from the picture with them: a few rounds settle both.
    size = (width, height)
    for _ in range(8):
        layout = strips(size, wanted, colours, quantity)
        size = (width + size[0] - layout.view[2], height + size[1] - layout.view[3])
        if layout.view[2] >= width and layout.view[3] >= height:
            break
    layout = strips(size, wanted, colours, quantity)
    pen = Pen(*size, image.background)
    picture = np.zeros((size[1], size[0], 4), dtype=np.float32)
    picture[:height, :width] = image.rgba
    for colour, opacity in _around(pen, layout, colours):
        _paint_before(picture, colour, opacity)
    return dataclasses.replace(image, rgba=picture)


def _around(pen: Pen, layout: Layout, colours: ColourMap) -> list[Layer]:
    """The layers of colour bar and legend, and of all texts of a pen."""
    layers = []
    if layout.bar is not None:
        layers.append(pen.colour_bar(layout.bar, colours))
    if layout.legend is not None:
        layers.append(pen.legend(layout.legend))
    return [*layers, *pen.written()]


def time_text(step: float, time: float, coordinate: Coordinate) -> str:
    """The time label: step and physical time, which is a date where the series has dates.

    A volume without a time has none.
    """
    if times.is_static(coordinate):
        return ""
    text = times.time_text(coordinate, time)
    if times.is_dated(coordinate):
        return f"step {step:g}   {text.replace('T', ' ')}"
    return f"step {step:g}   t = {text}"


def _paint_before(picture: Single, colour: Double, opacity: Single) -> None:
    """Put a layer before a picture (H, W, 4), in place."""
    where = opacity > 0
    front = _multiplied(colour if colour.ndim == 1 else colour[where], opacity[where])
    picture[where] = front + (1 - front[:, 3:]) * picture[where]


def _paint_behind(picture: Single, colour: Double, opacity: Single) -> None:
    """Put a layer of one colour (3,) behind a picture (H, W, 4), in place."""
    where = opacity > 0
    picture[where] += (1 - picture[where][:, 3:]) * _multiplied(colour, opacity[where])


def _multiplied(colour: Double, opacity: Single) -> Single:
    """Pixels (n, 4): colours (3,) or (n, 3), multiplied by the opacities (n,), and these."""
    return np.concatenate([opacity[..., None] * colour, opacity[..., None]], axis=-1).astype(
        np.float32
    )
