"""Generated series for `fhash bench train`, by the simulator."""

from __future__ import annotations

from dataclasses import dataclass

from fhash_codec.bench.rate.generated import PREFIX
from fhash_codec.simulation.simulate import Simulation, simulate
from fhash_formats.errors import InputError, suggestion

__all__ = ["DEFAULT", "MADE", "Made", "is_made", "made_series"]


@dataclass(frozen=True)
class Made:
    """A generated series.

    Attributes:
        scene: name of the simulator's scene.
        shape: (t, z, y, x).
        help: what it is, in a few words.
        feature: whether the scene's feature is measured, beside the whole.
    """

    scene: str
    shape: tuple[int, int, int, int]
    help: str
    feature: bool


MADE = {
    "front": Made("front", (8, 32, 64, 64), "a blast's shell", True),
    "argon": Made("bubble", (9, 204, 83, 80), "the size of the paper's Argon box", False),
}
"""Series by name."""
DEFAULT = f"{PREFIX}front"
"""Series where none is named."""


def is_made(name: object) -> bool:
    """Return whether something names a generated series."""
    return isinstance(name, str) and name.startswith(PREFIX)


def made_series(name: str) -> tuple[Simulation, Made]:
    """Return a generated series and what it is.

    Raises InputError for a name that is unknown.
    """
    made = MADE.get(name.removeprefix(PREFIX))
    if made is None:
        raise InputError(
            f"'{name}' is no generated series; {suggestion(name, map(PREFIX.__add__, MADE))}"
        )
    return simulate(made.scene, made.shape), made
