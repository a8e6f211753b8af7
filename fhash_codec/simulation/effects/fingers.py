"""Fingers: the surfaces of bodies grow spikes, as where dense fluid pushes light fluid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.effect import (
    Array,
    Bend,
    Effect,
    Place,
    Vector,
    times,
)

__all__ = ["Fingers"]

SHARPNESS = 3.0
"""Steepness of a finger's flank."""
ONSET = 0.8
"""Height of the random waves, in their standard deviation, from which on there is a finger."""
MEAN = 0.25
"""Share of a surface with fingers, about: what stands between them draws back by so much."""


@dataclass(frozen=True, kw_only=True)
class Fingers(Effect):
    """Fingers on the surface of every body of the scene, which grow to `strength` and stay there.

    A sum of random waves along the surface says where they are.
    """

    kind: ClassVar[str] = "fingers"
    role: ClassVar[str] = "bend"
    random: ClassVar[bool] = True

    strength: float = limits(
        0.2, "length as a share of a body's radius, or in m for a front", low=-10, high=10
    )
    count: float = limits(
        12.0, "waves around a round body, or in a metre of a front", low=0.1, high=1e3
    )
    growth: float = limits(0.5, "seconds in which they grow", low=1e-3, high=1e6)
    waves: int = limits(10, "random waves that are added up", low=3, high=64)

    def term(self, generator: np.random.Generator, spacing: Vector) -> Bend:
        """The shift of surfaces; the waves are drawn."""
        vectors = generator.normal(size=(self.waves, 3))
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        phases = generator.uniform(0, math.tau, size=self.waves).tolist()
        directions: list[list[float]] = vectors.tolist()

        def bend(waves: Place, curved: bool, time: float) -> Array:
            number = self.count * (1 if curved else math.tau)
            total: Array | None = None
            for (z, y, x), phase in zip(directions, phases, strict=True):
                wave = times(waves, (z * number, y * number, x * number))
                wave += np.float32(phase)
                np.cos(wave, out=wave)
                total = wave if total is None else np.add(total, wave, out=total)
            assert total is not None
            total *= np.float32(SHARPNESS / 2 / math.sqrt(self.waves / 2))
            total -= np.float32(SHARPNESS / 2 * ONSET)
            np.tanh(total, out=total)
            total *= np.float32(0.5)
            total += np.float32(0.5 - MEAN)
            total *= np.float32(self.strength * math.tanh(time / self.growth))
            return total

        return bend
