"""Simulation of a scene: every value from its position and time alone, and what was computed."""

from __future__ import annotations

import math
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
import numpy.typing as npt

from fhash_codec.simulation.effects import Array, Bend, Body, Flow, Place, Surface, Vector
from fhash_codec.simulation.scene import EFFECTS, SimulatedScene, scene_of
from fhash_formats.errors import InputError
from fhash_formats.series import AXIS_NAMES, Coordinate, Series
from fhash_formats.support.threads import ForkLock, in_threads


@dataclass(kw_only=True)
class Terms:
    """The terms of a scene, each with the number of its effect in the scene's list.

    Attributes:
        flows: what carries the medium, in the order of the scene.
        bodies: what has a surface.
        bends: what moves surfaces outwards.
        diffusivity: sum of the diffusivities in m^2/s.
        spreads: numbers of the effects that the diffusivity comes from.
        idle: number of each effect without a term, and why it has none.
        spacing: metres between vertices along z, y and x, 0 along an axis of one vertex.
    """

    flows: list[tuple[int, Flow]] = field(default_factory=list)
    bodies: list[tuple[int, Body]] = field(default_factory=list)
    bends: list[tuple[int, Bend]] = field(default_factory=list)
    diffusivity: float = 0.0
    spreads: list[int] = field(default_factory=list)
    idle: dict[int, str] = field(default_factory=dict)
    spacing: Vector = (0.0, 0.0, 0.0)

    @property
    def sheared(self) -> bool:
        """Whether a flow changes distances."""
        return not all(flow.rigid for _, flow in self.flows)

    @property
    def stretched(self) -> bool:
        """Whether distances to a surface may differ from those in the box."""
        return bool(self.bends) or self.sheared

    @property
    def exact(self) -> bool:
        """Whether one part of the time gives what many would: no flow, or one that is exact."""
        return not self.flows or (len(self.flows) == 1 and self.flows[0][1].exact)


def terms_of(scene: SimulatedScene, seed: int) -> Terms:
    """Make the terms of a scene.

    An effect draws its random numbers from the seed, its kind and its number among the effects of
    this kind that are computed. So an effect of strength 0 changes those of no other.
    """
    z, y, x = (
        length / count if count > 1 else 0.0
        for length, count in zip(scene.size, scene.shape, strict=True)
    )
    terms = Terms(spacing=(z, y, x))
    bodies = any(effect.role == "body" and not effect.idle for effect in scene.effects)
    counts: Counter[str] = Counter()
    for number, effect in enumerate(scene.effects):
        reason = effect.idle or ("" if bodies else "the scene has no body, so nothing shows it")
        if reason:
            terms.idle[number] = reason
            continue
        counts[effect.kind] += 1
        key = [seed, zlib.crc32(effect.kind.encode()), counts[effect.kind]]
        term = effect.term(np.random.default_rng(key), terms.spacing)
        if isinstance(term, Flow):
            terms.flows.append((number, term))
        elif isinstance(term, Body):
            terms.bodies.append((number, term))
        elif isinstance(term, float):
            terms.diffusivity += term
            terms.spreads.append(number)
        else:
            terms.bends.append((number, term))
    return terms


Block = tuple[slice, slice, slice]
Shifts = dict[tuple[int, Vector | None], Array]

BLOCK_VERTICES = 2**15
"""Vertices that are computed at once, about: their arrays fit into a processor's cache."""
MAX_FRAME_VERTICES = 2**31
"""Most vertices of a frame, of which one is held in memory."""
KEPT_BYTES = 24 * 2**20
"""Bytes of an array that is made and freed before a frame: the C library then keeps that much
memory for the arrays of blocks, where it would give it back to the system after each of them."""
MAX_SEED = 2**32 - 1
"""Largest seed."""
VERTEX_WIDTH = 0.7
"""Width of a sharp surface as a share of the change of distance between vertices."""
MAX_WIDENING = 1e30
"""Largest square of a width in m^2: float32 holds it."""


@dataclass
class Counters:
    """Counts of what was computed so far.

    Attributes:
        frames: frames computed.
        vertices: vertices of these frames.
        places: places that were looked at for them, those beside blocks included.
        parts: parts of the time over all frames, in each of which every flow acts.
        evaluations: places for which each effect was computed, by its number in the scene.
        stretches: places at which the change of a distance between vertices was computed.
    """

    frames: int = 0
    vertices: int = 0
    places: int = 0
    parts: int = 0
    evaluations: Counter[int] = field(default_factory=Counter)
    stretches: int = 0


class Simulation(Series):
    """A scene as a series (t, z, y, x) of float32, computed as its frames are asked for.

    A frame is the same in whatever order frames are read, and whatever the number of threads.

    Attributes:
        scene: what is simulated.
        seed: of the random numbers.
        terms: of the scene's effects.
        counters: of what was computed so far.

    Raises InputError for a seed or shape that is not allowed.
    """

    def __init__(self, scene: SimulatedScene, seed: int = 0) -> None:
        if not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
            raise InputError(f"seed is {seed}; allowed: 0 to {MAX_SEED}")
        if math.prod(scene.shape) > MAX_FRAME_VERTICES:
            raise InputError(
                f"shape is {scene.shape} in (z, y, x), {math.prod(scene.shape)} vertices; a frame"
                f" may have {MAX_FRAME_VERTICES}"
            )
        self.scene, self.seed = scene, seed
        self.terms: Terms = terms_of(scene, seed)
        self.counters = Counters()
        self.source, self.name, self.units = "simulation", scene.name, scene.units
        self.dtype = np.dtype(np.float32)
        self.shape = (scene.steps, *scene.shape)
        self.attributes: Mapping[str, Any] = {}
        self.coords = _coordinates(scene)
        self._centres = [self.coords[axis].values.astype(np.float32) for axis in ("z", "y", "x")]
        self._lock = ForkLock()

    @property
    def bounds(self) -> tuple[float, float]:
        """Numbers that no value is below or above, but for rounding."""
        low = sum(body.low for _, body in self.terms.bodies)
        high = sum(body.high for _, body in self.terms.bodies)
        return self.scene.background + low, self.scene.background + high

    def parts(self, time: float) -> int:
        """Parts into which the time from 0 s is cut for the flows; 0 where none acts."""
        if not self.terms.flows or time == 0:
            return 0
        return 1 if self.terms.exact else self.scene.splits

    def read(self, step: int) -> npt.NDArray[np.float32]:
        self.require_step(step)
        time = float(self.coords["t"].values[step])
        frame: Array = np.empty(self.scene.shape, dtype=np.float32)
        np.empty(KEPT_BYTES, dtype=np.uint8)

        def compute(block: Block) -> Counters:
            counters = Counters()
            frame[block] = self._values(block, time, counters)
            return counters

        done = list(in_threads(compute, blocks(self.scene.shape)))
        with self._lock:
            self._count(done, self.parts(time))
        return frame

    def _count(self, done: list[Counters], parts: int) -> None:
        """Add what the blocks of a frame took to the counters."""
        self.counters.frames += 1
        self.counters.vertices += math.prod(self.scene.shape)
        self.counters.parts += parts
        for counters in done:
            self.counters.places += counters.places
            self.counters.stretches += counters.stretches
            self.counters.evaluations += counters.evaluations

    def _values(self, block: Block, time: float, counters: Counters) -> Array:
        """The values of a block; a last layer beside it shows how distances change."""
        terms, shape = self.terms, tuple(part.stop - part.start for part in block)
        values: Array = np.full(shape, self.scene.background, dtype=np.float32)
        if not terms.bodies:
            return values
        extended = tuple(
            n + 1 if terms.stretched and total > 1 else n
            for n, total in zip(shape, self.scene.shape, strict=True)
        )
        core = tuple(slice(n) for n in shape)
        counters.places += math.prod(extended)
        place = self._carried(self._places(block, extended), time, counters)
        stretch = None
        if terms.sheared:
            nothing: Array = np.zeros(shape, dtype=np.float32)
            stretch = self._stretch(place, shape, extended, counters, (nothing, nothing))
        shifts: Shifts = {}
        for number, body in terms.bodies:
            surface = body.surface(place, time)
            counters.evaluations[number] += surface.distance.size
            distance = self._bent(surface, body, time, shifts, counters)
            widths = stretch
            if terms.bends:
                widths = self._stretch((distance,), shape, extended, counters, stretch)
            distance = np.broadcast_to(distance, extended)[core]
            values += body.value(distance, self._widening(widths, time, counters), time)
        return values

    def _places(self, block: Block, extended: tuple[int, ...]) -> Place:
        """Positions of the vertices of a block, and of those right behind it."""
        lines = []
        for axis, (part, count) in enumerate(zip(block, extended, strict=True)):
            line = self._centres[axis][part]
            if count > line.size:
                # The vertex behind the box is one like any other.
                after = line[-1] + np.float32(self.terms.spacing[axis])
                line = np.append(line, after).astype(np.float32)
            lines.append(line)
        z, y, x = np.ix_(*lines)
        return z, y, x

    def _carried(self, place: Place, time: float, counters: Counters) -> Place:
        """The places from which the flows brought the medium since 0 s."""
        parts = self.parts(time)
        for part in range(parts, 0, -1):
            start, stop = time * (part - 1) / parts, time * part / parts
            for number, flow in reversed(self.terms.flows):
                place = flow.carry(place, start, stop)
                counters.evaluations[number] += max(axis.size for axis in place)
        return place

    def _bent(
        self, surface: Surface, body: Body, time: float, shifts: Shifts, counters: Counters
    ) -> Array:
        """The distance to the surface with its fingers.

        shifts: those computed so far; bodies with one middle have the same.
        """
        distance = surface.distance
        for number, bend in self.terms.bends if time > 0 else ():
            key = number, body.middle
            if key not in shifts:
                shifts[key] = bend(surface.waves(), body.middle is not None, time)
                counters.evaluations[number] += shifts[key].size
            distance = distance - shifts[key] * np.float32(surface.scale)
        return distance

    def _stretch(
        self,
        parts: Sequence[Array],
        shape: tuple[int, ...],
        extended: tuple[int, ...],
        counters: Counters,
        least: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array]:
        """Squares of the largest change of `parts` to a vertex behind, in m^2 and per m.

        parts: arrays whose changes are the legs of a right angle, such as z, y and x.
        least: squares that the result has at least; those of a medium at rest if left out.
        """
        core = tuple(slice(n) for n in shape)
        if least is None:
            still = np.float32(max(self.terms.spacing) ** 2)
            least = np.full(shape, still), np.ones(shape, dtype=np.float32)
        change, steepest = least
        counters.stretches += math.prod(shape)
        for axis, step in enumerate(self.terms.spacing):
            if step == 0:
                continue
            behind = list(core)
            behind[axis] = slice(1, shape[axis] + 1)
            total: Array | None = None
            for part in parts:
                whole = np.broadcast_to(part, extended)
                square = whole[tuple(behind)] - whole[core]
                square *= square
                total = square if total is None else np.add(total, square, out=total)
            assert total is not None
            change = np.maximum(change, total)
            total *= np.float32(1 / step**2)
            steepest = np.maximum(steepest, total)
        return change, steepest

    def _widening(
        self, stretch: tuple[Array, Array] | None, time: float, counters: Counters
    ) -> Array | float:
        """The square of what diffusion and the distance of vertices add to a surface's width.

        Where the medium is drawn out evenly in time to g times its length, diffusion acts on the
        mean of g^2 over that time, 2/3 + g^2 / 3.
        """
        spread, vertex = 4 * self.terms.diffusivity * time, VERTEX_WIDTH**2
        if spread:
            for number in self.terms.spreads:
                counters.evaluations[number] += 1 if stretch is None else stretch[0].size
        if stretch is None:
            return min(vertex * max(self.terms.spacing) ** 2 + spread, MAX_WIDENING)
        change, steepest = stretch
        widening: Array = change * np.float32(vertex)
        if spread:
            widening += steepest * np.float32(spread / 3)
            widening += np.float32(spread * 2 / 3)
        np.minimum(widening, np.float32(MAX_WIDENING), out=widening)
        return widening


def blocks(shape: tuple[int, int, int]) -> list[Block]:
    """Blocks of about BLOCK_VERTICES that cover a frame; x is cut last, since it lies together."""
    x = min(shape[2], BLOCK_VERTICES)
    rows = max(1, BLOCK_VERTICES // x)
    y = min(shape[1], max(1, math.isqrt(rows)))
    z = min(shape[0], max(1, rows // y))
    y = min(shape[1], max(1, rows // z))
    return [
        (
            slice(a, min(a + z, shape[0])),
            slice(b, min(b + y, shape[1])),
            slice(c, min(c + x, shape[2])),
        )
        for a in range(0, shape[0], z)
        for b in range(0, shape[1], y)
        for c in range(0, shape[2], x)
    ]


def simulate(
    scene: str | Path | Mapping[str, Any] | SimulatedScene,
    shape: tuple[int, int, int, int] | None = None,
    seed: int = 0,
) -> Simulation:
    """Simulate a scene as a series (t, z, y, x) of float32, with time in s and positions in m.

    Args:
        scene: name of a preset, path of a TOML or JSON file, or its settings.
        shape: (t, z, y, x), instead of the scene's own.
        seed: of the random numbers, 0 to 2^32 - 1.

    Frames are computed as they are asked for. Raises InputError for an unsuitable scene, shape or
    seed.
    """
    described = scene_of(scene)
    if shape is not None:
        steps, z, y, x = shape
        described = described.resized((z, y, x), steps)
    return Simulation(described, seed)


def _coordinates(scene: SimulatedScene) -> dict[str, Coordinate]:
    """Times in s, and the middles of the cells in m."""
    positions = {"t": np.linspace(0.0, scene.duration, scene.steps)} | {
        axis: (np.arange(count) + 0.5) / count * length
        for axis, count, length in zip("zyx", scene.shape, scene.size, strict=True)
    }
    return {
        axis: Coordinate(
            name=AXIS_NAMES[axis], values=values, attributes={"units": "s" if axis == "t" else "m"}
        )
        for axis, values in positions.items()
    }


ROLES = {
    "flow": "carries the medium",
    "body": "adds its value inside its surface",
    "bend": "moves the surfaces of all bodies",
    "spread": "widens the surfaces of all bodies",
}
"""Work of the effects of each role."""


def reasons(simulation: Simulation) -> list[tuple[str, str]]:
    """Explain a simulation: (topic, what is computed and why), effects in the scene's order."""
    scene, terms = simulation.scene, simulation.terms
    notes = {number: flow.note for number, flow in terms.flows}
    lines = [("effects", f"{_counted(len(scene.effects), 'effect')} named, one line each")]
    for number, effect in enumerate(scene.effects):
        if number in terms.idle:
            text = f"not computed: {terms.idle[number]}"
        else:
            note = f", {notes[number]}" if notes.get(number) else ""
            text = f"computed: {ROLES[effect.role]}{note}"
        lines.append((f"{number + 1} {effect.kind}", text))
    kinds = {effect.kind for effect in scene.effects}
    unnamed = [kind for kind in EFFECTS if kind not in kinds]
    if unnamed:
        lines.append(("not named", f"{', '.join(unnamed)}: never made, cost nothing"))
    lines.append(("time", _time_text(simulation)))
    lines.append(("surfaces", _surface_text(simulation)))
    if scene.background:
        lines.append(("background", f"{scene.background:g} {scene.units}".removesuffix(" 1")))
    return lines


class EffectCounts(TypedDict):
    """Counters of a kind of effect."""

    made: Annotated[int, "terms that were made; 0 where none is named"]
    places: Annotated[int, "places for which they were computed"]


class Counts(TypedDict):
    """Counters of a simulation."""

    frames: Annotated[int, "frames computed"]
    vertices: Annotated[int, "vertices of these frames"]
    places: Annotated[int, "places looked at for them, those beside blocks of vertices included"]
    parts: Annotated[int, "parts of the time over all frames, in each of which every flow acts"]
    stretches: Annotated[int, "vertices at which the change to the next was computed"]
    effects: Annotated[dict[str, EffectCounts], "each kind of effect, used or not"]


def counts(simulation: Simulation) -> Counts:
    """Counters of a simulation as JSON values."""
    counters, terms = simulation.counters, simulation.terms
    kinds: dict[str, EffectCounts] = {kind: {"made": 0, "places": 0} for kind in EFFECTS}
    for number, effect in enumerate(simulation.scene.effects):
        kinds[effect.kind]["made"] += number not in terms.idle
        kinds[effect.kind]["places"] += counters.evaluations[number]
    return {
        "frames": counters.frames,
        "vertices": counters.vertices,
        "places": counters.places,
        "parts": counters.parts,
        "stretches": counters.stretches,
        "effects": kinds,
    }


def _time_text(simulation: Simulation) -> str:
    """The parts into which the time to a step is cut for the flows."""
    terms = simulation.terms
    if not terms.flows:
        return "nothing is carried: a step needs none of the times before it"
    if terms.exact:
        return "one flow, whose motion is known for any time: the time to a step is one part"
    return (
        f"the time to a step is cut into {simulation.scene.splits} parts (splits),"
        " in each of which every flow acts in turn"
    )


def _surface_text(simulation: Simulation) -> str:
    """The width of surfaces."""
    terms = simulation.terms
    if not terms.bodies:
        return "none: the value is the background everywhere"
    if not terms.stretched:
        return "nothing bends them or draws them out: their width is the same everywhere"
    causes = (["flows draw them out"] if terms.sheared else []) + (
        ["fingers bend them"] if terms.bends else []
    )
    return f"{' and '.join(causes)}: their width follows from the change between vertices"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
