"""The overlay of a picture: box, axes, colour bar and time label around the volume."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.box import edges, outer_edges
from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.camera.clip import Body
from fhash_codec.rendering.colour.colours import ColourMap
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.picture.pen import Layer, Pen
from fhash_codec.rendering.scene.scene import Effects
from fhash_formats.series import Coordinate

__all__ = ["overlay", "time_text"]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]


def overlay(
    image: Image,
    effects: Effects,
    rays: Rays,
    *,
    colours: ColourMap,
    quantity: str,
    coords: Mapping[str, Coordinate],
    label: str = "",
    body: Body | None = None,
) -> Image:
    """Draw box, axes, colour bar and time label, as far as the effects ask for them.

    Args:
        image: the picture of the volume; returned itself if no effect asks for anything.
        effects: of the scene.
        rays: of the picture.
        colours: of the colour bar.
        quantity: name of the colour bar, with units.
        coords: of the axes.
        label: text of the time label.
        body: what a clip leaves of the volume, whose edges are the box; None without one.
    """
    if not (effects.box or effects.axes or effects.colour_bar or effects.time_label):
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
        _paint_behind(picture, pen.ink, pen.lines([edge for edge in shown if edge.fronts == 0]))
        layers.append((pen.ink, pen.lines([edge for edge in shown if edge.fronts > 0])))
    if effects.axes:
        # The scales have a pen of their own, so that the colour bar lies over them.
        scales = Pen(width, height, image.background)
        for edge in outer_edges(rays):
            scales.scale(edge, coords["xyz"[edge.axis]], rays)
        layers += scales.written()
    if effects.colour_bar:
        layers.append(pen.colour_bar(colours, quantity))
    if effects.time_label and label:
        pen.text((pen.size, pen.size), label, "la")
    layers += pen.written()
    for colour, opacity in layers:
        _paint_before(picture, colour, opacity)
    return dataclasses.replace(image, rgba=picture)


def time_text(step: float, time: float, units: str) -> str:
    """The time label: step and physical time."""
    return f"step {step:g}   t = {time:.6g}{f' {units}' if units else ''}"


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
