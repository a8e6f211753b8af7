"""A coded table in its parts, as a container has them: tiles, and beside them head and masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.apart import HEAD_ARRAY, MASK_ARRAY, TABLE, place_head, place_masks
from fhash_formats.container.coding import CRC32C, HEAD, MASK, Codec, transform_codecs
from fhash_formats.container.sharding import shard_shape
from fhash_formats.container.writer import ContainerWriter
from fhash_formats.transform.head.head import NeighbourHead
from fhash_formats.transform.parts import FEATURE, head_parameters
from fhash_formats.transform.tile.apart import split_mask
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["TableParts"]

APART_BYTES = 1 << 17
"""Bytes of all streams from which on head and masks have arrays of their own.

Such an array takes 520 to 600 bytes for its documents and its entries in the ZIP, which is then
less than 0.5 % of the file.
"""


@dataclass(frozen=True, kw_only=True)
class TableParts:
    """The tiles of a table, coded.

    Attributes:
        shape: lengths of the axes (t, z, y, x).
        dtype: type of the values.
        tile: shape of a tile.
        settings: settings that all tiles share.
        streams: stream of each tile, in C order of their grid, masks included.
        apart: whether head and masks have arrays of their own; by default from APART_BYTES on.
        sizes: bytes of each stream, where they are known without reading it.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    tile: tuple[int, ...]
    settings: TileSettings
    streams: Sequence[bytes]
    apart: bool | None = None
    sizes: npt.NDArray[np.int64] | None = None

    @cached_property
    def _sizes(self) -> npt.NDArray[np.int64]:
        """Bytes of each stream."""
        return _lengths(self.streams) if self.sizes is None else self.sizes

    @cached_property
    def _apart(self) -> bool:
        """Whether head and masks have arrays of their own."""
        if self.apart is not None:
            return self.apart
        return int(self._sizes.sum()) >= APART_BYTES

    @cached_property
    def _split(self) -> tuple[Sequence[bytes], Sequence[bytes] | None]:
        """The streams without masks, and the masks; None where they stay in the streams."""
        if self._apart and self.settings.mask is not None:
            tiles, masks = zip(*map(split_mask, self.streams), strict=True)
            if any(masks):
                return tiles, masks
        return self.streams, None

    @property
    def _head(self) -> NeighbourHead | None:
        """The head that has an array of its own."""
        return self.settings.head if self._apart else None

    @property
    def features(self) -> list[str]:
        """Features of the format that a reader of the parts must know."""
        apart = self._head is not None or self._split[1] is not None
        return ["transform", *([FEATURE] if apart else []), *self.settings.features]

    def write(self, writer: ContainerWriter) -> None:
        """Write the table, and after it the head and the masks that have arrays of their own.

        There a reader finds the parts of the model by name. In a small file they stay in the codec
        and in the tiles.
        """
        codec, *checks = transform_codecs(self.settings)
        tiles, masks = self._split
        if self._head is not None:
            codec = place_head(codec)
        if masks is not None:
            codec = place_masks(codec)
        self._write_tiles(writer, TABLE, tiles, self.dtype, [codec, *checks])
        if self._head is not None:
            packed = self._head.to_bytes()
            shape = head_parameters(packed).shape
            writer.add_array(
                HEAD_ARRAY,
                shape=shape,
                dtype=np.float32,
                chunk_shape=shape,
                chunks=[packed],
                codecs=[{"name": HEAD}, CRC32C],
            )
        if masks is not None:
            self._write_tiles(writer, MASK_ARRAY, masks, np.uint8, [{"name": MASK}, CRC32C])

    def _write_tiles(
        self,
        writer: ContainerWriter,
        name: str,
        chunks: Sequence[bytes],
        dtype: npt.DTypeLike,
        codecs: Sequence[Codec],
    ) -> None:
        """Write an array of a chunk for each tile.

        A single tile needs no shard, whose index and description would take some 120 bytes.
        """
        described: dict[str, Any] = {
            "shape": self.shape,
            "dtype": dtype,
            "chunk_shape": self.tile,
            "dimension_names": ("t", "z", "y", "x"),
            "codecs": codecs,
        }
        if len(chunks) == 1:
            writer.add_array(name, chunks=chunks, **described)
            return
        grid = [-(-n // length) for n, length in zip(self.shape, self.tile, strict=True)]
        sizes = self._sizes if chunks is self.streams else _lengths(chunks)
        shards = shard_shape(self.tile, grid, sizes)
        writer.add_sharded(name, shard_shape=shards, chunks=iter(chunks), **described)


def _lengths(chunks: Sequence[bytes]) -> npt.NDArray[np.int64]:
    """Bytes of each chunk."""
    return np.fromiter(map(len, chunks), np.int64, len(chunks))
