"""Axes and positions of meshes in openPMD files: `axisLabels`, `gridSpacing`, `gridGlobalOffset`.

openPMD 1.1, mesh records: a vertex i along an axis is at
(gridGlobalOffset + (i + position) * gridSpacing) * gridUnitSI, in metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.readers.common.positions import Column
from fhash_formats.series import AXES
from fhash_formats.support.attributes import json_attributes

UNITS = "m"


def axes(
    record: Mapping[str, Any], component: Mapping[str, Any], shape: Sequence[int]
) -> list[Column | None]:
    """A column of positions for each dimension of a mesh; None for each if the file is none.

    record: attributes of the group of the components of a vector, of which `component` is one; a
    scalar has all attributes itself.
    """
    own, group = json_attributes(component), json_attributes(record)
    known = own if "axisLabels" in own else group
    labels = known.get("axisLabels")
    if (
        not isinstance(labels, list)
        or len(labels) != len(shape)
        or not all(str(label) in AXES for label in labels)
    ):
        return [None] * len(shape)
    # in Fortran's order the labels begin with the fastest axis
    way = -1 if known.get("dataOrder") == "F" else 1
    labels = labels[::way]
    spacing = _numbers(known.get("gridSpacing"), len(shape), 1.0)[::way]
    offset = _numbers(known.get("gridGlobalOffset"), len(shape), 0.0)[::way]
    position = _numbers(own.get("position"), len(shape), 0.0)[::way]
    unit = known.get("gridUnitSI")
    scale = float(unit) if isinstance(unit, int | float) else 1.0
    return [
        _column(str(labels[place]), length, numbers * scale)
        for place, (length, numbers) in enumerate(
            zip(
                shape,
                np.stack([offset + position * spacing, spacing], axis=1),
                strict=True,
            )
        )
    ]


def _numbers(value: Any, count: int, default: float) -> npt.NDArray[np.float64]:
    if isinstance(value, list) and len(value) == count:
        return np.asarray(value, np.float64)
    return np.full(count, default)


def _column(name: str, length: int, line: npt.NDArray[np.float64]) -> Column:
    return Column(
        name=name,
        length=length,
        read=lambda: line[0] + line[1] * np.arange(length),
        attributes={"units": UNITS},
    )
