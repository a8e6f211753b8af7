"""Containers of several variables: `u` and `v` on one grid, `w` on a staggered one, `paper` too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from table_files import table_parts

from fhash_formats.container import ContainerWriter


def compact_header(samples: Any, shift: float = 0.0) -> dict[str, Any]:
    """The header of a compact variable; its positions of x are `shift` away from the usual."""
    header: dict[str, Any] = samples.compact_header()
    header["coordinates"] = {
        axis: {"step": 0.5, "attributes": {"units": "m"}} for axis in ("time", "z", "y", "x")
    }
    header["coordinates"]["x"] |= {"start": shift, "name": "lon (deg)"}
    return header


def write_several(path: Path, samples: Any, *, paper: bool = True) -> Path:
    """A container of the variables u, group/v, w and, where it is asked for, one of the profile
    paper; its path.
    """
    names = ["u", "group/v", "w", *(["paper"] if paper else [])]
    with ContainerWriter(path, force=True, variables=names) as writer:
        writer.attributes = {"title": "four winds"}
        for name in names[:3]:
            parts = table_parts(head=name != "w", seed=len(name))
            writer.begin()
            writer.add_whole("auxiliary/area", np.full((5, 6), float(name == "w")))
            parts.write(writer)
            writer.finish(compact_header(samples, shift=0.25 if name == "w" else 0.0))
        if paper:
            header = samples.header()
            writer.begin()
            for array, values in samples.arrays(header).items():
                writer.add_whole(array, values)
            writer.finish(header)
        writer.commit()
    return path
