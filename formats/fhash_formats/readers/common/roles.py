"""The axis (t, z, y or x) of a file's dimension: by CF conventions, by its name, by its place."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from fhash_formats.errors import InputError
from fhash_formats.series import AXES

NAMES = {
    "t": "time t times time_counter valid_time leadtime lead_time forecast_period forecast_time"
    " date timestep timesteps time_step step steps record records frame frames",
    "z": "z lev level levels height depth altitude alt plev pressure pressure_level isobaric"
    " model_level_number bottom_top zc x3v x3 k",
    "y": "y lat latitude rlat grid_latitude projection_y_coordinate south_north nlat yc x2v x2 j",
    "x": "x lon longitude rlon grid_longitude projection_x_coordinate west_east nlon xc x1v x1 i",
}
"""Conventional names of coordinates, the most usual first; those of times before those of steps.

x1v, x2v, x3v are Athena++'s, bottom_top and the like WRF's.
"""

ROLE_OF_NAME = {name: axis for axis, names in NAMES.items() for name in names.split()}

STANDARD_NAMES = (
    ("t", re.compile(r"time|forecast_reference_time|forecast_period")),
    (
        "z",
        re.compile(
            r"(atmosphere|ocean)_.*_coordinate|height.*|altitude|depth.*|air_pressure"
            r"|model_level_number|.*_sigma_.*"
        ),
    ),
    (
        "y",
        re.compile(
            r"latitude|grid_latitude|projection_y_coordinate|projection_y_angular_coordinate"
        ),
    ),
    (
        "x",
        re.compile(
            r"longitude|grid_longitude|projection_x_coordinate|projection_x_angular_coordinate"
        ),
    ),
)
UNITS = (
    ("t", re.compile(r"\S+ since \S.*")),
    (
        "z",
        re.compile(
            r"(pascal|pa|hpa|kpa|bar|millibar|mbar|mb|dbar|decibar|atm|layer|level|sigma_level)s?"
        ),
    ),
    ("y", re.compile(r"degrees?_?n(orth)?")),
    ("x", re.compile(r"degrees?_?e(ast)?")),
)


def role_of_name(name: str) -> str | None:
    """The axis of a conventional name in any case, also with a trailing number ("time_0"), or
    None."""
    word = name.lower()
    return ROLE_OF_NAME.get(word) or ROLE_OF_NAME.get(re.sub(r"(?<=..)_?\d+$", "", word))


def role_of_coordinate(name: str, attributes: Mapping[str, Any]) -> str | None:
    """The axis of a coordinate by CF, else by its name, or None.

    CF 1.11, section 4: axis, standard_name, units, positive.
    """
    axis = str(attributes.get("axis", "")).lower()
    if axis in AXES:
        return axis
    for key, table in (("standard_name", STANDARD_NAMES), ("units", UNITS)):
        text = str(attributes.get(key, "")).strip().lower()
        for role, pattern in table:
            if pattern.fullmatch(text):
                return role
    if str(attributes.get("positive", "")).lower() in ("up", "down"):
        return "z"
    return role_of_name(name)


def assign_axes(
    what: str,
    shape: Sequence[int],
    hints: Sequence[str | None],
    names: Sequence[str | None],
    axes: tuple[str, ...] | None,
) -> tuple[str, ...]:
    """The axis of each of 3 or 4 dimensions.

    `axes`, if the user gave it, decides. Otherwise the hints do. Dimensions without a hint take the
    axes that are left in the order (t, z, y, x). 3 dimensions are (z, y, x) unless a hint says
    time; then they are (t, y, x) first of all.

    Raises InputError where that is ambiguous: two dimensions with one meaning, or an order that
    cannot be completed with certainty.
    """
    if axes is not None:
        if len(axes) != len(shape):
            raise InputError(
                f"{what}: --axes {','.join(axes)} names {len(axes)} axes, the array has"
                f" {len(shape)} dimensions {tuple(shape)}"
            )
        return axes
    said = [hint for hint in hints if hint is not None]
    shown = ", ".join(f"{name or '?'}={length}" for name, length in zip(names, shape, strict=True))
    if len(set(said)) != len(said):
        raise InputError(
            f"{what}: two dimensions of ({shown}) mean the same axis; say what they are with"
            " --axes, such as t,z,y,x"
        )
    open_places = len(shape) - len(said)
    if open_places > 1 and said != sorted(said, key=AXES.index):
        raise InputError(
            f"{what}: the order of the dimensions ({shown}) is not clear; say what they are with"
            " --axes, such as x,y,z,t"
        )
    left = [axis for axis in (AXES if len(shape) == len(AXES) else AXES[1:]) if axis not in said]
    fill = iter(left[len(left) - open_places :])
    return tuple(hint if hint is not None else next(fill) for hint in hints)
