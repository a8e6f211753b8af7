"""A simulation in words and numbers: what is computed and why, what is not, and what it took."""

from __future__ import annotations

from typing import Any

from fhash_codec.simulation.effects.catalogue import EFFECTS
from fhash_codec.simulation.simulate import Simulation

__all__ = ["counts", "reasons"]

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


def counts(simulation: Simulation) -> dict[str, Any]:
    """Counters of a simulation as JSON values; each kind of effect is there, 0 if not named.

    `made` is the number of terms, and `places` for how many places they were computed.
    """
    counters, terms = simulation.counters, simulation.terms
    kinds = {kind: {"made": 0, "places": 0} for kind in EFFECTS}
    for number, effect in enumerate(simulation.scene.effects):
        kinds[effect.kind]["made"] += number not in terms.idle
        kinds[effect.kind]["places"] += counters.evaluations.get(number, 0)
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
