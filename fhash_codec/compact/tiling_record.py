"""Record of the tiles in a header: what they cost in bytes, and how soon a region is read."""

from __future__ import annotations

import time
from math import prod
from typing import Any

from fhash_codec.compact.coded_table import CodedTable
from fhash_codec.compact.tiles.access import region_vertices
from fhash_formats.transform.tile.decoding import decode_tile

__all__ = ["measure_region", "tiling_header"]


def tiling_header(table: CodedTable, *, timings: bool, quick: bool) -> dict[str, Any] | None:
    """Return what a header says of the tiles; None where there is nothing to say.

    Keys: `price`, bytes as a multiple of those of the best tiling; `best`, the tile of that one;
    `tried`, the number of tilings that were coded, 0 where the price is foretold; `region_ms`, see
    `measure_region`. Tiles that were asked for have the last alone.

    timings: whether times may be told.
    quick: whether there is no time to measure one.
    """
    record: dict[str, Any] = {}
    tiling = table.plan.tiling
    if tiling is not None and tiling.price is not None:
        record = {
            "price": round(tiling.price, 3),
            "best": list(tiling.best or table.plan.blocks.shape),
            "tried": len(tiling.trials),
        }
    if timings and not quick:
        record["region_ms"] = round(1000 * measure_region(table), 2)
    return record or None


def measure_region(table: CodedTable) -> float:
    """Return the seconds in which a region of 16^3 vertices of a step is decoded, in the mean.

    The tile of the median size is decoded on one thread. The rest of an access (the opening of the
    file, the read from a disk) is not in it.
    """
    blocks = table.plan.blocks
    stream = sorted(table.streams, key=len)[len(table.streams) // 2]
    begun = time.perf_counter()
    decode_tile(stream, blocks.tile, blocks.dtype, table.plan.settings)
    seconds = time.perf_counter() - begun
    return seconds * region_vertices(blocks.shape, blocks.tile) / prod(blocks.tile)
