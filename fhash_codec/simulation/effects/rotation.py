"""Rotation: the whole medium turns about an axis as a solid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.effect import (
    AXES,
    Effect,
    Flow,
    Place,
    Vector,
    axis_last,
)

__all__ = ["Rotation"]


@dataclass(frozen=True, kw_only=True)
class Rotation(Effect):
    """A rotation of everything, anticlockwise seen from the end of the axis."""

    kind: ClassVar[str] = "rotation"
    role: ClassVar[str] = "flow"

    strength: float = limits(1.0, "angular speed in rad/s", low=-1e3, high=1e3)
    axis: str = limits("z", "axis to turn about", choices=AXES)
    centre: Vector = limits(
        (0.5, 0.5, 0.5), "a point (z, y, x) of the axis in m", low=-1e3, high=1e3
    )

    def term(self, generator: np.random.Generator, spacing: Vector) -> Flow:
        """The flow; it draws no random number."""
        first, second, fixed = axis_last(self.axis)

        def carry(place: Place, start: float, stop: float) -> Place:
            angle = -self.strength * (stop - start)
            cosine, sine = np.float32(math.cos(angle)), np.float32(math.sin(angle))
            u = place[first] - np.float32(self.centre[first])
            v = place[second] - np.float32(self.centre[second])
            moved = {
                first: cosine * u - sine * v + np.float32(self.centre[first]),
                second: sine * u + cosine * v + np.float32(self.centre[second]),
                fixed: place[fixed],
            }
            return moved[0], moved[1], moved[2]

        return Flow(carry=carry, rigid=True, note=f"{self.strength:g} rad/s about {self.axis}")
