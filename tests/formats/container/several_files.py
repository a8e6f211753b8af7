"""Containers of several variables: `u` and `v` on one grid, `w` on a staggered one, `paper` too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from table_files import table_parts

from fhash_formats.container import ContainerWriter

AXES = ("time", "z", "y", "x")
LENGTHS = (4, 3, 5, 6)


def add_coordinates(writer: ContainerWriter, shift: float = 0.0) -> None:
    """The coordinates of a variable; those of x are `shift` away from the usual ones."""
    for axis, length in zip(AXES, LENGTHS, strict=True):
        values = np.arange(length) * 0.5 + (shift if axis == "x" else 0)
        name = {"time": "time", "x": "lon (deg)"}.get(axis, axis)
        writer.add_whole(f"coords/{axis}", values, attributes={"units": "m", "name": name})


def compact_header(samples: Any) -> dict[str, Any]:
    """The header of a compact variable without described coordinates."""
    header = {**samples.compact_header(), "required_features": ["transform"]}
    del header["coordinates"]
    return header


PLAIN_VARIABLE = {"name": "v", "units": "", "attributes": {}}
"""A variable as `begin` takes it."""


def write_several(path: Path, samples: Any, *, paper: bool = True) -> Path:
    """A container of the variables u, group/v, w and, where it is asked for, one of the profile
    paper; its path.
    """
    names = ["u", "group/v", "w", *(["paper"] if paper else [])]
    with ContainerWriter(path, force=True, variables=names) as writer:
        writer.attributes = {"title": "four winds"}
        for name in names[:3]:
            parts = table_parts(head=name != "w", seed=len(name))
            writer.begin({"name": "v", "units": "m s-1", "attributes": {"flag": 1}})
            add_coordinates(writer, shift=0.25 if name == "w" else 0)
            writer.add_whole("auxiliary/area", np.full((5, 6), float(name == "w")))
            parts.write(writer)
            writer.finish(compact_header(samples))
        if paper:
            header = samples.header()
            writer.begin(PLAIN_VARIABLE)
            for array, values in samples.arrays(header).items():
                writer.add_whole(array, values)
            writer.finish(header)
        writer.commit()
    return path
