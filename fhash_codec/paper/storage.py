"""A trained model and its coreset as arrays of a container, and back. numpy only.

Tables are arrays of numbers, or with `--tables transform` coded: then each level has an array per component, and an embedding is a mixture
of the components (`mixed`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite, prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.network import Floats, Network, TableSource
from fhash_formats.container import Container, ContainerWriter, StoredArray
from fhash_formats.errors import DamagedFileError, InputError

CHUNK_BYTES = (
    2 << 20
)  # a time node in one chunk up to this size, in bricks above: each chunk has a fixed cost, each read a whole chunk
TABLE_AXES = ("t", "z", "y", "x", "embedding")


def write_model(
    writer: ContainerWriter,
    architecture: Architecture,
    coreset: Coreset,
    layers: list[tuple[Floats, Floats]],
) -> None:
    """Write MLP and occupancy. layers: (weight (out, in), bias (out,))."""
    for number, (weight, bias) in enumerate(layers, start=1):
        writer.add_whole(f"mlp/weight_{number}", weight)
        writer.add_whole(f"mlp/bias_{number}", bias)
    bits = np.stack(coreset.occupancy)
    writer.add_whole("occupancy/bits", bits, chunk_shape=(1, bits.shape[1]))


def write_tables(
    writer: ContainerWriter,
    architecture: Architecture,
    coreset: Coreset,
    fine: Floats,
    tables: list[Floats],
    kind: str,
) -> None:
    """Write the tables as numbers of the type `kind`.

    fine: the finest embeddings (bricks, E, vertices of a brick); tables: the coarser ones (buckets, E).
    Raises InputError where the numbers do not fit in `kind`.
    """
    size = architecture.embedding_size
    _write_table(
        writer,
        1,
        (*architecture.levels[0], size),
        fine,
        (finest_frame(coreset, fine, k) for k in range(architecture.key_frames)),
        kind,
    )
    for number, (level, table) in enumerate(
        zip(architecture.levels[1:], tables, strict=True), start=2
    ):
        _write_table(writer, number, (*level, size), table, iter(table.reshape(*level, size)), kind)


def finest_frame(coreset: Coreset, fine: Floats, key: int) -> Floats:
    """The finest table (z, y, x, E) of one key frame from its bricks; 0 where no brick lies."""
    size = fine.shape[1]
    grid, shape = coreset.brick_grid, coreset.brick_shape
    blocks = np.zeros((*grid, *shape, size), dtype=np.float32)
    chosen = np.flatnonzero(coreset.bricks[:, 0] == key)
    z, y, x = coreset.bricks[chosen, 1:].T
    blocks[z, y, x] = np.moveaxis(fine[chosen].reshape(-1, size, *shape), 1, -1)
    padded = blocks.transpose(0, 3, 1, 4, 2, 5, 6).reshape(
        *(g * s for g, s in zip(grid, shape, strict=True)), size
    )
    return np.ascontiguousarray(padded[tuple(slice(length) for length in coreset.box.shape)])


def load_network(container: Container) -> Network:
    """The model in a container, its tables read on demand; DamagedFileError if its parts do not fit together."""
    header = container.header
    model = header["model"]
    levels = tuple(tuple(level) for level in model["levels"])
    layers = tuple(
        (container.arrays[f"mlp/weight_{n}"].read(), container.arrays[f"mlp/bias_{n}"].read())
        for n in range(1, model["hidden_layers"] + 2)
    )
    try:
        return Network(
            levels=levels,
            embedding_size=model["embedding_size"],
            tables=[
                _table(container, n, model["embedding_size"]) for n in range(1, len(levels) + 1)
            ],
            layers=layers,
            box_size=Box.of(header["feature_bounding_box"]).shape,
            key_frames=levels[0][0],
        )
    except InputError as error:
        raise DamagedFileError(f"{container.path}: {error}") from error


def _table(container: Container, level: int, size: int) -> TableSource:
    """The table of a level, in whichever way it is stored."""
    if container.header["model"]["tables"] == "transform":
        return CodedTable(
            [container.arrays[component_name(level, number)] for number in range(1, size + 1)]
        )
    return StoredTable(container.arrays[f"tables/level_{level}"])


def component_name(level: int, number: int) -> str:
    """The array of one component of a coded level, both counted from 1."""
    return f"tables/level_{level}/component_{number}"


def mixed(components: Sequence[Floats], mixing: Floats) -> Floats:
    """Embeddings float32 (..., E) from E components (...): embedding e is the sum of component j times mixing[j, e].

    In float32, each product and each sum rounded, from the first component on: the same bits on every machine.
    """
    result = np.empty((*components[0].shape, mixing.shape[1]), np.float32)
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # of hostile numbers; the network refuses what is not finite
        for number in range(mixing.shape[1]):
            total = components[0] * mixing[0, number]
            for component, weights in zip(components[1:], mixing[1:], strict=True):
                total = total + component * weights[number]
            result[..., number] = total
    return result


class CodedTable:
    """A level's table whose components are coded, as the decoder reads it."""

    def __init__(self, arrays: Sequence[StoredArray]) -> None:
        self.arrays = arrays
        self.shape = (*arrays[0].shape, len(arrays))
        with np.errstate(over="ignore"):
            self.mixing = np.array([array.attributes["mixing"] for array in arrays], np.float32)

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Embeddings of a region, float32."""
        return mixed([array.read(region[:4]) for array in self.arrays], self.mixing)[..., region[4]]


class StoredTable:
    """A level's table in a container, as the decoder reads it."""

    def __init__(self, array: StoredArray) -> None:
        self.array = array
        self.shape = array.shape
        self.scale = np.float32(array.attributes.get("scale", 1.0))
        self.offset = np.float32(array.attributes.get("offset", 0.0))

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Embeddings of a region: quantised ones as offset + scale * number, float32; others as they are stored."""
        values = self.array.read(region)
        return values if self.array.dtype.kind == "f" else values * self.scale + self.offset


def table_chunk(shape: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """Chunk of a table (t, z, y, x, E): one time node, halved along its longest axis until it takes at most 2 MiB."""
    chunk = [1, *shape[1:]]
    while prod(chunk) * itemsize > CHUNK_BYTES and max(chunk[1:4]) > 1:
        axis = 1 + int(np.argmax(chunk[1:4]))
        chunk[axis] = -(-chunk[axis] // 2)
    return tuple(chunk)


@dataclass(frozen=True, kw_only=True)
class NumberType:
    """How embeddings stand in a file: as `dtype`, of 8 bits as offset + scale * number."""

    dtype: np.dtype[Any]
    scale: float = 1.0
    offset: float = 0.0

    @classmethod
    def of(cls, values: Floats, kind: str) -> NumberType:
        """That of embeddings to be stored as `kind`; raises InputError where they do not fit in it or are not finite."""
        dtype = np.dtype(kind)
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
        if not (isfinite(low) and isfinite(high)):
            raise InputError(
                "embeddings are not finite: the training diverged; set a lower --learning-rate"
            )
        if dtype.kind == "u":
            # Zero, which stands wherever nothing was trained, is within the range, so that it costs little.
            low, high = min(low, 0.0), max(high, 0.0)
        reached = high - low if dtype.kind == "u" else max(-low, high)
        if reached > float(np.finfo(np.float32 if dtype.kind == "u" else dtype).max):
            raise InputError(
                f"embeddings reach {reached:g}, more than {kind} holds; use --tables float32"
            )
        if dtype.kind == "f":
            return cls(dtype=dtype)
        # A step that float32 does not hold to all its digits would not give back what it was made from.
        scale = (
            max((high - low) / np.iinfo(dtype).max, float(np.finfo(np.float32).tiny))
            if high > low
            else 1.0
        )
        return cls(dtype=dtype, scale=scale, offset=low)

    def stored(self, embeddings: Floats) -> npt.NDArray[Any]:
        """Embeddings as numbers of the type, of the same shape."""
        if self.dtype.kind == "f":
            return embeddings.astype(self.dtype)
        return np.asarray(
            np.rint(embeddings / self.scale - self.offset / self.scale).astype(self.dtype)
        )


def _write_table(
    writer: ContainerWriter,
    number: int,
    shape: tuple[int, ...],
    values: Floats,
    frames: Iterator[Floats],
    kind: str,
) -> None:
    """Write one level from its frames (z, y, x, E), one time node at a time."""
    numbers = NumberType.of(values, kind)
    dtype = numbers.dtype
    attributes = {"offset": numbers.offset, "scale": numbers.scale} if dtype.kind == "u" else None

    chunk = table_chunk(shape, dtype.itemsize)

    def chunks() -> Iterator[npt.NDArray[Any]]:
        for frame in frames:
            node = numbers.stored(frame)[None]
            for start in np.ndindex(*(-(-n // c) for n, c in zip(node.shape, chunk, strict=True))):
                yield node[
                    tuple(slice(i * c, (i + 1) * c) for i, c in zip(start, chunk, strict=True))
                ]

    writer.add_array(
        f"tables/level_{number}",
        shape=shape,
        dtype=dtype,
        chunk_shape=chunk,
        chunks=chunks(),
        dimension_names=TABLE_AXES,
        attributes=attributes,
    )
