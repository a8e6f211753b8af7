"""Containers with one array of tiles beside the table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.container import ContainerWriter
from fhash_formats.container.array import TRANSFORM, ArrayMetadata

NAME = "extra/values"
CODECS = [{"name": TRANSFORM, "configuration": {}}]
"""Codecs of tiles without settings: differences of neighbours, without loss."""


def chunk_of(values: np.ndarray, index: Sequence[int], chunk_shape: Sequence[int]) -> np.ndarray:
    """The chunk of an array at an index of its grid."""
    return values[tuple(slice(i * n, (i + 1) * n) for i, n in zip(index, chunk_shape, strict=True))]


def random_values(shape: tuple[int, ...]) -> np.ndarray:
    """Values float32 of a shape, the same at every call."""
    return np.random.default_rng(3).standard_normal(shape).astype(np.float32)


def tiled(
    values: np.ndarray, tile: tuple[int, ...], together: tuple[int, ...] | None = None
) -> ArrayMetadata:
    """Metadata of an array of tiles."""
    return ArrayMetadata(
        shape=values.shape,
        dtype=values.dtype,
        chunk_shape=tile,
        codecs=CODECS,
        together=together or (1,) * values.ndim,
    )


def tiles_of(metadata: ArrayMetadata) -> list[tuple[int, ...]]:
    """The tiles in the order of the file."""
    return [
        index
        for member in product(*map(range, metadata.members))
        for index in metadata.chunks_of(member)
    ]


def write_tiled(
    path: Path,
    samples: Any,
    values: np.ndarray,
    tile: tuple[int, ...],
    together: tuple[int, ...] | None = None,
    chunks: Iterable[Any] | None = None,
    **options: Any,
) -> Path:
    """Write a compact container with one more array, NAME, of tiles; its path."""
    header = samples.compact_header()
    if chunks is None:
        order = tiles_of(tiled(values, tile, together))
        chunks = (chunk_of(values, index, tile) for index in order)
    with ContainerWriter(path, force=True) as writer:
        writer.add_whole("table_1", np.zeros(header["model"]["levels"][0], dtype=np.float32))
        settings = {
            "shape": values.shape,
            "dtype": values.dtype,
            "chunk_shape": tile,
            "together": together,
            "codecs": CODECS,
            **options,
        }
        writer.add_array(NAME, chunks=chunks, **settings)
        writer.commit(header)
    return path
