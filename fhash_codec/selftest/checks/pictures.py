"""Properties of a default picture: finite, within 0..1, and the same for every march."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from fhash_codec.selftest.case import Finding, Run
from fhash_formats.errors import InputError

__all__ = ["CHECKS"]

SIZE = (48, 48)
"""Width and height of the picture in pixels."""
NEAR = 1e-3
"""Allowed difference of a colour channel between two marches through the same values."""
MODES = ("stream", "arm")
"""Modes of marching to compare with the mode `cache`."""


def picture(run: Run) -> Iterator[Finding]:
    """A picture halfway between the first two steps, where values missing in either of them must
    not be drawn. 64-bit integers that are one number as float64 have none, and are refused."""
    try:
        cached = _rendered(run, "cache")
    except InputError:
        ends = {float(end) for end in run.volume.value_range.ends}
        yield Finding(
            name="refused pictures", worst=float(len(ends) - 1), limit=0.0, unit="of series"
        )
        return
    yield Finding(
        name="finite pixels",
        worst=float(np.count_nonzero(~np.isfinite(cached))),
        limit=0.0,
        unit="channels",
    )
    beyond = max(-float(np.nanmin(cached)), float(np.nanmax(cached)) - 1.0, 0.0)
    yield Finding(name="pixels in 0..1", worst=beyond, limit=0.0, unit="of a channel")
    if run.volume.profile != "compact":
        # The arm evaluates the network between vertices, the cache interpolates: they differ.
        for mode in MODES:
            other = _rendered(run, mode)
            yield Finding(
                name=f"finite pixels, {mode}",
                worst=float(np.count_nonzero(~np.isfinite(other))),
                limit=0.0,
                unit="channels",
            )
        return
    for mode in MODES:
        off = np.max(np.abs(_rendered(run, mode) - cached))
        yield Finding(name=f"cache = {mode}", worst=float(off), limit=NEAR, unit="of a channel")


CHECKS = (picture,)


def _rendered(run: Run, mode: str) -> npt.NDArray[np.float32]:
    # Imported late: decoding does not need the renderer.
    from fhash_codec.rendering import render
    from fhash_codec.rendering.scene.scene import Marching, Scene

    step = 0.5 if run.volume.shape[0] > 1 else 0.0
    return render(run.volume, Scene(size=SIZE, step=step, march=Marching(mode=mode))).rgba
