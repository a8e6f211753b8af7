"""Containers with one array of shards."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.container import ContainerWriter, shard_order

NAME = "extra/values"
PATH = "parts/0.extra.values"
"""Path of this array in the file."""


def chunk_of(values: np.ndarray, index: Sequence[int], chunk_shape: Sequence[int]) -> np.ndarray:
    """The chunk of an array at an index of its grid."""
    return values[tuple(slice(i * n, (i + 1) * n) for i, n in zip(index, chunk_shape, strict=True))]


def random_values(shape: tuple[int, ...]) -> np.ndarray:
    """Values float32 of a shape, the same at every call."""
    return np.random.default_rng(3).standard_normal(shape).astype(np.float32)


def write_sharded(
    path: Path,
    samples: Any,
    values: np.ndarray,
    chunk_shape: tuple[int, ...],
    shard_shape: tuple[int, ...],
    chunks: Iterable[Any] | None = None,
    **options: Any,
) -> Path:
    """Write a compact container with one more array, NAME, which is sharded; its path."""
    header = samples.compact_header()
    if chunks is None:
        chunks = (
            chunk_of(values, index, chunk_shape)
            for index in shard_order(values.shape, chunk_shape, shard_shape)
        )
    with ContainerWriter(path, force=True) as writer:
        writer.add_whole("tables/level_1", np.zeros(header["model"]["levels"][0], dtype=np.float32))
        settings = {
            "shape": values.shape,
            "dtype": values.dtype,
            "chunk_shape": chunk_shape,
            "shard_shape": shard_shape,
            **options,
        }
        writer.add_array(NAME, chunks=chunks, **settings)
        writer.commit(header)
    return path
