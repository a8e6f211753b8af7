"""Advection: the whole medium moves at one velocity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.effect import (
    MAX_SPEED,
    Effect,
    Flow,
    Place,
    Vector,
    direction_of,
)

__all__ = ["Advection"]


@dataclass(frozen=True, kw_only=True)
class Advection(Effect):
    """A wind of one velocity everywhere."""

    kind: ClassVar[str] = "advection"
    role: ClassVar[str] = "flow"

    strength: float = limits(0.2, "speed in m/s", low=-MAX_SPEED, high=MAX_SPEED)
    direction: Vector = limits(
        (0.0, 0.0, 1.0), "direction (z, y, x), of any length", low=-1e6, high=1e6
    )

    @property
    def idle(self) -> str:
        """The reason not to compute it: no strength or no direction."""
        return "its direction is 0" if direction_of(self.direction) is None else super().idle

    def term(self, generator: np.random.Generator, spacing: Vector) -> Flow:
        """The flow; it draws no random number."""
        unit = direction_of(self.direction) or (0.0, 0.0, 0.0)

        def carry(place: Place, start: float, stop: float) -> Place:
            way = self.strength * (stop - start)
            z, y, x = (
                axis if part == 0 else axis - np.float32(way * part)
                for axis, part in zip(place, unit, strict=True)
            )
            return z, y, x

        return Flow(carry=carry, rigid=True, note=f"{abs(self.strength):g} m/s")
