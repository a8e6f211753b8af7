"""Shell: what a blast has swept up, a sphere that grows as Sedov and Taylor found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.blob import round_surface
from fhash_codec.simulation.effects.effect import (
    Array,
    Body,
    Effect,
    Place,
    Surface,
    Vector,
    smooth_step,
)

__all__ = ["Shell"]


@dataclass(frozen=True, kw_only=True)
class Shell(Effect):
    """A dense shell of radius `radius` * ((t + age) / (1 s + age))^(2/5).

    Its value falls off inwards by exp(-depth / thickness), and weakens as the shell grows.
    """

    kind: ClassVar[str] = "shell"
    role: ClassVar[str] = "body"

    strength: float = limits(1.0, "value of the shell after 1 s", low=-1e6, high=1e6)
    centre: Vector = limits((0.5, 0.5, 0.5), "middle (z, y, x) in m", low=-1e3, high=1e3)
    radius: float = limits(0.4, "radius in m after 1 s", low=1e-3, high=1e3)
    age: float = limits(0.15, "seconds since the blast at time 0", low=1e-3, high=1e6)
    thickness: float = limits(0.06, "depth in m of a fall to 1/e", low=1e-3, high=1e3)
    weakening: float = limits(
        0.25, "power of time by which the value weakens; 0 for not at all", low=0, high=2
    )

    def grown(self, time: float) -> float:
        """The radius in m at a time in seconds."""
        return float(self.radius * ((time + self.age) / (1 + self.age)) ** 0.4)

    def level(self, time: float) -> float:
        """The value of the shell at a time in seconds."""
        return float(self.strength * ((time + self.age) / (1 + self.age)) ** -self.weakening)

    def term(self, generator: np.random.Generator, spacing: Vector) -> Body:
        """The body; it draws no random number."""

        def surface(place: Place, time: float) -> Surface:
            return round_surface(place, self.centre, self.grown(time))

        def value(distance: Array, widening: Array | float, time: float) -> Array:
            # A young shell is thinner, as its radius is smaller.
            thickness = self.thickness * self.grown(time) / self.radius
            outside = smooth_step(distance, np.sqrt(np.float32((thickness / 4) ** 2) + widening))
            deep = np.sqrt(np.float32(thickness**2) + widening)
            inside = np.exp(np.minimum(distance, np.float32(0)) / deep)
            inside *= outside
            inside *= np.float32(self.level(time))
            return inside

        low, high = sorted((0.0, self.level(0.0)))
        return Body(surface=surface, value=value, low=low, high=high, middle=self.centre)
