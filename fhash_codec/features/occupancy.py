"""Occupancy: one bit per voxel, packed into bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from fhash_formats.container import Container, ContainerWriter
from fhash_formats.container.header import BITS_ARRAY, CORESET_ARRAY, EVERYTHING

BLOCK = "block"
"""Attribute of the occupancy: vertices of a block along each axis; 1 without it."""
BLOCK_SHARE = 100
"""The bits of blocks take at most this part of the bytes of the tiles: one percent."""
CHUNK_BYTES = 1 << 20
"""Bytes of one chunk of an array of bits. A member for each row would cost 130 bytes."""

Shape = tuple[int, int, int]
"""Vertices per axis, (z, y, x)."""

Bits = npt.NDArray[np.uint8]
"""The packed grid of one key frame, uint8 (packed_bytes,)."""


def bit_order(shape: Shape) -> list[tuple[int, int]]:
    """Pairs (axis, bit of that axis) for the bits of the Morton index, lowest first.

    Axis 0 is z, axis 2 is x.
    """
    widths = [(size - 1).bit_length() for size in shape]
    return [(axis, bit) for bit in range(max(widths)) for axis in (2, 1, 0) if bit < widths[axis]]


def morton_index(
    z: npt.ArrayLike, y: npt.ArrayLike, x: npt.ArrayLike, shape: Shape
) -> npt.NDArray[np.int64]:
    """Bit numbers of vertices in the grid of a box: the definition of the order.

    z, y, x: indices of the vertices; they broadcast. shape: of the box.
    """
    vertex = [np.asarray(axis, dtype=np.int64) for axis in (z, y, x)]
    index = np.zeros(np.broadcast_shapes(*(axis.shape for axis in vertex)), dtype=np.int64)
    for place, (axis, bit) in enumerate(bit_order(shape)):
        index |= ((vertex[axis] >> bit) & 1) << place
    return index


def packed_bytes(shape: Shape) -> int:
    """Bytes of the grid of a box."""
    return max(1, (1 << len(bit_order(shape))) // 8)


def between(a: Bits, b: Bits) -> Bits:
    """The grid between two key frames: a voxel is occupied if it is at either of them."""
    return a | b


def pack(mask: npt.NDArray[np.bool_]) -> Bits:
    """The packed grid of a mask (z, y, x).

    A block of 8 vertices fills one byte, and the bytes go to their Morton places.
    """
    shape = _shape(mask)
    steps, offsets = _byte_block(shape)
    blocks = np.zeros(
        [-(-size // step) for size, step in zip(shape, steps, strict=True)], dtype=np.uint8
    )
    for place, (z, y, x) in enumerate(offsets):
        vertices = mask[z :: steps[0], y :: steps[1], x :: steps[2]].view(np.uint8)
        blocks[_corner(vertices)] |= vertices << (7 - place)
    bits = np.zeros(packed_bytes(shape), dtype=np.uint8)
    for plane, index in zip(blocks, _byte_indices(blocks.shape, steps, shape), strict=True):
        bits[index] = plane
    return bits


def unpack(bits: Bits, shape: Shape) -> npt.NDArray[np.bool_]:
    """The mask (z, y, x) of a packed grid: the inverse of `pack`."""
    steps, offsets = _byte_block(shape)
    blocks = np.empty(
        [-(-size // step) for size, step in zip(shape, steps, strict=True)], dtype=np.uint8
    )
    for plane, index in zip(blocks, _byte_indices(blocks.shape, steps, shape), strict=True):
        plane[...] = bits[index]
    mask = np.empty(shape, dtype=np.uint8)
    for place, (z, y, x) in enumerate(offsets):
        vertices = mask[z :: steps[0], y :: steps[1], x :: steps[2]]
        vertices[...] = (blocks[_corner(vertices)] >> (7 - place)) & 1
    return mask.view(np.bool_)


def write_bits(
    writer: ContainerWriter,
    name: str,
    shape: Sequence[int],
    row: Callable[..., Bits],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write an array (..., rows, bytes) of bits, several rows to a chunk.

    row: gives the bytes of a row by its indices.
    """
    *outer, rows, size = shape
    together = max(1, min(rows, CHUNK_BYTES // size))

    def chunks() -> Iterator[Bits]:
        for index in np.ndindex(*outer):
            for start in range(0, rows, together):
                numbers = range(start, min(start + together, rows))
                chunk = np.stack([row(*index, number) for number in numbers])
                yield chunk.reshape((1,) * len(outer) + chunk.shape)

    writer.add_array(
        name,
        shape=shape,
        dtype=np.uint8,
        chunk_shape=(*(1 for _ in outer), together, size),
        chunks=chunks(),
        attributes=attributes,
    )


def has_blocks(masked: bool, features: Iterable[str]) -> bool:
    """Whether a file of the profile compact has the bits of blocks: where features were asked for.

    masked: whether its tiles have masks. features: as the header has them.
    """
    return masked and EVERYTHING not in features


def write_blocks(
    writer: ContainerWriter,
    masks: Callable[[int], npt.NDArray[np.bool_]],
    shape: Sequence[int],
    table_bytes: int,
) -> None:
    """Write which blocks of vertices have some of the coreset at each key frame.

    Args:
        writer: of a container whose tiles have exact masks.
        masks: gives the mask (z, y, x) of the box at a key frame.
        shape: key frames and lengths of the box.
        table_bytes: of the tiles, from which the size of the blocks follows; 0 for single vertices.
    """
    keys, *box = shape
    block = block_of(shape, table_bytes) if table_bytes else 1
    size = packed_bytes(blocks_of(box, block))
    write_bits(
        writer,
        BITS_ARRAY,
        (1, keys, size),
        lambda _, key: pack(any_of_blocks(masks(key), block)),
        {BLOCK: block} if block > 1 else None,
    )


def block_of(shape: Sequence[int], table_bytes: int) -> int:
    """Side of the blocks whose bits take at most BLOCK_SHARE of the bytes of the tiles.

    It is the least power of two; of few bytes that which makes one block of the box. The bytes are
    those of the bits as they are, so that whoever knows those of the tiles finds the same side.
    """
    keys, *box = shape
    block = 1
    while keys * packed_bytes(blocks_of(box, block)) * BLOCK_SHARE > table_bytes:
        if block >= max(box):
            break
        block *= 2
    return block


def blocks_of(box: Sequence[int], block: int) -> Shape:
    """Number of blocks along z, y and x."""
    z, y, x = (-(-length // block) for length in box)
    return z, y, x


def any_of_blocks(mask: npt.NDArray[np.bool_], block: int) -> npt.NDArray[np.bool_]:
    """Mask of the blocks that have a vertex of a mask (z, y, x); those at an end may be shorter."""
    for axis, length in enumerate(mask.shape):
        mask = np.logical_or.reduceat(mask, range(0, length, block), axis=axis)
    return mask


def read_bits(
    container: Container, first: int, end: int, features: Sequence[int] | None = None
) -> npt.NDArray[np.uint8]:
    """Grids (key frames, bytes) of `occupancy` from a key frame to before another.

    features: numbers of the features, counted from 0, whose union is taken; None for all.
    """
    stored = container.arrays[BITS_ARRAY]
    count, _, size = stored.shape
    numbers = range(count) if features is None else features
    rows = (stored.read((slice(n, n + 1), slice(first, end), slice(0, size)))[0] for n in numbers)
    return cast("npt.NDArray[np.uint8]", np.bitwise_or.reduce(list(rows)))


def read_occupancy(
    container: Container, first: int, end: int, features: Sequence[int] | None = None
) -> npt.NDArray[np.bool_]:
    """Mask (key frames, z, y, x) of the box from a key frame to before another.

    Arguments are those of `read_bits`.
    """
    z, y, x = container.header["model"]["levels"][0][1:]
    if CORESET_ARRAY not in container.arrays:
        grids = read_bits(container, first, end, features)
        return np.stack([unpack(bits, (z, y, x)) for bits in grids])
    space = (slice(0, z), slice(0, y), slice(0, x))
    numbers = container.arrays[CORESET_ARRAY].read((slice(first, end), *space))
    chosen = range(len(container.header["features"])) if features is None else features
    return np.asarray(numbers & np.uint8(sum(1 << number for number in set(chosen))) != 0)


def _shape(mask: npt.NDArray[np.bool_]) -> Shape:
    z, y, x = mask.shape
    return z, y, x


def _corner(vertices: Bits) -> tuple[slice, ...]:
    """The index of the first blocks along each axis, as many as an array has vertices."""
    return tuple(slice(length) for length in vertices.shape)


def _byte_block(shape: Shape) -> tuple[list[int], list[tuple[int, int, int]]]:
    """The block of vertices that shares a byte: its size (z, y, x), and its vertices.

    The vertices are offsets (z, y, x) in the block, in the order of the bits, lowest bit first.
    """
    lowest = bit_order(shape)[:3]
    steps = [2 ** sum(bit_axis == axis for bit_axis, _ in lowest) for axis in range(3)]
    offsets = []
    for number in range(2 ** len(lowest)):
        offset = [0, 0, 0]
        for bit, (axis, axis_bit) in enumerate(lowest):
            offset[axis] |= ((number >> bit) & 1) << axis_bit
        offsets.append((offset[0], offset[1], offset[2]))
    return steps, offsets


def _byte_indices(
    blocks: tuple[int, ...], steps: list[int], shape: Shape
) -> Iterator[npt.NDArray[np.int64]]:
    """Byte numbers (blocks y, blocks x) of each plane of byte blocks, from z = 0 on."""
    z, y, x = (np.arange(count) * step for count, step in zip(blocks, steps, strict=True))
    # z, y and x have different bits of the index: interleave each axis by itself, then join them.
    of_plane = morton_index(0, y[:, None], 0, shape) | morton_index(0, 0, x[None, :], shape)
    of_plane >>= 3
    for of_row in morton_index(z, 0, 0, shape) >> 3:
        yield of_plane | of_row
