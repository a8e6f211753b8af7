"""Levels of a volume over its whole domain: the values, and the coarser ones of `read_lod`.

Level n holds every 2^n-th vertex of the domain along z, y and x, counted so that the vertices of
the feature bounding box that `read_lod` gives are among them. Its first vertex is therefore not
always vertex 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.volume import Volume
from fhash_codec.zarr_view.arrays import Region
from fhash_formats.support.fork_lock import ForkLock

__all__ = ["Level", "level_count"]

LOCKS = 64
"""Locks that the tiles of a level share."""
SMALL_SIDE = 16
"""Vertices along the longest side of the feature bounding box that no coarser level follows."""


def level_count(volume: Volume) -> int:
    """The number of levels, level 0 included; 1 for files without levels of detail."""
    if volume.profile != "compact":
        return 1
    halvings = (-(-max(volume.box.shape) // SMALL_SIDE) - 1).bit_length()
    return min(len(volume.tables), 1 + halvings)


class Level:
    """The values (t, z, y, x) of a level. Reading is safe for several threads.

    Attributes:
        lod: level of detail; 0 for the values themselves.
        shape: vertices (t, z, y, x).
        tile: vertices (t, z, y, x) that are decoded together, roughly where lod is not 0.
        first: the vertex (z, y, x) of the domain that the first one of the level is.
        dtype: type of the values, that of the volume.
    """

    def __init__(self, volume: Volume, lod: int) -> None:
        self._volume = volume
        self.lod = lod
        self.stride = 1 << lod
        self.dtype = volume.dtype
        self.first = tuple(low % self.stride for low in volume.box.first)
        steps, *space = volume.shape
        self.shape = (
            steps,
            *(-(-(n - o) // self.stride) for n, o in zip(space, self.first, strict=True)),
        )
        time, *sides = volume.chunks
        self.tile = (time, *(-(-side // self.stride) for side in sides))
        self._box = Box.of(
            ((low - o) // self.stride, (low - o) // self.stride - (low - high) // self.stride)
            for (low, high), o in zip(volume.box, self.first, strict=True)
        )
        self._locks = [ForkLock() for _ in range(LOCKS)]

    def vertices(self, axis: int) -> slice:
        """The vertices of the domain along an axis of (z, y, x) that the level has."""
        return slice(self.first[axis], None, self.stride)

    def holds(self, region: Region) -> bool:
        """Whether a region (t, z, y, x) of the level meets the feature bounding box."""
        return self._common(region) is not None

    def read(self, region: Region) -> npt.NDArray[Any]:
        """The values (t, z, y, x) of a region of the level, of `dtype`.

        They have the volume's fill value, or NaN, where there is no value. Raises DamagedFileError
        for a damaged tile.
        """
        with self._lock(region):
            return self._volume[region] if self.lod == 0 else self._coarse(region)

    def _coarse(self, region: Region) -> npt.NDArray[Any]:
        """The values of a region of a level of detail that is not 0."""
        volume = self._volume
        time, *space = region
        shape = [along.stop - along.start for along in region]
        floats = self.dtype.kind == "f"
        empty = np.nan if floats and volume.fill is None else volume.fill
        result = np.full(shape, empty, dtype=self.dtype)
        common = self._common(region)
        if common is not None:
            place = common.shift(-along.start for along in space).slices()
            spans = Box.of(
                (o + low * self.stride, o + (high - 1) * self.stride + 1)
                for (low, high), o in zip(common, self.first, strict=True)
            )
            for number, step in enumerate(range(time.start, time.stop)):
                values, counted = volume.decoded_lod(step, self.lod, spans)
                np.copyto(result[number][place], values, where=counted, casting="same_kind")
        return result

    def _common(self, region: Region) -> Box | None:
        """The vertices of the level that a region shares with the feature bounding box."""
        return self._box.intersect(Box.of((along.start, along.stop) for along in region[1:]))

    def _lock(self, region: Sequence[slice]) -> ForkLock:
        """The lock of the tile that a region begins in.

        Several chunks of one tile are asked for at once, one step each. The first request decodes
        the tile, and the others wait for it rather than decode it too.
        """
        first = (0, *self._box.first)
        place = tuple(
            (along.start - low) // side
            for along, low, side in zip(region, first, self.tile, strict=True)
        )
        return self._locks[hash(place) % LOCKS]
