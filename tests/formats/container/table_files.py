"""Containers with a coded table of two tiles, whose head and masks lie in arrays of their own."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.container import ContainerWriter
from fhash_formats.container.apart import HEAD_ARRAY, MASK_ARRAY, TABLE, with_settings
from fhash_formats.container.coding import CRC32C, transform_codecs
from fhash_formats.container.sharding import shard_shape
from fhash_formats.container.table_parts import TableParts
from fhash_formats.transform.axes.spec import TransformSpec
from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.head.head import Layer, NeighbourHead
from fhash_formats.transform.parts import FEATURE, head_parameters
from fhash_formats.transform.tile.apart import split_mask
from fhash_formats.transform.tile.encoding import encode_tile
from fhash_formats.transform.tile.settings import TileSettings

SHAPE = (4, 3, 4, 6)
TILE = (4, 3, 4, 4)
HEAD = NeighbourHead(
    layers=tuple(
        Layer(
            weights=np.random.default_rng(0).integers(-20, 21, shape).astype(np.int8),
            biases=np.arange(shape[0], dtype=np.int8),
            weight_scale=0.03125,
            bias_scale=0.0078125,
        )
        for shape in ((3, 28), (1, 3))
    ),
    sigma=0.125,
    low=-2.0,
    high=3.0,
)
PLAIN = TileSettings(
    transform=TransformSpec.from_dict(dict.fromkeys("tzyx", "none")),
    step=0.1,
    center=0.5,
    low=-2.0,
    high=3.0,
)
MASK = MaskLevels(edges=(0.0,), scores=(0, 300))


class PartsApart(TableParts):
    """A table whose head and masks lie in arrays of their own, as in large files of 1.4 to 1.7."""

    @classmethod
    def of(cls, parts: TableParts) -> PartsApart:
        return cls(**{field.name: getattr(parts, field.name) for field in fields(parts)})

    @property
    def _masks(self) -> list[bytes]:
        """The mask of each tile; none where they would say nothing."""
        masks = [split_mask(stream)[1] for stream in self.streams]
        return masks if self.settings.mask is not None and any(masks) else []

    @property
    def features(self) -> list[str]:
        apart = self.settings.head is not None or self._masks
        return ["transform", *([FEATURE] if apart else []), *self.settings.features]

    def write(self, writer: ContainerWriter) -> None:
        codecs, streams = transform_codecs(self.settings), self.streams
        if (head := self.settings.head) is not None:
            codecs = with_settings(codecs, {"head": {"array": HEAD_ARRAY}})
        if self._masks:
            mask = {"array": MASK_ARRAY, **codecs[0]["configuration"]["mask"]}
            codecs = with_settings(codecs, {"mask": mask})
            streams = [split_mask(stream)[0] for stream in streams]
        self._write_tiles(writer, TABLE, streams, self.dtype, codecs)
        if head is not None:
            packed = head.to_bytes()
            shape = head_parameters(packed).shape
            writer.add_array(
                HEAD_ARRAY,
                shape=shape,
                dtype=np.float32,
                chunk_shape=shape,
                chunks=[packed],
                codecs=[{"name": "fhash.head"}, CRC32C],
            )
        if self._masks:
            codecs = [{"name": "fhash.mask"}, CRC32C]
            self._write_tiles(writer, MASK_ARRAY, self._masks, np.dtype(np.uint8), codecs)

    def _write_tiles(self, writer, name, chunks, dtype, codecs) -> None:
        grid = [-(-n // length) for n, length in zip(self.shape, self.tile, strict=True)]
        writer.add_sharded(
            name,
            shape=self.shape,
            dtype=dtype,
            chunk_shape=self.tile,
            shard_shape=shard_shape(self.tile, grid),
            chunks=iter(chunks),
            dimension_names=("t", "z", "y", "x"),
            codecs=codecs,
        )


def table_parts(*, head: bool = True, mask: bool = True) -> TableParts:
    """A table of two tiles; the first one's vertices are occupied where values are above 0."""
    settings = replace(PLAIN, head=HEAD if head else None, mask=MASK if mask else None)
    values = np.random.default_rng(1).normal(0.5, 0.8, (*SHAPE[:3], 8)).clip(-2, 3).astype("f4")
    tiles = [values[..., :4], values[..., 4:]]
    occupied = [tiles[0] > 0, np.ones(TILE, bool)]
    streams = [
        encode_tile(tile, settings, **({"in_coreset": inside} if mask else {})).data
        for tile, inside in zip(tiles, occupied, strict=True)
    ]
    return TableParts(
        shape=SHAPE, dtype=np.dtype("f4"), tile=TILE, settings=settings, streams=streams
    )


def write_table(path: Path, header: dict[str, Any], parts: TableParts, *, apart: bool) -> Path:
    """A container with the table: in its parts, or as versions before 1.4 wrote it; its path."""
    with ContainerWriter(path, force=True) as writer:
        if apart:
            parts = PartsApart.of(parts)
            parts.write(writer)
            features = parts.features
        else:
            writer.add_sharded(
                "tables/level_1",
                shape=parts.shape,
                dtype=parts.dtype,
                chunk_shape=parts.tile,
                shard_shape=(4, 3, 4, 8),
                chunks=iter(parts.streams),
                codecs=transform_codecs(parts.settings),
            )
            features = ["transform", *parts.settings.features]
        writer.commit({**header, "required_features": features})
    return path
