"""An effect is a record of settings that makes a pure term; there are four kinds of terms.

- A `Flow` carries parcels of the medium: it says where a parcel was a moment ago.
- A `Body` is something with a surface: it says how far a place is from the surface, and which value
  stands there.
- A bend (`fingers`) moves the surfaces of all bodies, and a spread (`diffusion`) widens them.

Terms depend on nothing but their arguments. Arrays are float32 in metres, broadcastable against
each other: what does not depend on an axis has length 1 along it, and costs as little.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fhash_codec.records import Record

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
