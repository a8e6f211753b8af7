"""From what a writer is given to the bytes of a member: chunks cut and padded, shards joined."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.coding import with_crc32c
from fhash_formats.container.sharding import Sharding, pack_index
from fhash_formats.errors import InputError

Coded = npt.NDArray[Any] | bytes
"""A chunk: its values, or the bytes that its coder made of them."""


def cut(array: npt.NDArray[Any], chunk_shape: Sequence[int]) -> Iterator[npt.NDArray[Any]]:
    """The chunks of an array in memory, in C order."""
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


def expect_end(name: str, metadata: ArrayMetadata, given: Iterator[Any]) -> None:
    """Raise InputError if more chunks were given than the array has."""
    if next(given, None) is not None:
        grid = metadata.inner_grid
        raise InputError(
            f"array {name}: more chunks were given than the {prod(grid)} of the grid {grid}"
        )


def shard_parts(
    name: str,
    metadata: ArrayMetadata,
    sharding: Sharding,
    shard: tuple[int, ...],
    given: Iterator[Coded | tuple[tuple[int, ...], Coded]],
) -> list[bytes]:
    """The parts of a shard: its inner chunks in C order, and its index."""
    wanted: dict[tuple[int, ...], bytes | None] = dict.fromkeys(
        sharding.chunks_of(shard, metadata.shape)
    )
    for expected in list(wanted):
        item = next(given, None)
        if item is None:
            raise InputError(
                f"array {name}: chunk {expected} was not given; the grid has {metadata.inner_grid}"
            )
        index, chunk = item if isinstance(item, tuple) else (expected, item)
        if wanted.get(index, b"") is not None:
            raise InputError(
                f"array {name}: chunk {index} is none of shard {shard}, or was given twice"
            )
        if isinstance(chunk, bytes):
            wanted[index] = with_crc32c(chunk)
        else:
            wanted[index] = metadata.coder.encode(full_chunk(name, metadata, index, chunk))
    parts = [part for part in wanted.values() if part is not None]
    return [
        *parts,
        pack_index([len(part) for part in parts], sharding.present(shard, metadata.shape)),
    ]


def full_chunk(
    name: str, metadata: ArrayMetadata, index: Sequence[int], chunk: npt.NDArray[Any]
) -> npt.NDArray[Any]:
    """A chunk padded with 0 to the full shape, as Zarr stores those at an end of the array."""
    expected = tuple(part.stop - part.start for part in metadata.inner_region(index))
    if chunk.shape != expected or chunk.dtype.newbyteorder("=") != metadata.dtype:
        raise InputError(
            f"array {name}: chunk {tuple(index)} is {chunk.dtype} {chunk.shape}; {metadata.dtype} {expected} is needed"
        )
    if expected == metadata.inner_shape:
        return chunk
    full = np.zeros(metadata.inner_shape, dtype=metadata.dtype)
    full[tuple(slice(0, n) for n in expected)] = chunk
    return full
