"""Containers of several variables: `u` and `v` on one grid, `w` on a staggered one, `paper` too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from table_files import PartsApart, table_parts

from fhash_formats.container import ContainerWriter, SeveralWriter

AXES = ("time", "z", "y", "x")
LENGTHS = (4, 3, 5, 6)


def add_coordinates(writer: ContainerWriter, shift: float = 0.0) -> None:
    """The coordinates of a variable; those of x are `shift` away from the usual ones."""
    for axis, length in zip(AXES, LENGTHS, strict=True):
        values = np.arange(length) * 0.5 + (shift if axis == "x" else 0)
        name = {"time": "time", "x": "lon (deg)"}.get(axis, axis)
        writer.add_whole(f"coords/{axis}", values, attributes={"units": "m", "name": name})


def compact_header(samples: Any, parts: Any) -> dict[str, Any]:
    """The header of a compact variable without described coordinates."""
    header = {**samples.compact_header(), "required_features": parts.features}
    del header["coordinates"]
    return header


def write_several(path: Path, samples: Any, *, apart: bool = True, paper: bool = True) -> Path:
    """A container of the variables u, group/v, w and, where it is asked for, one of the profile
    paper; its path.

    apart: whether u has its head and masks in arrays of their own.
    """
    names = ["u", "group/v", "w", *(["paper"] if paper else [])]
    with ContainerWriter(path, force=True) as writer:
        writer.attributes = {"title": "four winds"}
        several = SeveralWriter(writer, names)
        for name in names[:3]:
            parts = table_parts(head=name != "w")
            if apart and name == "u":
                parts = PartsApart.of(parts)
            variable = several.variable(name, {"units": "m s-1", "flag": 1})
            add_coordinates(variable, shift=0.25 if name == "w" else 0)
            parts.write(variable)
            variable.finish(compact_header(samples, parts))
        if paper:
            header = samples.header()
            variable = several.variable("paper")
            for array, values in samples.arrays(header).items():
                variable.add_whole(array, values)
            variable.finish(header)
        several.commit()
    return path
