"""Front: a plane that moves, with another value behind it, or a sheet of some depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.effect import (
    MAX_SPEED,
    Array,
    Body,
    Effect,
    Place,
    Surface,
    Vector,
    direction_of,
    smooth_step,
    times,
)

__all__ = ["Front"]


@dataclass(frozen=True, kw_only=True)
class Front(Effect):
    """A plane front, such as a shock, a flame or one side of a jet.

    It moves through the medium at its own speed, whatever the medium does.
    """

    kind: ClassVar[str] = "front"
    role: ClassVar[str] = "body"

    strength: float = limits(1.0, "value behind it, above the background", low=-1e6, high=1e6)
    direction: Vector = limits(
        (0.0, 0.0, 1.0), "direction (z, y, x) of its motion, of any length", low=-1e6, high=1e6
    )
    start: float = limits(
        0.2, "place at time 0 along the direction, in m from the origin", low=-1e3, high=1e3
    )
    speed: float = limits(0.5, "speed in m/s", low=-MAX_SPEED, high=MAX_SPEED)
    width: float = limits(0.02, "width of the front in m", low=0, high=1e3)
    depth: float = limits(
        0.0, "metres behind it in which the value stands; 0 for all of it", low=0, high=1e3
    )

    @property
    def idle(self) -> str:
        """The reason not to compute it: no strength or no direction."""
        return "its direction is 0" if direction_of(self.direction) is None else super().idle

    def term(self, generator: np.random.Generator, spacing: Vector) -> Body:
        """The body; it draws no random number."""
        unit = direction_of(self.direction) or (0.0, 0.0, 1.0)

        def surface(place: Place, time: float) -> Surface:
            distance = times(place, unit) - np.float32(self.start + self.speed * time)
            return Surface(distance=distance, waves=lambda: place, scale=1.0)

        def value(distance: Array, widening: Array | float, time: float) -> Array:
            width = np.sqrt(np.float32(self.width**2 + 1e-12) + widening)
            behind = smooth_step(distance, width)
            if self.depth:
                behind -= smooth_step(distance + np.float32(self.depth), width)
                # Rounding may leave less than nothing between the two sides.
                np.maximum(behind, np.float32(0), out=behind)
            behind *= np.float32(self.strength)
            return behind

        low, high = sorted((0.0, self.strength))
        return Body(surface=surface, value=value, low=low, high=high)
