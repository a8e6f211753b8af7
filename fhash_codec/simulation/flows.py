"""Effects that carry the medium: advection, rotation, vortex, turbulence, buoyancy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fhash_codec.records import limits
from fhash_codec.simulation.effect import (
    AXES,
    MAX_SPEED,
    Array,
    Effect,
    Flow,
    Place,
    Vector,
    axis_last,
    direction_of,
)


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


@dataclass(frozen=True, kw_only=True)
class Rotation(Effect):
    """A rotation of everything, anticlockwise seen from the end of the axis."""

    kind: ClassVar[str] = "rotation"
    role: ClassVar[str] = "flow"

    strength: float = limits(1.0, "angular speed in rad/s", low=-1e3, high=1e3)
    axis: str = limits("z", "axis to turn about", choices=AXES)
    centre: Vector = limits(
        (0.5, 0.5, 0.5), "a point (z, y, x) of the axis in m", low=-1e3, high=1e3
    )

    def term(self, generator: np.random.Generator, spacing: Vector) -> Flow:
        """The flow; it draws no random number."""
        first, second, fixed = axis_last(self.axis)

        def carry(place: Place, start: float, stop: float) -> Place:
            angle = -self.strength * (stop - start)
            cosine, sine = np.float32(math.cos(angle)), np.float32(math.sin(angle))
            u = place[first] - np.float32(self.centre[first])
            v = place[second] - np.float32(self.centre[second])
            moved = {
                first: cosine * u - sine * v + np.float32(self.centre[first]),
                second: sine * u + cosine * v + np.float32(self.centre[second]),
                fixed: place[fixed],
            }
            return moved[0], moved[1], moved[2]

        return Flow(carry=carry, rigid=True, note=f"{self.strength:g} rad/s about {self.axis}")


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
