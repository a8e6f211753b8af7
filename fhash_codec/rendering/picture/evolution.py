"""The evolution of a series: several of its steps side by side in one picture."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.picture.image import Draw, Image
from fhash_codec.rendering.scene.scene import MAX_SIDE, Scene
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError
from fhash_formats.support.locations import without_secrets

__all__ = ["evolution"]

GAP = 1 / 64
"""Gap between two panels, as a share of a panel's width."""
WIDE = 1.6
"""Width over height that the picture aims at when the scene gives no number of columns."""


def evolution(volume: Volume, scene: Scene, *, draw: Draw, progress: Progress = silent) -> Image:
    """Draw the steps of `scene.evolution` row by row in one picture.

    Each panel has a time label. Colour bar and legend of the scene are of the whole picture and are
    not drawn here.

    Args:
        volume: names the source of the picture.
        scene: a scene with an evolution; its size is that of one panel.
        draw: renders one panel, as `Renderer(volume).render` does.
        progress: is told about each finished panel.

    Raises InputError for a scene without steps and for a picture that is too large.
    """
    layout = _layout(scene)
    panels = _panels(scene)
    width, height = layout.size
    rgba = np.zeros((height, width, 4), dtype=np.float32)
    counters: Counter[str] = Counter()
    seconds = 0.0
    for number, panel in enumerate(panels):
        image = draw(panel, upcoming=panels[number + 1] if number + 1 < len(panels) else None)
        rgba[layout.place(number)] = image.rgba
        counters.update(image.counters)
        seconds += image.seconds
        progress("rendering", number + 1, len(panels), "")
    return Image(
        rgba=rgba,
        counters=dict(counters),
        scene=scene.to_dict(),
        source=without_secrets(volume.path),
        digest=volume.container.digest,
        seconds=seconds,
    )


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """Places of the panels, in pixels.

    Attributes:
        columns: panels in a row. rows: rows of panels.
        panel: width and height of one panel.
        gap: distance between two panels.
    """

    columns: int
    rows: int
    panel: tuple[int, int]
    gap: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the whole picture."""
        width, height = self.panel
        return (
            self.columns * (width + self.gap) - self.gap,
            self.rows * (height + self.gap) - self.gap,
        )

    def place(self, number: int) -> tuple[slice, slice]:
        """Rows and columns of pixels of the panel with a number, from 0."""
        width, height = self.panel
        row, column = divmod(number, self.columns)
        top, left = row * (height + self.gap), column * (width + self.gap)
        return slice(top, top + height), slice(left, left + width)


def _layout(scene: Scene) -> _Layout:
    """Arrange the panels of a scene's evolution; raises InputError for too few or too many."""
    if scene.evolution is None or not scene.evolution.steps:
        raise InputError("an evolution needs at least one step")
    count, columns = len(scene.evolution.steps), scene.evolution.columns
    width, height = scene.size
    if columns is None:
        columns = min(count, max(1, round(math.sqrt(WIDE * count * height / width))))
        # The same number of rows may need fewer columns: then the last row is fuller.
        columns = math.ceil(count / math.ceil(count / columns))
    if not 1 <= columns <= count:
        raise InputError(f"columns is {columns}; allowed: 1 to {count}, the number of steps")
    layout = _Layout(
        columns=columns,
        rows=math.ceil(count / columns),
        panel=scene.size,
        gap=max(1, round(GAP * width)),
    )
    if max(layout.size) > MAX_SIDE:
        raise InputError(
            f"{count} pictures make {layout.size[0]} x {layout.size[1]} pixels; "
            f"at most {MAX_SIDE}: take fewer, or smaller ones"
        )
    return layout


def _panels(scene: Scene) -> list[Scene]:
    """The scene of each panel."""
    assert scene.evolution is not None
    plain = dataclasses.replace(
        scene.effects, time_label=True, colour_bar=False, legend=(), buffers=()
    )
    return [
        dataclasses.replace(scene, evolution=None, step=step, effects=plain)
        for step in scene.evolution.steps
    ]
