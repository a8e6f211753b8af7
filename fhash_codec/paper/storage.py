"""Storage of the paper's model in a container: tables, their sparse form, and the fringe."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import accumulate, pairwise
from math import prod
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import TABLE_AXES, Box, Sizes, TableSource
from fhash_codec.features import occupancy
from fhash_codec.features.bricks import Coreset
from fhash_codec.features.occupancy import Bits, read_bits, write_bits
from fhash_codec.paper.network import (
    Architecture,
    Layer,
    Network,
    NumberType,
    Resolution,
    SparseFrame,
)
from fhash_formats.container import Container, ContainerWriter, StoredArray
from fhash_formats.container.header import BITS_ARRAY, COUNTS, FRINGE, LAYERS, SCALES
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.values import Longs, Mask, Single

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class _Window:
    """The part of the brick grid that a region touches.

    Attributes:
        first: place (z, y, x) in the grid at which the window begins.
        stored: places (z, y, x) of the window at which the coreset has a brick.
        numbers: numbers of these bricks in the coreset.
    """

    first: Sizes
    stored: Mask
    numbers: npt.NDArray[np.intp]


class Bricks:
    """The bricks of a coreset, looked up by their place.

    Regions are in vertices of the feature bounding box. Vertices in no brick are 0 or False.
    """

    def __init__(self, coreset: Coreset) -> None:
        self._coreset = coreset
        key, z, y, x = coreset.bricks.T.astype(np.int64)
        # The coreset has its bricks in ascending order, so that bisection finds a place.
        self._places = self._brick_index(key, z, y, x)

    def mask(self, key: int, box: Box) -> Mask:
        """Return which vertices (z, y, x) of a region are samples at a key frame."""
        window = self._window(key, box)
        return self._region(self._in_coreset(window.numbers), window, box)

    def samples(self, key: int, box: Box) -> Single:
        """Return the normalised values (z, y, x) of a region at a key frame."""
        return self.embeddings(self._coreset.values[None], key, box)[..., 0]

    def embeddings(self, fine: Single, key: int, box: Box) -> Single:
        """Return the finest embeddings (z, y, x, E) of a region at a key frame.

        Args:
            fine: embeddings of all samples (E, samples), in the order of `Coreset.values`.
            key: index of the key frame.
            box: the region.
        """
        window = self._window(key, box)
        in_coreset = self._in_coreset(window.numbers)
        places = self._coreset.sample_indices(window.numbers)
        regions = []
        for numbers in fine:
            contents = np.zeros(in_coreset.shape, np.float32)
            contents[in_coreset] = numbers[places]
            regions.append(self._region(contents, window, box))
        return np.stack(regions, axis=-1)

    def _brick_index(self, key: Longs, z: Longs, y: Longs, x: Longs) -> Longs:
        """Return the place of bricks in the grids of all key frames, in C order."""
        grid = self._coreset.brick_grid
        return ((key * grid[0] + z) * grid[1] + y) * grid[2] + x

    def _window(self, key: int, box: Box) -> _Window:
        """Return the part of the brick grid of a key frame that a region touches."""
        z, y, x = (
            np.arange(low // n, -(-high // n))
            for (low, high), n in zip(box, self._coreset.brick_shape, strict=True)
        )
        places = self._brick_index(np.array(key), z[:, None, None], y[:, None], x)
        numbers = np.searchsorted(self._places, places)
        stored = np.zeros(places.shape, bool)
        inside = numbers < len(self._places)
        stored[inside] = self._places[numbers[inside]] == places[inside]
        return _Window((int(z[0]), int(y[0]), int(x[0])), stored, numbers[stored])

    def _in_coreset(self, numbers: npt.NDArray[np.intp]) -> Mask:
        """Return which vertices (bricks, vertices of a brick) of some bricks are samples."""
        bits = np.unpackbits(
            self._coreset.mask_bits[numbers], axis=1, count=prod(self._coreset.brick_shape)
        )
        return bits.view(np.bool_)

    def _region(
        self, contents: npt.NDArray[Scalar], window: _Window, box: Box
    ) -> npt.NDArray[Scalar]:
        """Return a region out of the contents (bricks, vertices of a brick) of a window."""
        shape = self._coreset.brick_shape
        blocks = np.zeros((*window.stored.shape, *shape), contents.dtype)
        blocks[window.stored] = contents.reshape(-1, *shape)
        joined = blocks.transpose(0, 3, 1, 4, 2, 5).reshape(
            [count * n for count, n in zip(window.stored.shape, shape, strict=True)]
        )
        return joined[
            tuple(
                slice(low - first * n, high - first * n)
                for (low, high), first, n in zip(box, window.first, shape, strict=True)
            )
        ]


class Needed:
    """The needed vertices of all levels.

    With `fringe`, the samples at a key frame are the vertices of its coreset and of its neighbours'
    (`Extent.with_fringe`), otherwise those of its coreset.
    """

    def __init__(
        self,
        levels: Sequence[Resolution],
        grids: Callable[[int], occupancy.Bits],
        *,
        fringe: bool,
    ) -> None:
        """Take the occupancy of the box.

        Args:
            levels: vertices (t, z, y, x) of each level, finest first.
            grids: key frame -> its packed occupancy (`occupancy.pack`).
            fringe: whether samples are also those of the neighbouring key frames.
        """
        self._levels, self._grids, self._fringe = levels, grids, fringe
        self._keys, *box = levels[0]
        self._box: occupancy.Shape = (box[0], box[1], box[2])

    def mask(self, level: int, node: int) -> Mask:
        """Return which vertices (z, y, x) of a level are needed at a time node.

        Args:
            level: index of the level, 0 for the finest.
            node: index of the time node.
        """
        nodes, *resolution = self._levels[level]
        keys = self._dependent_keys(nodes, node)
        merged = np.zeros(occupancy.packed_bytes(self._box), np.uint8)
        for key in keys:
            merged = occupancy.between(merged, self._grids(key))
        mask = occupancy.unpack(merged, self._box)
        for axis, length in enumerate(resolution):
            mask = spread(mask, axis, length)
        return mask

    def counts(self, level: int) -> list[int]:
        """Return the number of needed vertices of a level at each of its time nodes."""
        nodes = range(self._levels[level][0])
        return [int(np.count_nonzero(self.mask(level, node))) for node in nodes]

    def _dependent_keys(self, nodes: int, node: int) -> list[int]:
        """Return the key frames whose occupancy decides what is needed at a time node.

        Args:
            nodes: time nodes of the level.
            node: index of the time node.
        """
        first, last = corners(self._keys, nodes)
        keys = (first == node) | (last == node)
        if self._fringe:
            before, after = keys[:-1].copy(), keys[1:].copy()
            keys[1:] |= before
            keys[:-1] |= after
        return [int(key) for key in np.flatnonzero(keys)]


def needed_by(architecture: Architecture, coreset: Coreset) -> Needed:
    """Return the vertices that the samples of a coreset need, those of its fringe included."""
    return Needed(
        architecture.levels, coreset.occupancy.__getitem__, fringe=coreset.fringe is not None
    )


def corners(length: int, resolution: int) -> tuple[Longs, Longs]:
    """Return the vertices of a level before and after each vertex of the box, along one axis.

    They are the same where a vertex of the box lies on a vertex of the level.

    Args:
        length: vertices of the box along the axis.
        resolution: vertices of the level along the axis.
    """
    before, rest = np.divmod(np.arange(length) * (resolution - 1), max(length - 1, 1))
    return before, before + (rest > 0)


def spread(mask: Mask, axis: int, resolution: int) -> Mask:
    """Return which vertices of a level surround some vertex of a mask, along one axis.

    Args:
        mask: vertices of the box along that axis.
        axis: the axis.
        resolution: vertices of the level along it.
    """
    if mask.shape[axis] == resolution:
        return mask
    layers = np.moveaxis(mask, axis, 0)
    result = np.zeros((resolution, *layers.shape[1:]), bool)
    for layer, first, last in zip(layers, *corners(len(layers), resolution), strict=True):
        result[first] |= layer
        result[last] |= layer
    return np.moveaxis(result, 0, axis)


CHUNK_BYTES = 2 << 20
"""Bytes of a chunk of a table."""
FRAMES = 8
"""Time nodes of a table whose needed embeddings stay in memory."""

Rows = Callable[[int, int], npt.NDArray[Any]]
"""First and end of a run of needed vertices -> their embeddings (end - first, E)."""


class SparseTable:
    """A `TableSource` whose embeddings are 0 at vertices that are not needed.

    Attributes:
        shape: lengths of the axes (t, z, y, x, E).
    """

    def __init__(
        self,
        shape: Sequence[int],
        counts: Sequence[int],
        rows: Rows,
        needed: Callable[[int], Mask],
        name: str,
    ) -> None:
        """Take where the embeddings are and which vertices they belong to.

        Args:
            shape: lengths of the axes (t, z, y, x, E).
            counts: number of needed vertices of each time node.
            rows: reads the embeddings of a run of needed vertices.
            needed: time node -> which of its vertices (z, y, x) are needed.
            name: of the table, for messages.
        """
        self.shape = tuple(shape)
        self._starts = list(accumulate(counts, initial=0))
        self._rows, self._needed, self._name = rows, needed, name
        self.frame = lru_cache(maxsize=FRAMES)(self._frame)

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return the embeddings of a region: 5 slices with explicit ends."""
        frames = [self.frame(node) for node in range(region[0].start, region[0].stop)]
        return np.stack([frame.read(region[1:4]) for frame in frames])[..., region[4]]

    def _frame(self, node: int) -> SparseFrame:
        """Return the needed embeddings of a time node.

        Raises DamagedFileError where the file has another number of them than the occupancy asks
        for.
        """
        mask = self._needed(node)
        first, end = self._starts[node : node + 2]
        if (needed := int(np.count_nonzero(mask))) != end - first:
            raise DamagedFileError(
                f"{self._name} has {end - first} vertices at time node {node}; "
                f"the occupancy asks for {needed}"
            )
        return SparseFrame.of(mask, self._rows(first, end))


def write_sparse(
    writer: ContainerWriter,
    name: str,
    size: int,
    number_type: NumberType,
    counts: Sequence[int],
    held: Iterable[npt.NDArray[Any]],
) -> None:
    """Write the embeddings of the needed vertices of a level.

    Args:
        writer: the container that is being written.
        name: of the array.
        size: numbers E of an embedding.
        number_type: type of the numbers.
        counts: number of needed vertices of each time node.
        held: their embeddings, an array (vertices, E) of that type for each time node.
    """
    length = max(1, CHUNK_BYTES // (size * number_type.dtype.itemsize))
    total = sum(counts)
    writer.add_array(
        name,
        shape=(total, size),
        dtype=number_type.dtype,
        chunk_shape=(min(length, total), size),
        chunks=_chunks(held, length),
        dimension_names=("vertex", TABLE_AXES[4]),
        attributes={**number_type.attributes, COUNTS: list(counts)},
    )


def _chunks(runs: Iterable[npt.NDArray[Any]], length: int) -> Iterator[npt.NDArray[Any]]:
    """Yield the rows of some runs in chunks of a length; the last may be shorter."""
    rest: list[npt.NDArray[Any]] = []
    for run in runs:
        rest.append(run)
        while sum(map(len, rest)) >= length:
            joined = np.concatenate(rest)
            yield joined[:length]
            rest = [joined[length:]]
    if any(map(len, rest)):
        yield np.concatenate(rest)


STEP_SHARE = 0.5
"""Largest step as a share of the embeddings' root mean square. The noise is then 17 dB below them.

On a crop of a shock and a cloud, 10 key frames, it took 0.02 dB of the fringe's 34.4 dB between key
frames, and three quarters of the bytes that the fringe had added.
"""


def fringe_step(coreset: Coreset, key_frames: int, finest: Callable[[int], Single]) -> float | None:
    """Return the step to which finest embeddings of the fringe are rounded, a power of two.

    None where there is no fringe, or nothing in it was trained.

    Args:
        coreset: the coreset.
        key_frames: number of key frames.
        finest: key frame -> finest embeddings (z, y, x, E), 0 at vertices that are no samples.
    """
    squares, count = 0.0, 0
    for key in range(key_frames):
        embeddings = finest(key)[_outside(coreset, key)].astype(np.float64)
        squares += float(np.square(embeddings).sum())
        count += int(np.count_nonzero(embeddings))
    if not count or not 0 < squares < math.inf:
        return None
    return float(2.0 ** math.floor(math.log2(STEP_SHARE * math.sqrt(squares / count))))


def round_fringe(coreset: Coreset, key: int, embeddings: Single, step: float | None) -> Single:
    """Return the finest embeddings (z, y, x, E) of a key frame with its fringe rounded.

    Args:
        coreset: the coreset.
        key: the key frame.
        embeddings: its finest embeddings.
        step: from `fringe_step`.
    """
    if step is None:
        return embeddings
    rounded = np.rint(embeddings / np.float32(step)) * np.float32(step)
    outside = _outside(coreset, key)[..., None]
    # Adding 0 turns -0 into 0: one pattern of bits for the most frequent number.
    result: Single = np.where(outside, rounded + np.float32(0), embeddings)
    return result


def _outside(coreset: Coreset, key: int) -> npt.NDArray[np.bool_]:
    """Return the vertices (z, y, x) of the box that are not in the coreset of a key frame."""
    return ~occupancy.unpack(coreset.occupancy[key], coreset.box.shape)


GRIDS = 16
"""Key frames whose packed occupancy stays in memory while needed vertices are looked up."""


def write_model(
    writer: ContainerWriter, coreset: Coreset, layers: list[tuple[Single, Single]]
) -> None:
    """Write the occupancy of the features of a coreset, and the layers (weight, bias)."""
    for number, (weight, bias) in enumerate(layers, start=1):
        writer.add_whole(f"mlp/weight_{number}", weight)
        writer.add_whole(f"mlp/bias_{number}", bias)
    write_occupancy(writer, coreset)


def write_occupancy(writer: ContainerWriter, coreset: Coreset) -> None:
    """Write the occupancy of each feature of a coreset as bits."""
    grids = coreset.grids
    shape = (len(grids), len(coreset.occupancy), len(coreset.occupancy[0]))
    write_bits(writer, BITS_ARRAY, shape, lambda feature, key: grids[feature][key])


def write_tables(
    writer: ContainerWriter,
    architecture: Architecture,
    coreset: Coreset,
    fine: Single,
    tables: list[Single],
    kind: str,
    *,
    sparse: bool = False,
) -> int:
    """Write the tables of all levels as plain numbers, those of the fringe in few bits.

    Return the number of vertices that the tables have in the file.

    Args:
        writer: the container that is being written.
        architecture: the sizes of the tables.
        coreset: the coreset, whose samples the finest embeddings belong to.
        fine: embeddings of the finest level (E, samples), in the order of `Coreset.values`.
        tables: embeddings of the coarser levels, each (buckets, E).
        kind: name of the number type in the file.
        sparse: whether the file gets the embeddings of needed vertices alone.

    Raises:
        InputError: the numbers do not fit in `kind`.
    """
    size = architecture.embedding_size
    bricks, box = Bricks(coreset), Box.of_shape(coreset.box.shape)
    step = fringe_step(
        coreset, architecture.key_frames, lambda key: bricks.embeddings(fine, key, box)
    )

    def finest(key: int) -> Single:
        return round_fringe(coreset, key, bricks.embeddings(fine, key, box), step)

    nodes: list[Callable[[int], Single]] = [
        finest,
        *(
            table.reshape(*level, size).__getitem__
            for level, table in zip(architecture.levels[1:], tables, strict=True)
        ),
    ]
    needed = needed_by(architecture, coreset)
    vertices = 0
    for number, (level, embeddings, read) in enumerate(
        zip(architecture.levels, (fine, *tables), nodes, strict=True)
    ):
        number_type = NumberType.of(embeddings, kind)
        name, stored = table_name(number + 1), partial(_stored, number_type, read)
        if sparse:
            counts, mask = needed.counts(number), partial(needed.mask, number)
            held = (stored(node)[mask(node)] for node in range(level[0]))
            write_sparse(writer, name, size, number_type, counts, held)
            vertices += sum(counts)
        else:
            _write_dense(writer, name, (*level, size), number_type, stored)
            vertices += prod(level)
    return vertices


def load_network(container: Container) -> Network:
    """Return the network in a container; its tables are read on demand.

    Raises DamagedFileError where the arrays do not fit together.
    """
    header = container.header
    model = header["model"]
    size = model["embedding_size"]
    levels = tuple(tuple(level) for level in model["levels"])
    needed = _needed(container)
    layers = _layers(container)
    try:
        return Network(
            levels=levels,
            embedding_size=size,
            tables=[_table(container, needed, number) for number in range(1, len(levels) + 1)],
            layers=layers,
            box_size=Box.of(header["feature_bounding_box"]).shape,
            key_frames=levels[0][0],
        )
    except InputError as error:
        raise DamagedFileError(f"{container.path}: {error}") from error


def _layers(container: Container) -> tuple[Layer, ...]:
    """Return weight (out, in) and bias (out,) of each layer of the network in a container."""
    arrays, model = container.arrays, container.header["model"]
    inputs = len(model["levels"]) * model["embedding_size"]
    widths = [inputs, *[model["width"]] * model["hidden_layers"], 1]
    shapes = [(outputs, inputs) for inputs, outputs in pairwise(widths)]
    if LAYERS not in arrays:
        names = [f"mlp/{{}}_{number}" for number in range(1, len(shapes) + 1)]
        return tuple(
            (arrays[name.format("weight")].read(), arrays[name.format("bias")].read())
            for name in names
        )
    sizes = [size for outputs, inputs in shapes for size in (outputs * inputs, outputs)]
    numbers = np.split(arrays[LAYERS].read().astype(np.float32), np.cumsum(sizes)[:-1])
    if arrays[LAYERS].dtype == np.int16:
        scales = np.array(arrays[LAYERS].attributes[SCALES], np.float32)
        numbers = [part * scale for part, scale in zip(numbers, scales, strict=True)]
    return tuple(
        (weight.reshape(shape), bias)
        for weight, bias, shape in zip(numbers[::2], numbers[1::2], shapes, strict=True)
    )


def table_name(level: int) -> str:
    """Return the name of the array of a level, counted from 1, that is stored as numbers."""
    return f"table_{level}"


def component_name(level: int, component: int) -> str:
    """Return the name of the array of one component of a coded level; both count from 1."""
    return f"{table_name(level)}/component_{component}"


def mix_components(components: Sequence[Single], mixing: Single) -> Single:
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


def _table(container: Container, needed: Needed, level: int) -> TableSource:
    """Return the table of a level, counted from 1, however it is stored."""
    model = container.header["model"]
    size = model["embedding_size"]
    if model["tables"] == "transform":
        return CodedTable(
            [container.arrays[component_name(level, number)] for number in range(1, size + 1)]
        )
    stored = StoredTable(container.arrays[table_name(level)])
    if "sparse" not in model:
        return stored

    def rows(first: int, end: int) -> npt.NDArray[Any]:
        return stored.read((slice(first, end), slice(0, size)))

    return SparseTable(
        (*model["levels"][level - 1], size),
        stored.array.attributes[COUNTS],
        rows,
        partial(needed.mask, level - 1),
        f"{container.path}: array {table_name(level)}",
    )


def _needed(container: Container) -> Needed:
    """Return the vertices that the samples of a file need."""
    model = container.header["model"]

    @lru_cache(maxsize=GRIDS)
    def grid(key: int) -> Bits:
        bits: Bits = read_bits(container, key, key + 1)[0]
        return bits

    levels = [tuple(level) for level in model["levels"]]
    return Needed(levels, grid, fringe=model.get("sparse") == FRINGE)


def _stored(number_type: NumberType, read: Callable[[int], Single], node: int) -> npt.NDArray[Any]:
    """Return the embeddings (z, y, x, E) of a time node as numbers of a type."""
    return number_type.stored(read(node))


def _write_dense(
    writer: ContainerWriter,
    name: str,
    shape: tuple[int, ...],
    number_type: NumberType,
    stored: Callable[[int], npt.NDArray[Any]],
) -> None:
    """Write all embeddings of a level.

    Args:
        writer: the container that is being written.
        name: of the array.
        shape: lengths of the axes (t, z, y, x, E).
        number_type: type of the numbers.
        stored: time node -> its embeddings (z, y, x, E) as numbers of that type.
    """
    chunk = table_chunk(shape, number_type.dtype.itemsize)

    def chunks() -> Iterator[npt.NDArray[Any]]:
        for number in range(shape[0]):
            node = stored(number)[None]
            for start in np.ndindex(*(-(-n // c) for n, c in zip(node.shape, chunk, strict=True))):
                yield node[
                    tuple(slice(i * c, (i + 1) * c) for i, c in zip(start, chunk, strict=True))
                ]

    writer.add_array(
        name,
        shape=shape,
        dtype=number_type.dtype,
        chunk_shape=chunk,
        chunks=chunks(),
        dimension_names=TABLE_AXES,
        attributes=number_type.attributes or None,
    )
