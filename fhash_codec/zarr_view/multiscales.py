"""Metadata of OME-Zarr 0.5 on the levels of a variable: `multiscales`, as viewers read them.

A scale must be positive there. An axis whose positions do not ascend evenly is therefore described
in vertices, without a unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.zarr_view.levels import Level
from fhash_formats.series import AXES, Coordinate

__all__ = ["multiscale"]

UNITS = {
    "m": "meter", "metre": "meter", "meter": "meter", "km": "kilometer", "cm": "centimeter",
    "mm": "millimeter", "um": "micrometer", "nm": "nanometer", "s": "second", "sec": "second",
    "second": "second", "ms": "millisecond", "min": "minute", "minute": "minute", "h": "hour",
    "hr": "hour", "hour": "hour", "d": "day", "day": "day", "kilometer": "kilometer",
    "kilometre": "kilometer", "centimeter": "centimeter", "millimeter": "millimeter",
    "micrometer": "micrometer", "micron": "micrometer", "nanometer": "nanometer",
    "millisecond": "millisecond",
}  # fmt: skip
"""Units of positions, in the singular, by the names that the specification has for them."""
TIME_UNITS = frozenset({"second", "millisecond", "minute", "hour", "day"})
"""Units that belong to the axis t alone."""
UNEVEN = 1e-3
"""Part of a step by which positions may differ from an even rule, so that a scale describes them.

Positions that were rounded to float32 differ by less.
"""


def multiscale(
    name: str,
    coords: Mapping[str, Coordinate],
    dimensions: Mapping[str, str],
    levels: Mapping[str, Level],
) -> dict[str, Any]:
    """The entry of a variable in `multiscales`.

    Args:
        name: the variable's.
        coords: positions along each of t, z, y and x.
        dimensions: name in the arrays of each axis that they have, in the order t, z, y, x.
        levels: the levels by the path of their arrays, finest first.
    """
    axes: list[dict[str, Any]] = []
    rules: dict[str, tuple[float, float]] = {}
    for axis, dimension in dimensions.items():
        coordinate = coords[axis]
        rule = _even(coordinate.values)
        unit = None if rule is None else _unit(axis, coordinate)
        axes.append(
            {
                "name": dimension,
                "type": "time" if axis == "t" else "space",
                **({} if unit is None else {"unit": unit}),
            }
        )
        rules[axis] = (0.0, 1.0) if rule is None else rule
    return {
        "name": name,
        "type": "lowpass",
        "metadata": {"description": "every 2^n-th vertex along z, y and x of a low-passed lattice"},
        "axes": axes,
        "datasets": [
            {"path": path, "coordinateTransformations": _transformations(level, rules)}
            for path, level in levels.items()
        ],
    }


def _transformations(
    level: Level, rules: Mapping[str, tuple[float, float]]
) -> list[dict[str, Any]]:
    """Scale and translation from the vertices of a level to positions.

    rules: first position and step along each axis.
    """
    strides = dict(zip(AXES, (1, *[level.stride] * 3), strict=True))
    firsts = dict(zip(AXES, (0, *level.first), strict=True))
    return [
        {"type": "scale", "scale": [step * strides[axis] for axis, (_, step) in rules.items()]},
        {
            "type": "translation",
            "translation": [start + step * firsts[axis] for axis, (start, step) in rules.items()],
        },
    ]


def _even(values: npt.NDArray[np.float64]) -> tuple[float, float] | None:
    """The first position and the step of positions that ascend evenly; None for others."""
    if not np.isfinite(values).all():
        return None
    if values.size == 1:
        return float(values[0]), 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        step = float((values[-1] - values[0]) / (values.size - 1))
        off = np.abs(values - (values[0] + step * np.arange(values.size)))
    even = 0 < step < np.inf and bool(off.max() <= UNEVEN * step)
    return (float(values[0]), step) if even else None


def _unit(axis: str, coordinate: Coordinate) -> str | None:
    """The unit of positions as the specification names it; None where it has no name for it."""
    text = str(coordinate.attributes.get("units", ""))
    word = text.partition(" since ")[0].strip()
    unit = UNITS.get(word) or UNITS.get(word.lower().removesuffix("s"))
    if unit is None or (unit in TIME_UNITS) != (axis == "t"):
        return None
    return unit
