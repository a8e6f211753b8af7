"""The plan of a picture: one task for any marcher, and the reasons for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.rendering.colour.transfer_function import TransferFunction
from fhash_codec.rendering.picture.layout import Layout
from fhash_codec.rendering.scene.scene import AmbientOcclusion, Scene, Shadows
from fhash_codec.rendering.task.task import Task
from fhash_codec.rendering.task.units import Units

__all__ = ["Plan"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """Every decision that is made before the first ray; `planning.plan_picture` makes it.

    Attributes:
        scene: as given.
        layout: places of everything in the picture, and the part that shows the volume.
        task: what is marched, in that part. Its `light` is still missing: where `shadows` or
            `occlusion` ask for light, it is computed from the decoded frame.
        step: of the series; fractional between two steps.
        time: physical time.
        mode: 'cache', 'arm' or 'stream'.
        why_mode: reason why 'auto' took the mode, for people; empty where the scene names it.
        lod: level of detail, 0 for the finest.
        why_lod: reason for the level, for people.
        region: part of the domain (z, y, x) that is decoded.
        function: the transfer function.
        units: of the marched values.
        shadows: settings of the shadows, or None without shadows.
        occlusion: settings of the ambient occlusion, or None without it.
        lamp: unit vector (x, y, z) towards the light; None for the camera's light.
        reasons: (topic, what is done and why), for people.
    """

    scene: Scene
    layout: Layout
    task: Task
    step: float
    time: float
    mode: str
    why_mode: str
    lod: int
    why_lod: str
    region: Box
    function: TransferFunction
    units: Units
    shadows: Shadows | None
    occlusion: AmbientOcclusion | None
    lamp: npt.NDArray[np.float64] | None
    reasons: tuple[tuple[str, str], ...] = ()

    @property
    def lights(self) -> bool:
        """Whether light is computed before the rays are marched."""
        return self.shadows is not None or self.occlusion is not None

    def to_dict(self) -> dict[str, str]:
        """JSON values: the reasons by topic."""
        return dict(self.reasons)
