"""A coded table, as a container has it: tiles in shards, and the settings that they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.coding import transform_codecs
from fhash_formats.container.header import TABLE
from fhash_formats.container.sharding import shard_shape
from fhash_formats.container.writer import ContainerWriter
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["TableParts"]


@dataclass(frozen=True, kw_only=True)
class TableParts:
    """The tiles of a table, coded.

    Head and masks stay in the codec and in the tiles, so that a library of Zarr that has the codec
    decodes the table by what the array itself says.

    Attributes:
        shape: lengths of the axes (t, z, y, x).
        dtype: type of the values.
        tile: shape of a tile.
        settings: settings that all tiles share.
        streams: stream of each tile, in C order of their grid, masks included.
        sizes: bytes of each stream, where they are known without reading it.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    tile: tuple[int, ...]
    settings: TileSettings
    streams: Sequence[bytes]
    sizes: npt.NDArray[np.int64] | None = None

    def write(self, writer: ContainerWriter) -> None:
        """Write the table, an array of a chunk for each tile.

        A single tile needs no shard, whose index and description would take some 120 bytes.
        """
        described: dict[str, Any] = {
            "shape": self.shape,
            "dtype": self.dtype,
            "chunk_shape": self.tile,
            "dimension_names": ("t", "z", "y", "x"),
            "codecs": transform_codecs(self.settings),
        }
        if len(self.streams) == 1:
            writer.add_array(TABLE, chunks=self.streams, **described)
            return
        grid = [-(-n // length) for n, length in zip(self.shape, self.tile, strict=True)]
        sizes = self.sizes
        if sizes is None:
            sizes = np.fromiter(map(len, self.streams), np.int64, len(self.streams))
        shards = shard_shape(self.tile, grid, sizes)
        writer.add_sharded(TABLE, shard_shape=shards, chunks=iter(self.streams), **described)
