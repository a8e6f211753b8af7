"""All effects by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fhash_codec.simulation.effects.advection import Advection
from fhash_codec.simulation.effects.blob import Blob
from fhash_codec.simulation.effects.buoyancy import Buoyancy
from fhash_codec.simulation.effects.diffusion import Diffusion
from fhash_codec.simulation.effects.effect import Effect
from fhash_codec.simulation.effects.fingers import Fingers
from fhash_codec.simulation.effects.front import Front
from fhash_codec.simulation.effects.rotation import Rotation
from fhash_codec.simulation.effects.shell import Shell
from fhash_codec.simulation.effects.turbulence import Turbulence
from fhash_codec.simulation.effects.vortex import Vortex
from fhash_formats.errors import InputError
from fhash_formats.support.suggestions import suggestion

__all__ = ["EFFECTS", "effect_of"]

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
