"""Turbulence: eddies of all sizes, each a shear wave, with the speeds of Kolmogorov's spectrum."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.effect import (
    Array,
    Effect,
    Flow,
    Place,
    Vector,
)

__all__ = ["Turbulence"]

VERTICES_OF_A_WAVE = 3.0
"""Vertices that a wave must be long at least, to be computed."""


@dataclass(frozen=True, kw_only=True)
class Turbulence(Effect):
    """Random eddies: kinematic turbulence, without an equation for the momentum.

    A wave moves parcels along one axis by a sine of the two others. So each keeps volumes exactly,
    and they fold and stretch the medium together (Pierrehumbert 1994). Waves of half the length
    are slower by 2^(1/3) (Kolmogorov 1941). Waves that the lattice cannot show are left out.
    """

    kind: ClassVar[str] = "turbulence"
    role: ClassVar[str] = "flow"
    random: ClassVar[bool] = True

    strength: float = limits(0.2, "speed of the largest eddies in m/s", low=0, high=100)
    scale: float = limits(0.3, "length of the largest eddies in m", low=1e-3, high=1e3)
    octaves: int = limits(4, "sizes of eddies, each half of the one before", low=1, high=10)
    waves: int = limits(1, "waves of each size along each axis", low=1, high=8)

    def term(self, generator: np.random.Generator, spacing: Vector) -> Flow:
        """The flow; spacing: metres between vertices along z, y and x, 0 for a single one."""
        waves = self._drawn(generator)
        resolved = [wave for wave in waves if _shown(wave[0], wave[1], spacing)]

        def carry(place: Place, start: float, stop: float) -> Place:
            shape = np.broadcast_shapes(*(axis.shape for axis in place))
            moved = [np.array(np.broadcast_to(axis, shape)) for axis in place]
            phases: Array = np.empty(shape, dtype=np.float32)
            other: Array = np.empty(shape, dtype=np.float32)
            middle = (start + stop) / 2
            for axis, (first, second), phase, length, share in resolved:
                speed = self.strength * share
                a, b = (number for number in range(3) if number != axis)
                np.multiply(moved[a], np.float32(first), out=phases)
                np.multiply(moved[b], np.float32(second), out=other)
                phases += other
                # An eddy turns over in the time that its own speed takes along its length.
                phases += np.float32(math.remainder(phase + speed / length * middle, math.tau))
                np.sin(phases, out=phases)
                phases *= np.float32(speed * (stop - start))
                moved[axis] -= phases
            return moved[0], moved[1], moved[2]

        left_out = len(waves) - len(resolved)
        note = f"{len(resolved)} waves from {self.scale:g} m down"
        if left_out:
            note += f"; {left_out} shorter than {VERTICES_OF_A_WAVE:g} vertices are left out"
        return Flow(carry=carry, exact=False, note=note)

    def _drawn(
        self, generator: np.random.Generator
    ) -> list[tuple[int, tuple[float, float], float, float, float]]:
        """Waves from the longest: axis of motion, wave numbers along the others, phase, length in
        m, and speed as a share of the strength."""
        drawn = []
        for octave in range(self.octaves):
            for _ in range(self.waves):
                for axis in range(3):
                    heading, phase = generator.uniform(0, math.tau, size=2).tolist()
                    length = self.scale / 2**octave
                    number = math.tau / length
                    both = number * math.cos(heading), number * math.sin(heading)
                    drawn.append((axis, both, phase, length, 2 ** (-octave / 3)))
        return drawn


def _shown(axis: int, numbers: tuple[float, float], spacing: Vector) -> bool:
    """Whether the lattice shows a wave that moves parcels along an axis, of some wave numbers."""
    others = (step for number, step in enumerate(spacing) if number != axis)
    return all(
        abs(number) * step * VERTICES_OF_A_WAVE <= math.tau
        for number, step in zip(numbers, others, strict=True)
    )
