"""Fill values for the vertices of a tile that do not count.

They are computed once and shared by many trials, since this search is the slowest step.
"""

from __future__ import annotations

import numpy as np

from fhash_codec.compact.tiles.blocks import Tile
from fhash_formats.transform.tile.decoding import transform_for
from fhash_formats.transform.tile.filling import filled
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["fill"]


def fill(tile: Tile, settings: TileSettings, density: int) -> Tile:
    """Return a tile with other values, of the same type, where vertices do not count.

    Vertices whose value is not finite do not count either: the returned mask excludes them.

    settings: transform and step for which the values shall be cheap; with other settings they are
        still better than the values of the source.
    density: thoroughness, see `fhash_formats.transform.tile.filling.filled`; with 0 the values of
        the source stay if all of them are finite.
    """
    values, in_coreset = tile
    if in_coreset is None:
        return tile
    if density == 0:
        if values.dtype.kind != "f" or np.isfinite(values).all():
            return tile
        density = 1
    finite = np.isfinite(values) if values.dtype.kind == "f" else np.ones(values.shape, bool)
    counted = finite & in_coreset
    if counted.all() or not counted.any():
        return tile
    center = settings.dtype.type(settings.center)
    with np.errstate(over="ignore", invalid="ignore"):
        target = np.where(finite, values, 0).astype(settings.dtype) - center
        transform = transform_for(settings, values.shape)
        filling = filled(target, counted, finite, transform, settings, density) + center
        # Beyond the range there is nothing to gain, and a type may have no such numbers.
        filling = np.clip(filling, settings.low, settings.high)
        if values.dtype.kind != "f":
            filling = np.rint(filling)
        return Tile(np.where(counted, values, filling.astype(values.dtype)), counted)
