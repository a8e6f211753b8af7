"""The coded chunks of a variable as the tiles of a container, and what one look at them tells."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.scan import scan_piece
from fhash_codec.measure.value_range import Mean, ValueRange, pieces
from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.coding import TRANSFORM, Codec
from fhash_formats.container.sharding import SINGLE_SHARD_CHUNKS, shard_order
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.readers.zarr_coded import CodedArray
from fhash_formats.support.threads import map_ahead, thread_pool, usable_threads
from fhash_formats.transform.chunk import encode_chunk

__all__ = ["Facts", "Tiles"]

SHARD_BYTES = 1 << 30
"""Decoded bytes of a shard at most; its coded bytes, which are fewer, are held together."""
AHEAD = 2
"""Chunks that are read and decoded ahead, for each thread."""

Index = tuple[int, ...]


@dataclass(kw_only=True)
class _Look:
    """A chunk that was read and decoded.

    Attributes:
        stream: its bytes.
        low, high: range of its values; infinities the other way round where it has none.
        mean: of its values.
        occupied: number of its vertices that its mask has.
        missing: mask of its vertices without a value, within the array; None where all have one.
        absent: whether the store lacks it.
    """

    stream: bytes
    low: float
    high: float
    mean: Mean
    occupied: int
    missing: npt.NDArray[np.bool_] | None
    absent: bool


@dataclass(kw_only=True)
class Facts:
    """Facts of all values of a variable, gathered tile by tile.

    Attributes:
        shape: of the variable (t, z, y, x).
        mean: of the values.
        low, high: their range.
        occupied: number of vertices that masks have.
        missing: packed bits of the vertices without a value, for each step with some.
        absent: number of chunks that the store lacks.
        bytes: of all tiles.
    """

    shape: tuple[int, ...]
    mean: Mean = field(default_factory=Mean)
    low: float = np.inf
    high: float = -np.inf
    occupied: int = 0
    missing: dict[int, npt.NDArray[np.uint8]] = field(default_factory=dict)
    absent: int = 0
    bytes: int = 0
    _layer: npt.NDArray[np.bool_] | None = None
    _first: int = 0
    _last_bits: npt.NDArray[np.uint8] | None = None

    def add(self, look: _Look, region: tuple[slice, ...]) -> None:
        """Add a tile in its place; tiles come in the order of their first step."""
        self.mean.join(look.mean)
        self.low, self.high = min(self.low, look.low), max(self.high, look.high)
        self.occupied += look.occupied
        self.absent += look.absent
        self.bytes += len(look.stream)
        steps, *space = region
        if steps.start != self._first:
            self.flush()
            self._first = steps.start
        if look.missing is not None:
            if self._layer is None:
                self._layer = np.zeros((steps.stop - steps.start, *self.shape[1:]), np.bool_)
            self._layer[:, *space] = look.missing

    def flush(self) -> None:
        """Keep the missing vertices of the steps so far; equal masks of steps are kept once."""
        if self._layer is None:
            return
        for step, frame in enumerate(self._layer, start=self._first):
            if frame.any():
                bits = np.packbits(frame)
                if self._last_bits is None or not np.array_equal(bits, self._last_bits):
                    self._last_bits = bits
                self.missing[step] = self._last_bits
        self._layer = None

    @property
    def value_range(self) -> ValueRange:
        """The range of the values, of which there is at least one."""
        return ValueRange(self.low, self.high)


class Tiles:
    """The tiles of a variable, read, decoded and checked as they are iterated.

    Attributes:
        codecs: of the array that holds them.
        shard: shape of its shards; None for a single tile.
        facts: of the tiles so far.
    """

    def __init__(self, array: CodedArray, source: str, *, fill_absent: bool = False) -> None:
        """Prepare the tiles of an array of the store `source`.

        fill_absent: take the fill value for chunks that the store lacks, also where it marks no
            missing value.
        """
        self._array, self._source = array, source
        marks = bool(array.fill != array.fill) or array.fill in array.fills
        self._fill_absent = fill_absent or marks
        codec: Codec = {"name": TRANSFORM, "configuration": array.configuration}
        self.codecs: list[Codec] = [codec]
        self.metadata = ArrayMetadata(
            shape=array.shape, dtype=array.dtype, chunk_shape=array.tile, codecs=self.codecs
        )
        self.shard = _shard_shape(array.tile, array.grid, array.dtype.itemsize)
        self.facts = Facts(shape=array.shape)

    def __len__(self) -> int:
        return prod(self._array.grid)

    def streams(self, told: Callable[[int], None]) -> Iterator[bytes]:
        """Yield the tiles in the order of the file; `told` gets the number of those that are done.

        Raises DamagedFileError for a chunk that does not decode, and InputError for infinities and
        for a chunk that the store lacks, unless its fill value is taken.
        """
        array = self._array
        order = shard_order(array.shape, array.tile, self.shard or array.tile)
        with thread_pool() as pool:
            looks = map_ahead(pool, self._look, order, AHEAD * usable_threads())
            again = shard_order(array.shape, array.tile, self.shard or array.tile)
            for number, (index, look) in enumerate(zip(again, looks, strict=True), start=1):
                self.facts.add(look, self.metadata.inner_region(index))
                told(number)
                yield look.stream
        self.facts.flush()

    def check_against_store(self) -> None:
        """Compare the first and the last tile with what zarr decodes from the store.

        Raises RuntimeError where a value differs: then the tiles are not where they belong.
        """
        last = tuple(n - 1 for n in self._array.grid)
        for index in dict.fromkeys([(0, 0, 0, 0), last]):
            own = self._decode(self._stream(index)[0])[0][self._inside(index)]
            stored = self._array.values(index)
            if not np.array_equal(own, stored, equal_nan=own.dtype.kind == "f"):
                raise RuntimeError(f"chunk {index} decodes to other values than zarr finds in it")

    @cached_property
    def _fill_stream(self) -> bytes:
        """The tile of a chunk that the store lacks."""
        array = self._array
        return encode_chunk(np.full(array.tile, array.fill, array.dtype), max_error=0.0)

    def _stream(self, index: Index) -> tuple[bytes, bool]:
        """The bytes of a chunk, and whether the store lacks it."""
        stream = self._array.stream(index)
        if stream is not None:
            return stream, False
        if not self._fill_absent:
            raise InputError(
                f"{self._source}: the store lacks chunk {index} of {self._array.name}, and its fill"
                f" value {self._array.fill} marks no missing value; if the store is complete, take"
                " that value by --absent fill (absent='fill')"
            )
        return self._fill_stream, True

    def _inside(self, index: Index) -> tuple[slice, ...]:
        """The part of a tile within the array."""
        region = self.metadata.inner_region(index)
        return tuple(slice(0, along.stop - along.start) for along in region)

    def _decode(self, stream: bytes) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_] | None]:
        """The values of a tile, and its mask where it may have one, as a reader decodes them."""
        coder, data = self.metadata.coder, memoryview(stream)
        return coder.decode_masked(data) if coder.masked else (coder.decode(data), None)

    def _look(self, index: Index) -> _Look:
        """Read and decode a chunk."""
        array = self._array
        stream, absent = self._stream(index)
        try:
            decoded, mask = self._decode(stream)
        except DamagedFileError as error:
            raise DamagedFileError(
                f"{self._source}: chunk {index} of {array.name} is damaged: {error}"
            ) from error
        inside = self._inside(index)
        values = decoded[inside]
        occupied = None if mask is None else mask[inside]
        missing = _missing(values, array.fills)
        if missing is not None:
            infinite = values.dtype.kind == "f" and bool(np.isinf(values).any())
            if infinite:
                raise InputError(
                    f"{self._source}: variable {array.name} has infinite values, which a container"
                    f" has no place for: fhash encode {self._source} --var {array.name}"
                )
            kept = values[~missing]
        else:
            kept = values
        low, high, mean = np.inf, -np.inf, Mean()
        for piece in pieces(kept) if kept.size else ():
            _, least, most = scan_piece(piece, mean)
            low, high = min(low, least), max(high, most)
        if missing is not None and occupied is not None:
            missing = missing & occupied
        return _Look(
            stream=stream,
            low=low,
            high=high,
            mean=mean,
            occupied=values.size if occupied is None else int(np.count_nonzero(occupied)),
            missing=missing if missing is not None and missing.any() else None,
            absent=absent,
        )


def _missing(values: npt.NDArray[Any], fills: Sequence[Any]) -> npt.NDArray[np.bool_] | None:
    """A mask of the values that stand for none, infinities included; None where all are values."""
    found = ~np.isfinite(values) if values.dtype.kind == "f" else np.zeros(values.shape, np.bool_)
    for fill in fills:
        found |= values == fill
    return found if found.any() else None


def _shard_shape(tile: Index, grid: Index, itemsize: int) -> Index | None:
    """The shape of shards of a bounded size, such that tiles come in the order of their steps.

    None for a single tile. A shard has several layers along t only where it has all of each.
    """
    if prod(grid) == 1:
        return None
    most = max(1, min(SINGLE_SHARD_CHUNKS, SHARD_BYTES // (prod(tile) * itemsize)))
    counts = [1] * len(grid)
    for axis in reversed(range(len(grid))):
        counts[axis] = min(grid[axis], most // prod(counts))
        if counts[axis] < grid[axis]:
            break
    return tuple(n * count for n, count in zip(tile, counts, strict=True))
