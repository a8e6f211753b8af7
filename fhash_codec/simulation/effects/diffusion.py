"""Diffusion: surfaces become wider as time passes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.rendering.scene.record import limits
from fhash_codec.simulation.effects.effect import Effect, Vector

__all__ = ["Diffusion"]


@dataclass(frozen=True, kw_only=True)
class Diffusion(Effect):
    """Diffusion of what bodies hold into the medium.

    A plane step becomes an error function of width sqrt(4 D t), the solution of the equation of
    heat. Where flows draw the medium out, surfaces are nearer to each other by the same factor and
    mix sooner: the width counts in the stretched medium.
    """

    kind: ClassVar[str] = "diffusion"
    role: ClassVar[str] = "spread"

    strength: float = limits(1e-3, "diffusivity D in m^2/s", low=0, high=1e3)

    def term(self, generator: np.random.Generator, spacing: Vector) -> float:
        """The diffusivity; it draws no random number."""
        return self.strength
