"""The terms of a scene: those of its effects that change a value, made once, and why not others."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np

from fhash_codec.simulation.effects.effect import Bend, Body, Effect, Flow, Vector
from fhash_codec.simulation.scene import SimulatedScene

__all__ = ["Terms", "spacing_of", "terms_of"]


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


def spacing_of(scene: SimulatedScene) -> Vector:
    """Metres between vertices along z, y and x, 0 along an axis of one vertex."""
    z, y, x = (
        length / count if count > 1 else 0.0
        for length, count in zip(scene.size, scene.shape, strict=True)
    )
    return z, y, x


def terms_of(scene: SimulatedScene, seed: int) -> Terms:
    """Make the terms of a scene.

    An effect draws its random numbers from the seed, its kind and its number among the effects of
    this kind that are computed. So an effect of strength 0 changes those of no other.
    """
    terms = Terms(spacing=spacing_of(scene))
    bodies = any(effect.role == "body" and not effect.idle for effect in scene.effects)
    counts: dict[str, int] = {}
    for number, effect in enumerate(scene.effects):
        reason = effect.idle or ("" if bodies else "the scene has no body, so nothing shows it")
        if reason:
            terms.idle[number] = reason
            continue
        counts[effect.kind] = counts.get(effect.kind, 0) + 1
        key = [seed, zlib.crc32(effect.kind.encode()), counts[effect.kind]]
        _add(terms, number, effect, np.random.default_rng(key))
    return terms


def _add(terms: Terms, number: int, effect: Effect, generator: np.random.Generator) -> None:
    """Make the term of one effect."""
    term = effect.term(generator, terms.spacing)
    if isinstance(term, Flow):
        terms.flows.append((number, term))
    elif isinstance(term, Body):
        terms.bodies.append((number, term))
    elif isinstance(term, float):
        terms.diffusivity += term
        terms.spreads.append(number)
    else:
        terms.bends.append((number, term))
