"""The overlay of a picture: box, axes, colour bar, legend and time label around the volume."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from fhash_codec import times
from fhash_codec.rendering.camera.box import edges, outer_edges
from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.camera.clip import Body
from fhash_codec.rendering.colour.colours import ColourMap
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.picture.layout import Layout, strips
from fhash_codec.rendering.picture.pen import Layer, Pen
from fhash_codec.rendering.scene.scene import Effects
from fhash_formats.series import Coordinate

__all__ = ["overlay", "surrounded", "time_text"]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]


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
        behind = pen.lines([edge for edge in shown if edge.fronts == 0], layout.view)
        _paint_behind(picture, pen.ink, behind)
        before = pen.lines([edge for edge in shown if edge.fronts > 0], layout.view)
        layers.append((pen.ink, before))
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
    """The time label: step and physical time, which is a date where the series has dates."""
    text = times.time_text(coordinate, time)
    if times.is_dated(coordinate):
        return f"step {step:g}   {text.replace('T', ' ')}"
    return f"step {step:g}   t = {text}"


def _paint_before(picture: Single, colour: Floats, opacity: Single) -> None:
    """Put a layer before a picture (H, W, 4), in place."""
    where = opacity > 0
    front = _multiplied(colour if colour.ndim == 1 else colour[where], opacity[where])
    picture[where] = front + (1 - front[:, 3:]) * picture[where]


def _paint_behind(picture: Single, colour: Floats, opacity: Single) -> None:
    """Put a layer of one colour (3,) behind a picture (H, W, 4), in place."""
    where = opacity > 0
    picture[where] += (1 - picture[where][:, 3:]) * _multiplied(colour, opacity[where])


def _multiplied(colour: Floats, opacity: Single) -> Single:
    """Pixels (n, 4): colours (3,) or (n, 3), multiplied by the opacities (n,), and these."""
    return np.concatenate([opacity[..., None] * colour, opacity[..., None]], axis=-1).astype(
        np.float32
    )
