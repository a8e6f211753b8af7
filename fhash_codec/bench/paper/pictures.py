"""Pictures of key frames, true and decoded, and their likeness.

The marcher, transfer functions and surfaces are the product's own. An interval and a segmentation
are drawn as a volume, with the opacity that `fhash render` gives such a feature; an isosurface is
drawn as an opaque, shaded surface. The paper prints neither picture size, camera nor transfer
functions: ours are the default direction of view, aimed at the feature, which fills the picture,
and half a vertex spacing a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.pictures.likeness import black, picture_psnr, picture_ssim
from fhash_codec.features.features import Interval, Isosurface, Segmentation, parse_feature
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Lighting, Surface, Table, Task
from fhash_codec.rendering.scenes import Camera, TransferFunctionSpec
from fhash_codec.rendering.transfer_function import TransferFunction

__all__ = ["IDENTICAL", "Likeness", "PictureProbe", "view_of_feature"]

Single = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Range = tuple[float, float]

SIZE = 192
"""Pixels along both sides of a picture, by default."""
STEP = 0.5
"""Length of a ray's step in vertex spacings."""
THRESHOLD = 1 / 1024
"""Share of the light behind a sample below which a ray ends."""
FILLED = 0.97
"""Share of the picture, from its middle to its border, that the feature reaches to."""
IDENTICAL = 100.0
"""PSNR in dB that stands for pictures without any difference, so that a mean exists; above it none
is told apart."""
LIGHTING = Lighting(ambient=0.2, diffuse=0.8, specular=0.2, specular_power=16.0, lamp=None)
"""Light of a surface: the defaults of `fhash render`, with the lamp at the camera."""


class Likeness(NamedTuple):
    """Likeness of decoded pictures with true ones, the mean over key frames.

    Attributes:
        psnr: dB of colours over black, 0 to 1 in float32, over all pixels of a picture.
        ssim: structural similarity of bytes over black.
    """

    psnr: float
    ssim: float


class PictureProbe:
    """Pictures of the key frames of a series, with which decoded ones are compared.

    Attributes:
        task: the task that all pictures are drawn by.
        pictures: float32 (H, W, 4) of the truth at each key frame, multiplied by the opacity.
    """

    def __init__(
        self,
        truth: Sequence[Single],
        feature: str,
        *,
        value_range: Range = (0.0, 1.0),
        size: int = SIZE,
        azimuth: float = 0.0,
    ) -> None:
        """Draw the true pictures.

        Args:
            truth: frames (z, y, x) at the key frames, normalised: 0 and 1 are the ends of
                `value_range`.
            feature: what is shown, as `--feature` takes it, in data units; a segmentation with
                its threshold. Another kind of feature is drawn as all values, more opaque the
                larger they are.
            value_range: least and largest value of the series in data units.
            size: pixels along both sides.
            azimuth: degrees by which the camera is turned from the default view.
        """
        self.task = view_of_feature(
            truth[0].shape,
            feature,
            value_range=value_range,
            size=size,
            camera=_aimed(truth, feature, value_range, azimuth, size),
        )
        self.pictures = [self.draw(frame) for frame in truth]
        self._black = [black(picture) for picture in self.pictures]

    def draw(self, frame: Single) -> Single:
        """Draw a frame (z, y, x) of normalised values; NaN shows nothing."""
        values = np.ascontiguousarray(frame, dtype=np.float32)
        drawn = Frame(values=values, first=(0, 0, 0))
        return march(drawn, self.task, bricks=Bricks.of(drawn)).rgba

    def measure(self, frames: Sequence[Single], masks: Sequence[Mask] | None = None) -> Likeness:
        """Compare decoded frames with the truth.

        Args:
            frames: decoded frames (z, y, x), normalised, one for each key frame.
            masks: vertices (z, y, x) that the encoding was trained on, for each key frame; the
                others show nothing, as in the product. None for all vertices.
        """
        psnr, ssim = [], []
        for number, frame in enumerate(frames):
            shown = frame if masks is None else np.where(masks[number], frame, np.float32(np.nan))
            drawn = self.draw(shown)
            decibels = picture_psnr(
                np.clip(drawn[..., :3], 0, 1), np.clip(self.pictures[number][..., :3], 0, 1), 1.0
            )
            psnr.append(IDENTICAL if decibels is None else min(decibels, IDENTICAL))
            ssim.append(picture_ssim(black(drawn), self._black[number]))
        return Likeness(float(np.mean(psnr)), float(np.mean(ssim)))


def view_of_feature(
    shape: tuple[int, ...],
    feature: str,
    *,
    value_range: Range = (0.0, 1.0),
    size: int = SIZE,
    camera: Camera | None = None,
) -> Task:
    """The task of a picture of normalised values of a shape (z, y, x); arguments as for the probe.

    Vertices are 1 apart along every axis. The camera is the default one if None. Raises InputError
    for a feature that is malformed or shows nothing of the range.
    """
    low, high = value_range
    unit = 1 / (high - low)
    kind = parse_feature(feature)
    function = TransferFunction.of(
        TransferFunctionSpec(), value_range=value_range, spacing=1.0, features=(feature,)
    )
    table: Table | None = None
    surfaces: tuple[Surface, ...] = ()
    if isinstance(kind, Isosurface):
        surfaces = (
            Surface(
                value=(kind.value - low) * unit, colour=function.colour(kind.value), opacity=1.0
            ),
        )
    else:
        first, last, colours, extinctions = function.table()
        table = Table(
            low=(first - low) * unit,
            high=(last - low) * unit,
            colours=colours,
            extinctions=extinctions,
        )
    return Task(
        rays=Rays.of(camera or Camera(), _grid(shape), (size, size)),
        step=STEP,
        threshold=THRESHOLD,
        table=table,
        lighting=LIGHTING if surfaces else None,
        surfaces=surfaces,
    )


def _aimed(
    truth: Sequence[Single], feature: str, value_range: Range, azimuth: float, size: int
) -> Camera:
    """The default camera aimed at a feature in any of the frames, which fills the picture.

    A feature that other values than those of a vertex tell is not looked for: the whole domain
    fills the picture.
    """
    kind, camera = parse_feature(feature), Camera(azimuth=azimuth)
    if not isinstance(kind, Interval | Isosurface | Segmentation):
        return camera
    low, high = value_range
    seen = np.zeros(truth[0].shape, dtype=bool)
    for frame in truth:
        seen |= kind.select(low + frame * (high - low), 0)
    if not seen.any():
        return camera
    places = np.argwhere(seen)[:, ::-1].astype(np.float64)
    x, y, z = ((places.min(axis=0) + places.max(axis=0)) / 2).tolist()
    camera = replace(camera, focal_point=(x, y, z))
    pixels, _ = Rays.of(camera, _grid(truth[0].shape), (size, size)).project(places)
    reach = float(np.abs(2 * pixels / size - 1).max())
    return replace(camera, zoom=FILLED / max(reach, 1e-3))


def _grid(shape: tuple[int, ...]) -> Grid:
    """A grid of vertices (z, y, x) that are 1 apart."""
    z, y, x = shape
    return Grid(counts=(x, y, z), origin=np.zeros(3), spacing=np.ones(3))
