"""What stands where values do not count, found once for many trials: the search for it takes longer than all else."""

from __future__ import annotations

import numpy as np

from fhash_codec.compact.tiles.blocks import Care, Values
from fhash_formats.transform.tile.decoding import transform_for
from fhash_formats.transform.tile.filling import filled
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["fill"]


def fill(values: Values, care: Care, settings: TileSettings, density: int) -> tuple[Values, Care]:
    """A tile (t, z, y, x) with other values, of the same type, where they do not count, and what counts.

    settings: transform and step for which the values shall be cheap; with others they are still better than nothing. density: see
    `fhash_formats.transform.tile.filling.filled`; 0 leaves the values as they are, if all of them are finite.
    """
    if care is None:
        return values, care
    if density == 0:
        if values.dtype.kind != "f" or np.isfinite(values).all():
            return values, care
        density = 1
    finite = np.isfinite(values) if values.dtype.kind == "f" else np.ones(values.shape, bool)
    counts = finite & care
    if counts.all() or not counts.any():
        return values, care
    center = settings.dtype.type(settings.center)
    with np.errstate(over="ignore", invalid="ignore"):
        target = np.where(finite, values, 0).astype(settings.dtype) - center
        found = (
            filled(target, counts, finite, transform_for(settings, values.shape), settings, density)
            + center
        )
        # Beyond the range there is nothing to gain, and a type may have no such numbers.
        found = np.clip(found, settings.low, settings.high)
        if values.dtype.kind != "f":
            found = np.rint(found)
        return np.where(counts, values, found.astype(values.dtype)), counts
