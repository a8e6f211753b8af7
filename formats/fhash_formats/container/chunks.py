"""Arrays cut into chunks, chunks padded and coded, and coded chunks joined to shards."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.sharding import Sharding, pack_index
from fhash_formats.errors import InputError

Coded = npt.NDArray[Any] | bytes
"""A chunk to write: its values, or the bytes that the coder of its first codec made of them."""


def cut(array: npt.NDArray[Any], chunk_shape: Sequence[int]) -> Iterator[npt.NDArray[Any]]:
    """Yield the chunks of an array in memory, in C order; the last along an axis may be shorter."""
    starts = (
        range(0, n, max(1, chunk)) for n, chunk in zip(array.shape, chunk_shape, strict=False)
    )
    for corner in product(*starts):
        yield array[
            tuple(
                slice(start, start + chunk)
                for start, chunk in zip(corner, chunk_shape, strict=False)
            )
        ]


def expect_end(name: str, metadata: ArrayMetadata, chunks: Iterator[Any]) -> None:
    """Raise InputError if chunks are left that the grid of the array has no place for."""
    if next(chunks, None) is not None:
        grid = metadata.inner_grid
        raise InputError(
            f"array {name}: more chunks were given than the {prod(grid)} of the grid {grid}"
        )


def shard_parts(
    name: str,
    metadata: ArrayMetadata,
    sharding: Sharding,
    shard: tuple[int, ...],
    chunks: Iterator[Coded | tuple[tuple[int, ...], Coded]],
) -> list[bytes]:
    """The parts of a shard, in the order of the file: its inner chunks in C order, and its index.

    Args:
        name: the array's, for messages.
        metadata: the array's.
        sharding: the array's.
        shard: index of the shard.
        chunks: takes the shard's inner chunks from here, each alone (then in C order) or with its
            index in the array's grid of inner chunks (then in any order).

    Raises:
        InputError: if an inner chunk is missing, given twice, or does not fit.
    """
    coded: dict[tuple[int, ...], bytes | None] = dict.fromkeys(
        sharding.chunks_of(shard, metadata.shape)
    )
    for expected in list(coded):
        item = next(chunks, None)
        if item is None:
            raise InputError(
                f"array {name}: chunk {expected} was not given; the grid has {metadata.inner_grid}"
            )
        index, chunk = item if isinstance(item, tuple) else (expected, item)
        if coded.get(index, b"") is not None:
            raise InputError(
                f"array {name}: chunk {index} is none of shard {shard}, or was given twice"
            )
        coded[index] = coded_chunk(name, metadata, index, chunk)
    inner_chunks = [data for data in coded.values() if data is not None]
    return [
        *inner_chunks,
        pack_index([len(data) for data in inner_chunks], sharding.present(shard, metadata.shape)),
    ]


def coded_chunk(name: str, metadata: ArrayMetadata, index: Sequence[int], chunk: Coded) -> bytes:
    """The bytes of a chunk, from its values or as they are.

    Raises InputError as `full_chunk` does.
    """
    if isinstance(chunk, bytes):
        return chunk
    return metadata.coder.encode(full_chunk(name, metadata, index, chunk))


def full_chunk(
    name: str, metadata: ArrayMetadata, index: Sequence[int], chunk: npt.NDArray[Any]
) -> npt.NDArray[Any]:
    """A chunk padded with 0 to the full shape, as Zarr stores those at an end of the array.

    Raises InputError for a chunk of another shape or number type than the array needs at `index`.
    """
    expected = tuple(span.stop - span.start for span in metadata.inner_region(index))
    if chunk.shape != expected or chunk.dtype.newbyteorder("=") != metadata.dtype:
        raise InputError(
            f"array {name}: chunk {tuple(index)} is {chunk.dtype} {chunk.shape}; "
            f"{metadata.dtype} {expected} is needed"
        )
    if expected == metadata.inner_shape:
        return chunk
    full = np.zeros(metadata.inner_shape, dtype=metadata.dtype)
    full[tuple(slice(0, n) for n in expected)] = chunk
    return full
