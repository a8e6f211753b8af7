"""Vortex: a swirl that is fastest at its core's edge (Lamb and Oseen)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.effect import (
    AXES,
    MAX_SPEED,
    Effect,
    Flow,
    Place,
    Vector,
    axis_last,
)

__all__ = ["Vortex"]

CORE = 1.2564312
"""Number a for which (1 - exp(-a q)) / sqrt(q) is largest at q = 1."""
PEAK = 1.3979526
"""Inverse of that largest value."""


@dataclass(frozen=True, kw_only=True)
class Vortex(Effect):
    """A vortex with a straight axis; parcels circle about it and keep their distance to it.

    The speed at distance r is strength * 1.398 (R / r) (1 - exp(-1.256 r^2 / R^2)).
    """

    kind: ClassVar[str] = "vortex"
    role: ClassVar[str] = "flow"

    strength: float = limits(
        1.0, "largest speed in m/s, anticlockwise", low=-MAX_SPEED, high=MAX_SPEED
    )
    radius: float = limits(0.2, "radius R of the core in m", low=1e-3, high=1e3)
    axis: str = limits("z", "direction of the axis", choices=AXES)
    centre: Vector = limits(
        (0.5, 0.5, 0.5), "a point (z, y, x) of the axis in m", low=-1e3, high=1e3
    )

    def term(self, generator: np.random.Generator, spacing: Vector) -> Flow:
        """The flow; it draws no random number."""
        first, second, fixed = axis_last(self.axis)
        inverse = np.float32(1 / self.radius)

        def carry(place: Place, start: float, stop: float) -> Place:
            turns = -self.strength / self.radius * PEAK * (stop - start)
            u = (place[first] - np.float32(self.centre[first])) * inverse
            v = (place[second] - np.float32(self.centre[second])) * inverse
            q = u * u + v * v
            q += np.float32(1e-6)
            angle = np.exp(q * np.float32(-CORE))
            np.subtract(np.float32(1), angle, out=angle)
            angle /= q
            angle *= np.float32(turns)
            cosine, sine = np.cos(angle), np.sin(angle)
            radius = np.float32(self.radius)
            moved = {
                first: (cosine * u - sine * v) * radius + np.float32(self.centre[first]),
                second: (sine * u + cosine * v) * radius + np.float32(self.centre[second]),
                fixed: place[fixed],
            }
            return moved[0], moved[1], moved[2]

        return Flow(carry=carry, note=f"{abs(self.strength):g} m/s about {self.axis}")
