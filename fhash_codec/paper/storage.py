"""A trained model and its coreset as arrays of a container, written and read. numpy only.

Tables are stored as arrays of numbers. With `--tables transform` they are coded instead: each level
then has one array per component, and an embedding is a mixture of the components
(`mix_components`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import isfinite, prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset import occupancy
from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.model_parts import TABLE_AXES
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.fringe import fringe_step, round_fringe
from fhash_codec.paper.network import Floats, Network, TableSource
from fhash_formats.container import Container, ContainerWriter, StoredArray
from fhash_formats.container.apart import MASK_ARRAY
from fhash_formats.errors import DamagedFileError, InputError

CHUNK_BYTES = 2 << 20
"""Bytes of the largest chunk of a table. Each chunk has a fixed cost; reads decode whole chunks."""
BITS = "occupancy/bits"
"""Array of the occupancy as bits."""
MASK_BITS = 8
"""Largest number of features that the numbers of the coded occupancy tell apart."""
MASK_FEATURE_BITS = "feature_bits"
"""Attribute of the coded occupancy that is true where its numbers have a bit for each feature."""


def write_model(
    writer: ContainerWriter, coreset: Coreset, layers: list[tuple[Floats, Floats]]
) -> None:
    """Write the occupancy of a coreset and of its features, and the layers (weight, bias)."""
    for number, (weight, bias) in enumerate(layers, start=1):
        writer.add_whole(f"mlp/weight_{number}", weight)
        writer.add_whole(f"mlp/bias_{number}", bias)
    _write_bits(writer, BITS, coreset.occupancy)
    write_features_apart(writer, coreset)


def write_features_apart(writer: ContainerWriter, coreset: Coreset) -> None:
    """Write the occupancy of each feature as bits, if there are several features."""
    for number, grids in enumerate(coreset.apart, start=1):
        _write_bits(writer, feature_bits(number), grids)


def _write_bits(writer: ContainerWriter, name: str, grids: Sequence[npt.NDArray[np.uint8]]) -> None:
    bits = np.stack(grids)
    writer.add_whole(name, bits, chunk_shape=(1, bits.shape[1]))


def feature_bits(number: int) -> str:
    """Return the name of the array of a feature's occupancy; features count from 1."""
    return f"occupancy/feature_{number}"


def features_apart(container: Container) -> bool:
    """Return whether a file of the profile paper has the occupancy of each of its features."""
    arrays = container.arrays
    numbers = range(1, len(container.header["features"]) + 1)
    return _has_feature_bits(container) or all(feature_bits(number) in arrays for number in numbers)


def read_occupancy(
    container: Container, first: int, last: int, features: Sequence[int] | None = None
) -> npt.NDArray[np.bool_]:
    """Return which vertices (z, y, x) of the box are in the coreset at either of two key frames.

    Args:
        container: a file of the profile paper.
        first, last: neighbouring key frames, or the same key frame twice.
        features: numbers of features, counted from 0, whose coresets are taken; all if left out.
            Others need a file with `features_apart`.
    """
    arrays = container.arrays
    box = Box.of(container.header["feature_bounding_box"]).shape
    if MASK_ARRAY in arrays and (features is None or _has_feature_bits(container)):
        space = tuple(slice(0, length) for length in box)
        mask = arrays[MASK_ARRAY].read((slice(first, last + 1), *space))
        bits = 0xFF if features is None else sum(1 << number for number in features)
        return np.asarray(((mask[0] | mask[-1]) & np.uint8(bits)) != 0)
    names = [BITS] if features is None else [feature_bits(number + 1) for number in features]
    merged = np.zeros(arrays[names[0]].shape[1], np.uint8)
    for name in names:
        stored = arrays[name].read((slice(first, last + 1), slice(0, len(merged))))
        merged |= occupancy.between(stored[0], stored[-1])
    return occupancy.unpack(merged, box)


def _has_feature_bits(container: Container) -> bool:
    """Return whether the numbers of the coded occupancy have a bit for each feature."""
    mask = container.arrays.get(MASK_ARRAY)
    return (
        mask is not None
        and mask.attributes.get(MASK_FEATURE_BITS) is True
        and len(container.header["features"]) <= MASK_BITS
    )


def write_tables(
    writer: ContainerWriter,
    architecture: Architecture,
    coreset: Coreset,
    fine: Floats,
    tables: list[Floats],
    kind: str,
) -> None:
    """Write the tables of all levels as plain numbers, those of the fringe in few bits.

    Args:
        writer: the container that is being written.
        architecture: the sizes of the tables.
        coreset: the coreset, whose bricks the finest embeddings belong to.
        fine: embeddings of the finest level (bricks, E, vertices of a brick).
        tables: embeddings of the coarser levels, each (buckets, E).
        kind: name of the number type in the file, as `EncodeConfig.tables`.

    Raises:
        InputError: the numbers do not fit in `kind`.
    """
    size = architecture.embedding_size
    keys = architecture.key_frames
    step = fringe_step(coreset, keys, lambda key: finest_frame(coreset, fine, key))
    finest_frames = (
        round_fringe(coreset, key, finest_frame(coreset, fine, key), step) for key in range(keys)
    )
    _write_table(writer, 1, (*architecture.levels[0], size), fine, finest_frames, kind)
    for number, (level, table) in enumerate(
        zip(architecture.levels[1:], tables, strict=True), start=2
    ):
        _write_table(writer, number, (*level, size), table, table.reshape(*level, size), kind)


def finest_frame(coreset: Coreset, fine: Floats, key: int) -> Floats:
    """Return the finest table (z, y, x, E) of one key frame from its bricks; 0 outside of them."""
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
    """Return the network in a container; its tables are read on demand.

    Raises DamagedFileError where the arrays do not fit together.
    """
    header = container.header
    model = header["model"]
    size = model["embedding_size"]
    levels = tuple(tuple(level) for level in model["levels"])
    layers = tuple(
        (container.arrays[f"mlp/weight_{n}"].read(), container.arrays[f"mlp/bias_{n}"].read())
        for n in range(1, model["hidden_layers"] + 2)
    )
    try:
        return Network(
            levels=levels,
            embedding_size=size,
            tables=[_table(container, number, size) for number in range(1, len(levels) + 1)],
            layers=layers,
            box_size=Box.of(header["feature_bounding_box"]).shape,
            key_frames=levels[0][0],
        )
    except InputError as error:
        raise DamagedFileError(f"{container.path}: {error}") from error


def component_name(level: int, component: int) -> str:
    """Return the name of the array of one component of a coded level; both count from 1."""
    return f"tables/level_{level}/component_{component}"


def mix_components(components: Sequence[Floats], mixing: Floats) -> Floats:
    """Return embeddings float32 (..., E) from E components (...) (FORMAT.md, Coded tables).

    Embedding e is the sum of component j times mixing[j, e]. Each product and each sum is rounded
    to float32, from the first component on, so the bits are the same on every machine.

    Args:
        components: E arrays of one shape.
        mixing: (E, E), component by embedding.
    """
    embeddings = np.empty((*components[0].shape, mixing.shape[1]), np.float32)
    # Hostile numbers overflow; the network refuses what is not finite.
    with np.errstate(over="ignore", invalid="ignore"):
        for number in range(mixing.shape[1]):
            total = components[0] * mixing[0, number]
            for component, weights in zip(components[1:], mixing[1:], strict=True):
                total = total + component * weights[number]
            embeddings[..., number] = total
    return embeddings


class CodedTable:
    """A `TableSource` of a level whose components are coded."""

    def __init__(self, arrays: Sequence[StoredArray]) -> None:
        """Read a level from the arrays (t, z, y, x) of its components."""
        self.arrays = arrays
        self.shape = (*arrays[0].shape, len(arrays))
        # A mixing beyond float32 becomes infinite, which the network refuses.
        with np.errstate(over="ignore"):
            self.mixing = np.array([array.attributes["mixing"] for array in arrays], np.float32)

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return the embeddings of a region, float32."""
        components = [array.read(region[:4]) for array in self.arrays]
        return mix_components(components, self.mixing)[..., region[4]]


class StoredTable:
    """A `TableSource` of a level that is stored as plain numbers."""

    def __init__(self, array: StoredArray) -> None:
        self.array = array
        self.shape = array.shape
        self.scale = np.float32(array.attributes.get("scale", 1.0))
        self.offset = np.float32(array.attributes.get("offset", 0.0))

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return the embeddings of a region.

        Integers become offset + scale * number, float32; other numbers come as they are stored.
        """
        values = self.array.read(region)
        return values if self.array.dtype.kind == "f" else values * self.scale + self.offset


def table_chunk(shape: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """Return the chunk shape of a table (t, z, y, x, E) with numbers of `itemsize` bytes.

    A chunk is one time node, halved along its longest axis until it takes at most CHUNK_BYTES.
    """
    chunk = [1, *shape[1:]]
    while prod(chunk) * itemsize > CHUNK_BYTES and max(chunk[1:4]) > 1:
        axis = 1 + int(np.argmax(chunk[1:4]))
        chunk[axis] = -(-chunk[axis] // 2)
    return tuple(chunk)


@dataclass(frozen=True, kw_only=True)
class NumberType:
    """The numbers of a file that embeddings are stored as.

    Attributes:
        dtype: type of the numbers, floating or unsigned.
        scale, offset: an embedding stored as an unsigned number is offset + scale * number.
    """

    dtype: np.dtype[Any]
    scale: float = 1.0
    offset: float = 0.0

    @classmethod
    def of(cls, values: Floats, kind: str) -> NumberType:
        """Return the number type named `kind` with the scale and offset that fit some embeddings.

        Raises InputError where the embeddings are not finite or do not fit in the type.
        """
        dtype = np.dtype(kind)
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
        if not (isfinite(low) and isfinite(high)):
            raise InputError(
                "embeddings are not finite: the training diverged; set a lower --learning-rate"
            )
        if dtype.kind == "u":
            # The range includes 0, so that the 0 of untrained vertices costs little.
            low, high = min(low, 0.0), max(high, 0.0)
        reached = high - low if dtype.kind == "u" else max(-low, high)
        if reached > float(np.finfo(np.float32 if dtype.kind == "u" else dtype).max):
            raise InputError(
                f"embeddings reach {reached:g}, more than {kind} holds; use --tables float32"
            )
        if dtype.kind == "f":
            return cls(dtype=dtype)
        # float32 holds numbers below its `tiny` with fewer digits. A scale that small would not
        # give back the embeddings.
        scale = (
            max((high - low) / np.iinfo(dtype).max, float(np.finfo(np.float32).tiny))
            if high > low
            else 1.0
        )
        return cls(dtype=dtype, scale=scale, offset=low)

    def stored(self, embeddings: Floats) -> npt.NDArray[Any]:
        """Return embeddings as numbers of the type, of the same shape."""
        if self.dtype.kind == "f":
            return embeddings.astype(self.dtype)
        return np.asarray(
            np.rint(embeddings / self.scale - self.offset / self.scale).astype(self.dtype)
        )


def _table(container: Container, level: int, size: int) -> TableSource:
    """Return the table of a level, counted from 1, however it is stored."""
    if container.header["model"]["tables"] == "transform":
        return CodedTable(
            [container.arrays[component_name(level, number)] for number in range(1, size + 1)]
        )
    return StoredTable(container.arrays[f"tables/level_{level}"])


def _write_table(
    writer: ContainerWriter,
    level: int,
    shape: tuple[int, ...],
    embeddings: Floats,
    frames: Iterable[Floats],
    kind: str,
) -> None:
    """Write the table of one level.

    Args:
        writer: the container that is being written.
        level: number of the level, counted from 1.
        shape: lengths of the axes (t, z, y, x, E).
        embeddings: all embeddings in any order, for the range of the numbers.
        frames: the embeddings of each time node, (z, y, x, E).
        kind: name of the number type in the file.
    """
    number_type = NumberType.of(embeddings, kind)
    dtype = number_type.dtype
    attributes = (
        {"offset": number_type.offset, "scale": number_type.scale} if dtype.kind == "u" else None
    )
    chunk = table_chunk(shape, dtype.itemsize)

    def chunks() -> Iterator[npt.NDArray[Any]]:
        for frame in frames:
            node = number_type.stored(frame)[None]
            for start in np.ndindex(*(-(-n // c) for n, c in zip(node.shape, chunk, strict=True))):
                yield node[
                    tuple(slice(i * c, (i + 1) * c) for i, c in zip(start, chunk, strict=True))
                ]

    writer.add_array(
        f"tables/level_{level}",
        shape=shape,
        dtype=dtype,
        chunk_shape=chunk,
        chunks=chunks(),
        dimension_names=TABLE_AXES,
        attributes=attributes,
    )
