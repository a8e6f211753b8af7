"""Containers with a coded table of two tiles, with a head and masks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.container import ContainerWriter
from fhash_formats.container.growing import TableParts
from fhash_formats.transform.head import Layer, NeighbourHead
from fhash_formats.transform.spec import MaskLevels, TransformSpec
from fhash_formats.transform.tile import encode_tile
from fhash_formats.transform.tile_format import TileSettings

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


def table_parts(*, head: bool = True, mask: bool = True, seed: int = 1) -> TableParts:
    """A table of two tiles; the first one's vertices are occupied where values are above 0."""
    settings = replace(PLAIN, head=HEAD if head else None, mask=MASK if mask else None)
    values = np.random.default_rng(seed).normal(0.5, 0.8, (*SHAPE[:3], 8)).clip(-2, 3).astype("f4")
    tiles = [values[..., :4], values[..., 4:]]
    occupied = [tiles[0] > 0, np.ones(TILE, bool)]
    streams = [
        encode_tile(tile, settings, **({"in_coreset": inside} if mask else {})).data
        for tile, inside in zip(tiles, occupied, strict=True)
    ]
    return TableParts(
        shape=SHAPE, dtype=np.dtype("f4"), tile=TILE, settings=settings, streams=streams
    )


def write_table(path: Path, header: dict[str, Any], parts: TableParts) -> Path:
    """A container with the table; its path."""
    with ContainerWriter(path, force=True) as writer:
        parts.write(writer)
        writer.commit({**header, "required_features": ["transform"]})
    return path
