"""Effects of the simulator: what they are, flows, and bodies with a surface."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fhash_codec.records import Record, limits

Array = npt.NDArray[np.float32]
Vector = tuple[float, float, float]
Place = tuple[Array, Array, Array]
"""Positions z, y and x in metres."""
Bend = Callable[[Place, bool, float], Array]
"""(coordinates along a surface, whether they are directions, time) -> outward shift as a share of
the surface's scale."""

AXES = ("z", "y", "x")
"""Names of the axes of a box, as in an array."""
MAX_SPEED = 1e3
"""Largest speed that a scene may ask for, in m/s: float32 still tells vertices apart."""
SLOPE = 2 / math.sqrt(math.pi)
"""Slope of the error function at 0."""
FLAT = 6.0
"""Argument from which on the error function is 1 in float32."""


@dataclass(frozen=True, kw_only=True)
class Effect(Record, ABC):
    """An effect as a scene describes it.

    Attributes:
        kind: name of the effect in scenes.
        role: what it does, `flow`, `body`, `bend` or `spread`.
        random: whether its term draws random numbers.
    """

    kind: ClassVar[str] = ""
    role: ClassVar[str] = ""
    random: ClassVar[bool] = False

    @property
    def idle(self) -> str:
        """Why the effect is not computed; empty where it is."""
        return "its strength is 0" if getattr(self, "strength", 1.0) == 0 else ""

    @abstractmethod
    def term(self, generator: np.random.Generator, spacing: Vector) -> Flow | Body | Bend | float:
        """The term: a Flow, a Body, a Bend, or a diffusivity in m^2/s.

        Args:
            generator: of the random numbers, the effect's own.
            spacing: metres between vertices along z, y and x, 0 along an axis of one vertex.
        """


@dataclass(frozen=True, kw_only=True)
class Flow:
    """The term of an effect that carries the medium.

    Attributes:
        carry: (place, start, stop) -> where parcels were at `start`, in seconds, that are at
            `place` at `stop`.
        rigid: whether distances stay what they are.
        exact: whether one call for a long time equals many for its parts.
        note: what is computed, for `--explain`.
    """

    carry: Callable[[Place, float, float], Place]
    rigid: bool = False
    exact: bool = True
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A body's surface seen from some places.

    Attributes:
        distance: signed distance in metres, negative inside.
        waves: coordinates along the surface that fingers stand on: directions from the middle of a
            round body, or positions in units of a finger's spacing.
        scale: metres of a finger of strength 1.
    """

    distance: Array
    waves: Callable[[], Place]
    scale: float


@dataclass(frozen=True, kw_only=True)
class Body:
    """The term of an effect that has a surface.

    Attributes:
        surface: (place, time) -> the surface.
        value: (distance, widening, time) -> value at that distance. The widening is the square of
            what diffusion and the distance of vertices add to the width of the surface, in m^2.
        low: least value that it can add.
        high: largest value that it can add.
        middle: point from which directions say where fingers stand; None where positions do.
    """

    surface: Callable[[Place, float], Surface]
    value: Callable[[Array, Array | float, float], Array]
    low: float
    high: float
    middle: Vector | None = None


def smooth_step(distance: Array, width: Array | float) -> Array:
    """A step from 1 where the distance is negative to 0: erfc(distance / width) / 2.

    erf(u) is tanh(2 / sqrt(pi) * (u + 11/123 u^3)) to 4e-4 (Abramowitz's table).
    """
    scaled = np.asarray(distance / width, dtype=np.float32)
    np.clip(scaled, np.float32(-FLAT), np.float32(FLAT), out=scaled)
    cubed = scaled * scaled
    cubed *= np.float32(-SLOPE * 11 / 123)
    cubed -= np.float32(SLOPE)
    scaled *= cubed
    np.tanh(scaled, out=scaled)
    scaled *= np.float32(0.5)
    scaled += np.float32(0.5)
    return scaled


def direction_of(vector: Vector) -> Vector | None:
    """The unit vector of a direction; None for a vector of zeros."""
    length = math.sqrt(sum(part * part for part in vector))
    return None if length == 0 else tuple(part / length for part in vector)  # type: ignore[return-value]


def axis_last(axis: str) -> tuple[int, int, int]:
    """Numbers of the two axes that turn about an axis, and that of the axis itself.

    Their order is cyclic, x to y to z, so that positive angles turn anticlockwise seen from the
    axis' end.
    """
    return {"z": (2, 1, 0), "y": (0, 2, 1), "x": (1, 0, 2)}[axis]


def times(place: Place, vector: Vector) -> Array:
    """The dot product of positions and a vector; parts that are 0 are left out."""
    parts = [axis * np.float32(part) for axis, part in zip(place, vector, strict=True) if part != 0]
    if not parts:
        return np.zeros((1, 1, 1), dtype=np.float32)
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


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
