"""The coded table of a compact file, and how it and its description are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fhash_codec.compact.plan import CodingPlan
from fhash_codec.compact.tiles.coding import Outcome
from fhash_codec.compact.tiles.tiling import shard_shape
from fhash_codec.config import EncodeConfig
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.container import ContainerWriter
from fhash_formats.container.coding import transform_codecs

__all__ = ["CodedTable", "model_header", "required_features", "write_table"]

TABLE = "tables/level_1"
"""Name of the table in the container."""


@dataclass(frozen=True, kw_only=True)
class CodedTable:
    """All tiles of a series, coded."""

    plan: CodingPlan
    """Tiles and settings."""
    streams: list[bytes]
    """Stream of each tile, in C order."""
    outcome: Outcome
    """Size and error of all tiles."""
    bulk: ValueRange | None = None
    """Bulk of the values that count, in data units; None if they have none."""


def write_table(writer: ContainerWriter, table: CodedTable) -> None:
    """Write the table; its tiles also hold the mask where the coreset is not the whole box.

    A single tile needs no shard, whose index and description would take some 120 bytes.
    """
    blocks, settings = table.plan.blocks, table.plan.settings
    described: dict[str, Any] = {
        "shape": blocks.shape,
        "dtype": blocks.dtype,
        "chunk_shape": blocks.tile,
        "dimension_names": ("t", "z", "y", "x"),
        "codecs": transform_codecs(settings),
    }
    if len(table.streams) == 1:  # a shard of one tile would cost 70 bytes more
        writer.add_array(TABLE, chunks=table.streams, **described)
        return
    shards = shard_shape(blocks.tile, blocks.grid)
    writer.add_sharded(TABLE, shard_shape=shards, chunks=iter(table.streams), **described)


def model_header(table: CodedTable, config: EncodeConfig) -> dict[str, Any]:
    """Return what the header of a compact file says of its model."""
    blocks, head = table.plan.blocks, table.plan.settings.head
    weights = 0
    if head is not None:
        weights = sum(layer.weights.size + layer.biases.size for layer in head.layers)
    return {
        "profile": "compact",
        "levels": [list(blocks.shape)],
        "embedding_size": 1,
        "tables": blocks.dtype.name,
        "parameters": table.outcome.nonzero + weights,
        "head": None if head is None else {"hidden": list(head.hidden), "cross": head.cross},
        "gains": [
            {name: value for name, value in gain.items() if config.timings or name != "seconds"}
            for gain in table.plan.gains
        ],
    }


def required_features(table: CodedTable) -> list[str]:
    """Return the features of the format that a reader of the file must know."""
    return ["transform", *table.plan.settings.features]
