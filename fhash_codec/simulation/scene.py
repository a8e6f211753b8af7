"""A scene to simulate: a box, a time and a list of effects, as a preset or a file describes it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from fhash_codec.records import Record, limits
from fhash_codec.simulation.effects import (
    Advection,
    Blob,
    Buoyancy,
    Diffusion,
    Effect,
    Fingers,
    Front,
    Rotation,
    Shell,
    Turbulence,
    Vortex,
)
from fhash_formats.errors import InputError, suggestion

EFFECTS: dict[str, type[Effect]] = {
    effect.kind: effect
    for effect in (
        Advection,
        Rotation,
        Vortex,
        Turbulence,
        Buoyancy,
        Blob,
        Front,
        Shell,
        Fingers,
        Diffusion,
    )
}
"""Classes of the effects by the names that scenes give them."""


def effect_of(values: object, number: int) -> Effect:
    """The effect of a table of a scene, `effect = "NAME"` and its settings.

    number: of the table in the scene, from 1, for messages.
    Raises InputError for an unknown effect or setting, and for a value that is not allowed.
    """
    where = f"effect {number}"
    if isinstance(values, Effect):
        return values
    if not isinstance(values, Mapping):
        raise InputError(f"{where} is {values!r:.40}; a table of settings is needed")
    settings: dict[str, Any] = dict(values)
    kind = settings.pop("effect", None)
    if not isinstance(kind, str):
        raise InputError(f'{where} has no name; write effect = "NAME", one of {", ".join(EFFECTS)}')
    if kind not in EFFECTS:
        raise InputError(f"{where} is '{kind[:60]}'; {suggestion(kind, EFFECTS)}")
    try:
        return EFFECTS[kind].from_dict(settings)
    except InputError as error:
        raise InputError(f"{where}, {kind}: {error}") from error


Scene = dict[str, Any]

VORTEX: Scene = {
    "help": "two blobs of a tracer carried and mixed by a swirl",
    "name": "tracer",
    "feature": "interval:0.08:2",
    "shape": (32, 48, 48),
    "effects": [
        {"effect": "blob", "centre": (0.36, 0.5, 0.27), "radius": 0.13, "edge": 0.1,
         "jitter": 0.03},
        {"effect": "blob", "centre": (0.52, 0.5, 0.72), "radius": 0.13, "edge": 0.1,
         "jitter": 0.03, "strength": 0.75},
        {"effect": "vortex", "strength": 1.4, "radius": 0.16},
        {"effect": "advection", "strength": 0.15, "direction": (1, 0, 0)},
        {"effect": "diffusion", "strength": 7e-4},
    ],
}  # fmt: skip
"""A tracer in a vortex."""

FRONT: Scene = {
    "help": "a blast's shell that expands and grows fingers",
    "name": "density",
    "units": "kg m-3",
    "feature": "interval:0.25:2",
    "shape": (32, 48, 48),
    "background": 0.1,
    "effects": [
        {"effect": "shell", "strength": 0.75, "radius": 0.38, "age": 0.13, "thickness": 0.07},
        {"effect": "fingers", "strength": 0.5, "count": 14, "growth": 0.8},
    ],
}
"""A blast wave."""

FLAME: Scene = {
    "help": "a plane jet of fuel, wrinkled by eddies (after the paper's Combustion)",
    "name": "mixture_fraction",
    "feature": "interval:0.35:0.65",
    "shape": (14, 43, 50),
    "steps": 34,
    "size": (0.27, 0.86, 1.0),
    "splits": 3,
    "paper_shape": (54, 172, 200),
    "paper_steps": 136,
    "effects": [
        {"effect": "front", "direction": (0, 1, 0), "start": 0.53, "depth": 0.2, "speed": 0,
         "width": 0.02},
        {"effect": "vortex", "strength": 0.25, "radius": 0.1, "centre": (0, 0.54, 0.2)},
        {"effect": "vortex", "strength": 0.25, "radius": 0.1, "centre": (0, 0.54, 0.7)},
        {"effect": "vortex", "strength": -0.25, "radius": 0.1, "centre": (0, 0.32, 0.45)},
        {"effect": "vortex", "strength": -0.25, "radius": 0.1, "centre": (0, 0.32, 0.95)},
        {"effect": "turbulence", "strength": 0.07, "scale": 0.35, "octaves": 4},
        {"effect": "diffusion", "strength": 2e-4},
    ],
}  # fmt: skip
"""A turbulent plane jet flame."""

BUBBLE: Scene = {
    "help": "a bubble of gas that rises, rolls up and breaks, behind a shock"
    " (after the paper's Argon Bubble)",
    "name": "intensity",
    "feature": "interval:0.3:2",
    "shape": (64, 32, 32),
    "steps": 30,
    "size": (2.0, 1.0, 1.0),
    "splits": 5,
    "paper_shape": (256, 128, 128),
    "paper_steps": 241,
    "effects": [
        {"effect": "blob", "centre": (0.5, 0.5, 0.5), "radius": 0.24, "edge": 0.02},
        {"effect": "front", "direction": (1, 0, 0), "start": 0.1, "speed": 2.5, "strength": 0.08,
         "depth": 0.25, "width": 0.03},
        {"effect": "buoyancy", "strength": 3.0, "radius": 0.2, "centre": (0.5, 0.5, 0.5)},
        {"effect": "turbulence", "strength": 0.05, "scale": 0.3, "octaves": 4},
        {"effect": "diffusion", "strength": 2e-4},
    ],
}  # fmt: skip
"""A rising bubble."""

SHELL: Scene = {
    "help": "a shell of a supernova with fingers, turbulent and turning (after the paper's"
    " Supernova)",
    "name": "angular_momentum",
    "feature": "interval:0.3:2",
    "shape": (54, 54, 54),
    "steps": 34,
    "splits": 2,
    "paper_shape": (216, 216, 216),
    "paper_steps": 136,
    "effects": [
        {"effect": "shell", "strength": 0.8, "radius": 0.38, "age": 0.2, "thickness": 0.05},
        {"effect": "shell", "strength": 0.4, "radius": 0.22, "age": 0.2, "thickness": 0.06},
        {"effect": "fingers", "strength": 0.22, "count": 16, "growth": 0.5},
        {"effect": "turbulence", "strength": 0.04, "scale": 0.25, "octaves": 3},
        {"effect": "rotation", "strength": 0.8},
        {"effect": "diffusion", "strength": 2e-5},
    ],
}
"""A supernova remnant."""

PRESETS: dict[str, Scene] = {
    "vortex": VORTEX,
    "front": FRONT,
    "flame": FLAME,
    "bubble": BUBBLE,
    "shell": SHELL,
}
"""Scenes by name."""


MAX_EFFECTS = 64
"""Most effects of a scene."""
SUFFIXES = (".toml", ".json")
"""Suffixes of the files that describe a scene."""
MAX_SIDE = 16384
"""Most vertices along an axis, and most steps."""


@dataclass(frozen=True, kw_only=True)
class SimulatedScene(Record):
    """A box, a time and effects to simulate. Axes are always (z, y, x).

    The vertices are the middles of equal cells of the box, and the steps are spread evenly over the
    duration, its ends included.
    """

    help: str = limits("", "what it shows, in one line")
    name: str = limits("value", "name of the variable")
    units: str = limits("1", "units of the variable")
    feature: str = limits("all", "feature that fhash demo encodes, as --feature takes it")
    shape: tuple[int, int, int] = limits(
        (32, 32, 32), "vertices along z, y and x", low=1, high=MAX_SIDE
    )
    steps: int = limits(16, "number of steps", low=1, high=MAX_SIDE)
    size: tuple[float, float, float] = limits(
        (1.0, 1.0, 1.0), "lengths of the box along z, y and x in m", low=1e-2, high=1e3
    )
    duration: float = limits(1.0, "seconds from the first step to the last", low=1e-3, high=1e3)
    background: float = limits(0.0, "value where nothing is", low=-1e6, high=1e6)
    splits: int = limits(
        4, "parts of the time from 0 to a step, in each of which every flow acts", low=1, high=64
    )
    paper_shape: tuple[int, int, int] | None = limits(
        None, "vertices of the paper's data set that it resembles", low=1, high=MAX_SIDE
    )
    paper_steps: int | None = limits(
        None, "steps of the paper's data set that it resembles", low=1, high=MAX_SIDE
    )
    effects: tuple[Effect, ...] = limits((), "what happens")

    def __post_init__(self) -> None:
        """Make the effects of their tables, and check every field; raises InputError."""
        listed: Any = self.effects
        if not isinstance(listed, list | tuple):
            raise InputError(f"effects is {listed!r:.40}; a list of tables is needed")
        if len(listed) > MAX_EFFECTS:
            raise InputError(f"a scene has {len(listed)} effects; allowed: {MAX_EFFECTS}")
        effects = tuple(effect_of(values, number) for number, values in enumerate(listed, 1))
        object.__setattr__(self, "effects", effects)
        super().__post_init__()
        if not self.name.strip():
            raise InputError("name is empty; give the variable one, such as 'density'")

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name, without the fields that have their defaults."""
        tables = [{"effect": effect.kind, **effect.to_dict()} for effect in self.effects]
        return {**super().to_dict(), "effects": tables}

    @classmethod
    def preset(cls, name: str) -> Self:
        """The scene of `PRESETS` by name; raises InputError for another name."""
        if name not in PRESETS:
            raise InputError(
                f"scene is '{name[:60]}'; {suggestion(name, PRESETS)}; a file ends in"
                f" {' or '.join(SUFFIXES)}"
            )
        return cls.from_dict(PRESETS[name])

    def resized(self, shape: tuple[int, int, int] | None = None, steps: int | None = None) -> Self:
        """The same scene on other vertices and steps; raises InputError for unsuitable ones."""
        return dataclasses.replace(
            self,
            shape=self.shape if shape is None else shape,
            steps=self.steps if steps is None else steps,
        )

    def as_in_paper(self) -> Self:
        """The scene at the shape of the paper's data set; raises InputError where it has none."""
        if self.paper_shape is None or self.paper_steps is None:
            known = [name for name, values in PRESETS.items() if "paper_shape" in values]
            raise InputError(f"the scene resembles no data set of the paper; {', '.join(known)} do")
        return self.resized(self.paper_shape, self.paper_steps)


def scene_of(what: str | Path | Mapping[str, Any] | SimulatedScene) -> SimulatedScene:
    """The scene of a preset's name, of a TOML or JSON file, or of a table of settings.

    Raises InputError for one that cannot be, MissingInputError for a file that does not exist.
    """
    if isinstance(what, SimulatedScene):
        return what
    if isinstance(what, Mapping):
        return SimulatedScene.from_dict(what)
    path = Path(what)
    if path.suffix.lower() not in SUFFIXES:
        return SimulatedScene.preset(str(what))
    return SimulatedScene.read(path, "a scene", "no such file")
