"""Properties of a default picture: finite, within 0..1, and equal to the float64 picture."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from fhash_codec.selftest.case import Finding, Run
from fhash_formats.errors import InputError

__all__ = ["PICTURES_CHECKS"]

SIZE = (48, 48)
"""Width and height of the picture in pixels."""
MODES = ("stream", "arm")
"""Modes of marching through a network. It has values of its own between vertices, where the mode
`cache` interpolates: the pictures differ."""


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
    yield _finite("finite pixels", cached)
    beyond = max(-float(np.nanmin(cached)), float(np.nanmax(cached)) - 1.0, 0.0)
    yield Finding(name="pixels in 0..1", worst=beyond, limit=0.0, unit="of a channel")
    # Imported late: decoding does not need the renderer.
    from fhash_codec.selftest.checks.ray_checks import float64_picture, scene

    yield float64_picture(run, scene(size=[12, 12], step=_step(run)))
    if run.volume.profile == "paper":
        for mode in MODES:
            yield _finite(f"finite pixels, {mode}", _rendered(run, mode))


PICTURES_CHECKS = (picture,)


def _finite(name: str, picture: npt.NDArray[np.float32]) -> Finding:
    bad = float(np.count_nonzero(~np.isfinite(picture)))
    return Finding(name=name, worst=bad, limit=0.0, unit="channels")


def _step(run: Run) -> float:
    return 0.5 if run.volume.shape[0] > 1 else 0.0


def _rendered(run: Run, mode: str) -> npt.NDArray[np.float32]:
    from fhash_codec.rendering import render
    from fhash_codec.rendering.scenes import Marching, Scene

    return render(run.volume, Scene(size=SIZE, step=_step(run), march=Marching(mode=mode))).rgba
