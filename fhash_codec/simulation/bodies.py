"""Effects with a surface (blob, front, shell) and those that change it (fingers, diffusion)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.records import limits
from fhash_codec.simulation.effect import (
    MAX_SPEED,
    Array,
    Bend,
    Body,
    Effect,
    Place,
    Surface,
    Vector,
    direction_of,
    smooth_step,
    times,
)


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
