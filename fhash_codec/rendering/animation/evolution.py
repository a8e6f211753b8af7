"""The evolution of a series: some of its steps side by side in one picture."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter

import numpy as np

from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.animation.animate import Draw
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.scene.scene import MAX_SIDE, Scene
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError

__all__ = ["evolution"]

GAP = 1 / 64
"""Between two pictures, as a share of their width."""
WIDE = 1.6
"""Width of the whole over its height that the number of columns aims at."""


def evolution(
    volume: Volume, scene: Scene, *, progress: Progress = silent, draw: Draw | None = None
) -> Image:
    """The steps of `scene.evolution` in one picture, row by row, each with its time; a colour bar only in the last.

    draw: what renders, `Renderer(volume).render` if None. Raises InputError for a scene without steps and for too large a whole.
    """
    asked = scene.evolution
    if asked is None or not asked.steps:
        raise InputError("an evolution needs at least one step")
    steps, columns, (width, height) = asked.steps, asked.columns, scene.size
    if columns is None:
        columns = min(len(steps), max(1, round(math.sqrt(WIDE * len(steps) * height / width))))
        columns = math.ceil(len(steps) / math.ceil(len(steps) / columns))
    if not 1 <= columns <= len(steps):
        raise InputError(f"columns is {columns}; allowed: 1 to {len(steps)}, the number of steps")
    rows = math.ceil(len(steps) / columns)
    gap = max(1, round(GAP * width))
    whole = columns * (width + gap) - gap, rows * (height + gap) - gap
    if max(whole) > MAX_SIDE:
        raise InputError(
            f"{len(steps)} pictures make {whole[0]} x {whole[1]} pixels; at most {MAX_SIDE}: take fewer, or smaller ones"
        )
    if draw is None:
        from fhash_codec.rendering.renderer import Renderer

        draw = Renderer(volume).render
    plain = dataclasses.replace(scene.effects, time_label=True, colour_bar=False, buffers=())
    last = dataclasses.replace(plain, colour_bar=scene.effects.colour_bar)
    scenes = [
        dataclasses.replace(
            scene, evolution=None, step=step, effects=plain if number < len(steps) - 1 else last
        )
        for number, step in enumerate(steps)
    ]
    rgba = np.zeros((whole[1], whole[0], 4), dtype=np.float32)
    counters: Counter[str] = Counter()
    seconds = 0.0
    for number, each in enumerate(scenes):
        image = draw(each, upcoming=scenes[number + 1] if number + 1 < len(scenes) else None)
        row, column = divmod(number, columns)
        top, left = row * (height + gap), column * (width + gap)
        rgba[top : top + height, left : left + width] = image.rgba
        counters.update(image.counters)
        seconds += image.seconds
        progress("rendering", number + 1, len(scenes), "")
    return Image(
        rgba=rgba,
        counters=dict(counters),
        scene=scene.to_dict(),
        source=str(volume.path),
        digest=volume.container.digest,
        seconds=seconds,
    )
