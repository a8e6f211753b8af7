"""A scene to simulate: a box, a time, and a list of effects, as a preset or a file describes it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from fhash_codec.rendering.scene.record import Record, limits
from fhash_codec.simulation.effects.catalogue import effect_of
from fhash_codec.simulation.effects.effect import Effect
from fhash_codec.simulation.presets import PRESETS
from fhash_formats.errors import InputError
from fhash_formats.support.suggestions import suggestion

__all__ = ["MAX_EFFECTS", "SUFFIXES", "SimulatedScene", "scene_of"]

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
    effects: tuple[Effect, ...] = limits((), "what happens, see docs/scenes.md")

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
