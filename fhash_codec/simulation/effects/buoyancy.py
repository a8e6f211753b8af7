"""Buoyancy: light fluid rises as a thermal and rolls up into a ring."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.effect import (
    Effect,
    Flow,
    Place,
    Vector,
)

__all__ = ["Buoyancy"]

SWIRL = 4.0
"""Radians by which the ring turns while it rises by its radius."""


@dataclass(frozen=True, kw_only=True)
class Buoyancy(Effect):
    """A column that rises along z with a vortex ring about it.

    It speeds up with `strength` and then rises at sqrt(strength * radius), the speed at which drag
    balances it: height = radius ln cosh(t sqrt(strength / radius)). The column and the ring keep
    volumes exactly. A negative strength lets heavy fluid sink.
    """

    kind: ClassVar[str] = "buoyancy"
    role: ClassVar[str] = "flow"

    strength: float = limits(1.0, "reduced gravity in m/s^2, upwards", low=-1e3, high=1e3)
    radius: float = limits(0.25, "radius of the ring in m", low=1e-3, high=1e3)
    centre: Vector = limits(
        (0.5, 0.5, 0.5), "middle (z, y, x) of the ring at time 0 in m", low=-1e3, high=1e3
    )

    def height(self, time: float) -> float:
        """Metres that the thermal has risen after some seconds, negative where it sinks."""
        turns = time * math.sqrt(abs(self.strength) / self.radius)
        risen = self.radius * (turns + math.log1p(math.exp(-2 * turns)) - math.log(2))
        return math.copysign(risen, self.strength)

    def term(self, generator: np.random.Generator, spacing: Vector) -> Flow:
        """The flow; it draws no random number."""
        radius = np.float32(self.radius)

        def carry(place: Place, start: float, stop: float) -> Place:
            z, y, x = place
            risen = self.height(stop) - self.height(start)
            middle = self.centre[0] + self.height((start + stop) / 2)
            v, u = y - np.float32(self.centre[1]), x - np.float32(self.centre[2])
            # Areas of (rho^2 / 2 R, z) are volumes, so that a turn in this plane keeps volumes.
            q = (v * v + u * u) / (2 * radius)
            a, b = q - radius / 2, (z - np.float32(middle)) / 2
            weight = np.float32(1) - (a * a + b * b) * np.float32(4 / self.radius**2)
            np.maximum(weight, np.float32(0), out=weight)
            weight *= weight
            weight *= np.float32(SWIRL * risen / self.radius)
            cosine, sine = np.cos(weight), np.sin(weight)
            turned = cosine * a - sine * b
            lifted = sine * a + cosine * b
            # Within the ring q stays positive; rounding must not leave that.
            stretched = np.maximum(turned + radius / 2, np.float32(0))
            ratio = np.sqrt((stretched + np.float32(1e-9)) / (q + np.float32(1e-9)))
            inside = weight != 0
            ratio = np.where(inside, ratio, np.float32(1))
            height = np.where(inside, 2 * lifted + np.float32(middle), z)
            # The column, exp(-(rho / 2 R)^4), carries the ring along.
            stretched /= 2 * radius
            stretched *= stretched
            column = np.exp(-stretched) * np.float32(risen)
            return (
                height - column,
                v * ratio + np.float32(self.centre[1]),
                u * ratio + np.float32(self.centre[2]),
            )

        note = f"{self.strength:g} m/s^2, a ring of {self.radius:g} m"
        return Flow(carry=carry, exact=False, note=note)
