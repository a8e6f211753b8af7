"""Blob: a ball of another value in the medium, such as a bubble or a drop of dye."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.effect import (
    Array,
    Body,
    Effect,
    Place,
    Surface,
    Vector,
    smooth_step,
)

__all__ = ["Blob", "round_surface"]


@dataclass(frozen=True, kw_only=True)
class Blob(Effect):
    """A ball with a smooth edge; as it diffuses, its amount stays what it is."""

    kind: ClassVar[str] = "blob"
    role: ClassVar[str] = "body"
    random: ClassVar[bool] = True

    strength: float = limits(1.0, "value inside, above the background", low=-1e6, high=1e6)
    centre: Vector = limits((0.5, 0.5, 0.5), "middle (z, y, x) in m", low=-1e3, high=1e3)
    radius: float = limits(0.2, "radius in m", low=1e-3, high=1e3)
    edge: float = limits(0.02, "width of the edge in m", low=0, high=1e3)
    jitter: float = limits(0.0, "metres by which the seed moves the middle", low=0, high=1e3)

    def term(self, generator: np.random.Generator, spacing: Vector) -> Body:
        """The body; its place is drawn where it has a jitter."""
        moved = generator.uniform(-1, 1, size=3).tolist()
        z, y, x = (at + self.jitter * shift for at, shift in zip(self.centre, moved, strict=True))

        def surface(place: Place, time: float) -> Surface:
            return round_surface(place, (z, y, x), self.radius)

        def value(distance: Array, widening: Array | float, time: float) -> Array:
            width = np.sqrt(np.float32(self.edge**2 + 1e-12) + widening)
            values = smooth_step(distance, width)
            values *= self._dilution(widening)
            return values

        low, high = sorted((0.0, self.strength))
        return Body(surface=surface, value=value, low=low, high=high, middle=(z, y, x))

    def _dilution(self, widening: Array | float) -> Array:
        """The value that keeps the amount, once the edge is wider.

        A ball with an edge of the width W holds 1 + 3/2 (W / radius)^2 times what a sharp one does.
        """
        share = 1.5 / self.radius**2
        before = 1 + share * self.edge**2
        wider = np.asarray(widening, dtype=np.float32) * np.float32(share / before)
        wider += np.float32(1)
        return np.asarray(np.float32(self.strength) / wider, dtype=np.float32)


def round_surface(place: Place, centre: Vector, radius: float) -> Surface:
    """The surface of a ball; fingers of strength 1 are as long as its radius."""
    z, y, x = (axis - np.float32(at) for axis, at in zip(place, centre, strict=True))
    away = np.sqrt(z * z + y * y + x * x)

    def waves() -> Place:
        inverse = 1 / (away + np.float32(1e-6))
        return z * inverse, y * inverse, x * inverse

    return Surface(distance=away - np.float32(radius), waves=waves, scale=radius)
