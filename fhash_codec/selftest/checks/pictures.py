"""Properties of a default picture: finite, within 0..1, and the same however it is marched."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.selftest.case import Finding, Run
from fhash_codec.selftest.environment import environment

__all__ = ["CHECKS"]

SIZE = (48, 48)
NEAR = 1e-3
"""Of a channel, by which two ways to march the same values may differ."""
MODES = ("stream", "arm")


def picture(run: Run) -> Iterator[Finding]:
    """Halfway to the second step, where there is one, since there the step before and after must not show through."""
    shown = _rendered(run, "cache")
    yield Finding(
        name="finite pixels",
        worst=float(np.count_nonzero(~np.isfinite(shown))),
        limit=0.0,
        unit="channels",
    )
    beyond = max(-float(np.nanmin(shown)), float(np.nanmax(shown)) - 1.0, 0.0)
    yield Finding(name="pixels in 0..1", worst=beyond, limit=0.0, unit="of a channel")
    if run.volume.profile != "compact":
        # What lies between vertices is the network's there, and what the cache holds is not.
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
        off = np.max(np.abs(_rendered(run, mode) - shown))
        yield Finding(name=f"cache = {mode}", worst=float(off), limit=NEAR, unit="of a channel")
    if native.library() is not None:
        with environment(FHASH_NATIVE="0"):
            off = np.max(np.abs(_rendered(run, "cache") - shown))
        yield Finding(
            name="native = portable march", worst=float(off), limit=NEAR, unit="of a channel"
        )


CHECKS = (picture,)


def _rendered(run: Run, mode: str) -> npt.NDArray[np.float32]:
    # Pictures are a package of their own, which decoding does not need.
    from fhash_codec.rendering import render
    from fhash_codec.rendering.scene.scene import Marching, Scene

    step = 0.5 if run.volume.shape[0] > 1 else 0.0
    return render(run.volume, Scene(size=SIZE, step=step, march=Marching(mode=mode))).rgba
