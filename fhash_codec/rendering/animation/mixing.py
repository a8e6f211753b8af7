"""Mixing of settings: the values between those of two scenes."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from fhash_codec.rendering.colour.colours import colour_code, parse_colour
from fhash_codec.rendering.scene.record import Record
from fhash_formats.errors import InputError

__all__ = ["mixed"]

TIME_AND_CAMERA = ("camera", "step", "time")
"""Fields of a scene that an animation sets by itself."""


def mixed(first: Any, second: Any, weight: float) -> Any:
    """Mix two settings; numbers and colours are linear in the weight, so ascending points ascend.

    What cannot be mixed, such as names or tuples of different lengths, stays the first's. Time and
    camera of two scenes stay the first's too: an animation sets them by itself.

    Args:
        first: the setting at weight 0.
        second: the setting at weight 1.
        weight: 0..1.
    """
    if weight == 0 or first == second:
        return first
    if weight == 1:
        return second
    if isinstance(first, Record) and type(first) is type(second):
        return _mixed_record(first, second, weight)
    if isinstance(first, float) and isinstance(second, float):
        return (1 - weight) * first + weight * second
    if isinstance(first, tuple) and isinstance(second, tuple) and len(first) == len(second):
        return tuple(mixed(*items, weight) for items in zip(first, second, strict=True))
    if isinstance(first, str) and isinstance(second, str):
        return _mixed_colour(first, second, weight)
    return first


def _mixed_record(first: Record, second: Record, weight: float) -> Record:
    names = [field.name for field in dataclasses.fields(first)]  # type: ignore[arg-type]
    values = {
        name: mixed(getattr(first, name), getattr(second, name), weight)
        for name in names
        if name not in TIME_AND_CAMERA
    }
    return dataclasses.replace(first, **values)  # type: ignore[type-var]


def _mixed_colour(first: str, second: str, weight: float) -> str:
    """Mix two colours as '#rrggbb'; the first text if one of them is no colour."""
    try:
        colours = np.array([parse_colour(first), parse_colour(second)])
    except InputError:
        return first
    return colour_code((1 - weight) * colours[0] + weight * colours[1])
