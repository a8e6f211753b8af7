"""The coded table of a compact file, and what the header says of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy.typing as npt

from fhash_codec.compact.plan import CodingPlan
from fhash_codec.compact.tiles.blocks import Index
from fhash_codec.compact.tiles.coding import Outcome
from fhash_codec.config import EncodeConfig
from fhash_codec.header import GAIN
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.container.table_parts import TableParts
from fhash_formats.transform.values.elementwise import at_origin

__all__ = ["CodedTable", "DecodedTiles", "model_header"]

DecodedTiles = Mapping[Index, npt.NDArray[Any]]
"""Tiles as they decode, in the type of the source."""


@dataclass(frozen=True, kw_only=True)
class CodedTable:
    """All tiles of a series, coded."""

    plan: CodingPlan
    """Tiles and settings."""
    streams: list[bytes]
    """Stream of each tile, in C order."""
    outcome: Outcome
    """Size and error of all tiles."""
    decoded: DecodedTiles = field(default_factory=dict)
    """All tiles as they decode, less the origin, where the plan keeps them."""
    bulk: ValueRange | None = None
    """Bulk of the values that count, in data units; None if they have none."""

    @property
    def in_source(self) -> DecodedTiles:
        """The decoded tiles in the type of the source."""
        origin, dtype = self.plan.blocks.origin, self.plan.blocks.source_dtype
        if not origin:
            return self.decoded
        return {index: at_origin(tile, origin, dtype) for index, tile in self.decoded.items()}

    @cached_property
    def parts(self) -> TableParts:
        """The arrays that the container has of the table."""
        blocks = self.plan.blocks
        return TableParts(
            shape=blocks.shape,
            dtype=blocks.source_dtype,
            tile=blocks.tile,
            settings=replace(self.plan.settings, origin=blocks.origin),
            streams=self.streams,
        )


def model_header(table: CodedTable, config: EncodeConfig) -> dict[str, Any]:
    """Return what the header of a compact file says of its model."""
    blocks, head = table.plan.blocks, table.plan.settings.head
    weights = 0 if head is None else head.size
    return {
        "profile": "compact",
        "levels": [list(blocks.shape)],
        "embedding_size": 1,
        "tables": blocks.source_dtype.name,
        "parameters": table.outcome.nonzero + weights,
        "head": None if head is None else {"hidden": list(head.hidden), "cross": head.cross},
        "gains": [
            [gain[name] for name in (GAIN if config.timings else GAIN[:-1]) if name in gain]
            for gain in table.plan.gains
        ],
    }
