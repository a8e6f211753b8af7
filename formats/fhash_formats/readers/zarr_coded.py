"""Arrays of a Zarr store whose chunks `fhash.transform` coded, read without decoding them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.native import crc32c
from fhash_formats.readers.file_series import FileSeries, Request, condense, refusing
from fhash_formats.readers.layout import Layout, label
from fhash_formats.readers.select import Selection
from fhash_formats.readers.stored_parts import ABSENT
from fhash_formats.readers.variables import Variable
from fhash_formats.readers.zarr_store import open_zarr
from fhash_formats.series import AXES
from fhash_formats.transform.stream import MAX_TILE_VERTICES, NO_AXIS, TILE_AXES, ArrayAxes

if TYPE_CHECKING:
    from collections.abc import Iterator

    import zarr

    from fhash_formats.transform.zarr_codec import TransformCodec

SHARD_INDICES = 64
"""Indices of shards that are kept."""
ENTRY = 16
"""Bytes that the index of a shard has for each chunk: offset and length."""

Place = tuple[int, ...]


@contextmanager
def open_coded(path: Path, request: Request) -> Iterator[tuple[FileSeries, CodedArray]]:
    """The series of a coded variable, and its chunks; closed at the end of the block.

    Raises InputError as `open_series` does, and for an array of another codec or format.
    """
    opened = open_zarr(path, request)
    try:
        with refusing(f"{path} cannot be read as zarr"):
            found = Selection(opened, request)
            variable = found.choose()
            coding, fills = _require_coded(found, variable)
            layout = found.arrange(variable)
            series = found.series_of(variable, layout)
        yield series, CodedArray(found.source, variable, layout, coding, fills)
    finally:
        opened.close()


def coded_names(path: Path) -> tuple[Path, dict[str, bool]]:
    """The arrays of a store by name, and whether `fhash.transform` coded each.

    Of a path that is an array in a group this one alone. The folder of the group comes first.
    """
    opened = open_zarr(path, Request())
    try:
        names = {
            variable.name: not variable.members and isinstance(_coding(variable.handle), _Coding)
            for variable in Selection(opened, Request()).variables
            if not variable.error
        }
    finally:
        opened.close()
    assert opened.path is not None
    return opened.path, {opened.only: names.get(opened.only, False)} if opened.only else names


@dataclass(frozen=True, kw_only=True)
class _Coding:
    """The codecs of a chunk.

    Attributes:
        order: dimensions of the array in the order in which chunks are coded.
        codec: what makes bytes of the values.
        after: codecs of these bytes, in the order of writing.
        chunk: lengths of a chunk along the dimensions of the array.
        shard: lengths of the shard that holds it; None without shards.
        at_end: whether the index of a shard stands behind its chunks.
    """

    order: tuple[int, ...]
    codec: TransformCodec
    after: tuple[Any, ...]
    chunk: tuple[int, ...]
    shard: tuple[int, ...] | None
    at_end: bool


def _coding(array: zarr.Array[Any]) -> _Coding | str:
    """The codecs of an array, or why its chunks cannot be tiles."""
    from zarr.abc.codec import ArrayArrayCodec
    from zarr.codecs import TransposeCodec

    from fhash_formats.transform.zarr_codec import TransformCodec

    def named(codecs: Sequence[Any]) -> list[str]:
        return [str(codec.to_dict()["name"]) for codec in codecs]

    if array.metadata.zarr_format != 3:
        return "is of Zarr format 2"
    shard, chunk = array.shards, array.chunks
    codecs: list[Any] = list(array.metadata.codecs)
    at_end = True
    if shard is not None:
        sharding = codecs[0]
        names = named(sharding.index_codecs)
        if names != ["bytes", "crc32c"]:
            return f"has shards whose index is coded by {', '.join(names)}"
        codecs = list(sharding.codecs)
        at_end = sharding.to_dict()["configuration"]["index_location"] == "end"
    told = f"is coded by {', '.join(named(codecs))}"
    order = list(range(len(chunk)))
    while codecs and isinstance(codecs[0], ArrayArrayCodec):
        filtered = codecs.pop(0)
        if not isinstance(filtered, TransposeCodec):
            return f"{told}, of which a container has no filter"
        order = [order[place] for place in filtered.order]
    if not codecs or not isinstance(codecs[0], TransformCodec):
        return f"{told}, not by fhash.transform"
    codec, *after = codecs
    return _Coding(
        order=tuple(order),
        codec=codec,
        after=tuple(after),
        chunk=chunk,
        shard=shard,
        at_end=at_end,
    )


def _require_coded(found: Selection, variable: Variable) -> tuple[_Coding, tuple[Any, ...]]:
    """The codecs of a variable whose chunks can be the tiles of a container, and its fill values.

    Raises InputError for another one.
    """
    coding = "has its steps in several groups" if variable.members else _coding(variable.handle)
    if isinstance(coding, str):
        raise _refusal(found.source, variable.name, coding)
    packed = found.packing(variable)
    if packed is not None and (packed.scaled or packed.stored != variable.dtype):
        told = "is packed (scale_factor, add_offset), so that its numbers are not its values"
        raise _refusal(found.source, variable.name, told)
    return coding, () if packed is None else packed.fills


def _refusal(source: str, name: str, why: str) -> InputError:
    return InputError(
        f"{source}: variable {name} {why}; it has to be coded again: "
        f"fhash encode {source} --var {name}"
    )


class CodedArray:
    """The chunks of a variable as tiles (t, z, y, x), in the places that a series has for them.

    Attributes:
        name: of the variable.
        shape, dtype: of all values.
        tile: shape of a chunk.
        grid: number of chunks along each axis.
        configuration: of the codec `fhash.transform` in a container of these chunks.
        quality: what was asked of each chunk, such as `{"max_error": 0.1}`; empty where unknown.
        fill: the value of chunks that the store lacks.
        fills: numbers that stand for a missing value, by the attributes of the array.

    Raises InputError for chunks that are no tiles of a container.
    """

    def __init__(
        self,
        source: str,
        variable: Variable,
        layout: Layout,
        coding: _Coding,
        fills: tuple[Any, ...],
    ) -> None:
        array = variable.handle
        self.name, self._source = variable.name, source
        self._array, self._coding, self._layout = array, coding, layout
        self.dtype = np.dtype(array.dtype).newbyteorder("=")
        self.fill, self.fills = self.dtype.type(array.fill_value), fills
        places = [place for place in range(array.ndim) if place not in layout.picked]
        self._places = dict(zip(layout.axes, places, strict=True))
        self._axis_of = dict(zip(places, layout.axes, strict=True))
        for place in layout.picked:
            if coding.chunk[place] != 1:
                what = label(place, layout.dimensions[place])
                why = f"has chunks of {coding.chunk[place]} along {what}, of which one is selected"
                raise _refusal(source, self.name, why)
        self.shape, self.tile = self._by_axis(array.shape), self._by_axis(coding.chunk)
        self.grid = tuple(-(-n // length) for n, length in zip(self.shape, self.tile, strict=True))
        size = prod(self.tile)
        if size > MAX_TILE_VERTICES:
            why = f"has chunks of {size:,} values; a container has {MAX_TILE_VERTICES:,}"
            raise _refusal(source, self.name, why)
        settings, axes = coding.codec.settings, self._axes()
        self.configuration: dict[str, Any] = {}
        if settings is not None:
            self.configuration["settings"] = settings.to_text()
        if not axes.usual:
            self.configuration["axes"] = list(axes.names)
        given = coding.codec.to_dict()["configuration"]
        assert isinstance(given, Mapping)
        names = ("max_error", "max_error_rel", "step")
        self.quality = {name: given[name] for name in names if settings is None and name in given}
        self._index = lru_cache(maxsize=SHARD_INDICES)(self._read_index)

    def stream(self, index: Sequence[int]) -> bytes | None:
        """The bytes that the codec made of a chunk; None where the store lacks it.

        index: of the chunk in `grid`. Raises InputError where it cannot be read, and
        DamagedFileError for damaged bytes.
        """
        place = self._stored(index)
        with refusing(f"{self._source}: chunk {place} of {self.name} cannot be read"):
            data = self._bytes(place)
        if data is None or not self._coding.after:
            return data
        return self._undone(place, data)

    def values(self, index: Sequence[int]) -> npt.NDArray[Any]:
        """The values (t, z, y, x) of a chunk within the array, as zarr decodes them."""
        chunk = self._coding.chunk
        ranges = tuple(
            slice(i * n, min((i + 1) * n, length))
            for i, n, length in zip(self._stored(index), chunk, self._array.shape, strict=True)
        )
        with refusing(f"{self._source}: chunk {tuple(index)} of {self.name} cannot be read"):
            values = np.asarray(self._array[ranges])
        order = [self._places[axis] for axis in AXES if axis in self._places]
        others = [place for place in range(values.ndim) if place not in order]
        lengths = self._by_axis(values.shape)
        return values.transpose([*others, *order]).reshape(lengths)

    def _by_axis(self, lengths: Sequence[int]) -> tuple[int, ...]:
        """Lengths (t, z, y, x) of those along the dimensions of the array."""
        return tuple(lengths[self._places[axis]] if axis in self._places else 1 for axis in AXES)

    def _stored(self, index: Sequence[int]) -> Place:
        """Index of a chunk in the array of the store."""
        by_axis, picked = dict(zip(AXES, index, strict=True)), self._layout.picked
        return tuple(
            picked[place] if place in picked else by_axis[self._axis_of[place]]
            for place in range(self._array.ndim)
        )

    def _axes(self) -> ArrayAxes:
        """The axis of tiles for each of t, z, y and x.

        Those along which a chunk has length 1 may be any that is left.
        """
        coded = self._coding.order
        given = self._coding.codec.axes
        if given is None:
            blank = len(coded) - len(TILE_AXES)
            given = TILE_AXES[-len(coded) :] if blank <= 0 else ("t",) * blank + TILE_AXES
        chunk = self._coding.chunk
        found: dict[str, str] = {}
        for place, tile_axis in zip(coded, given, strict=True):
            if chunk[place] > 1:
                if tile_axis in found.values() or tile_axis == NO_AXIS:
                    why = f"has chunks of {chunk}, several of whose axes the codec took as one"
                    raise _refusal(self._source, self.name, why)
                found[self._axis_of[place]] = tile_axis
        for axis in AXES:
            if axis not in found and axis in TILE_AXES and axis not in found.values():
                found[axis] = axis
        for axis in AXES:
            if axis not in found:
                found[axis] = next(each for each in TILE_AXES if each not in found.values())
        return ArrayAxes(tuple(found[axis] for axis in AXES))

    def _bytes(self, place: Place) -> bytes | None:
        """The bytes of a chunk as they are stored, or None."""
        from zarr.abc.store import RangeByteRequest

        shard = self._coding.shard
        if shard is None:
            return self._read(place)
        counts = [n // chunk for n, chunk in zip(shard, self._coding.chunk, strict=True)]
        outer = tuple(i // n for i, n in zip(place, counts, strict=True))
        index = self._index(outer)
        if index is None:
            return None
        inside = [i % n for i, n in zip(place, counts, strict=True)]
        offset, size = (int(n) for n in index[np.ravel_multi_index(inside, counts)])
        if ABSENT in (offset, size):
            return None
        return self._read(outer, RangeByteRequest(offset, offset + size))

    def _read_index(self, shard: Place) -> npt.NDArray[np.uint64] | None:
        """Offset and length of each chunk of a shard; None where the store lacks the shard."""
        from zarr.abc.store import RangeByteRequest, SuffixByteRequest

        assert self._coding.shard is not None
        count = prod(self._coding.shard) // prod(self._coding.chunk)
        size = count * ENTRY + 4
        wanted = SuffixByteRequest(size) if self._coding.at_end else RangeByteRequest(0, size)
        data = self._read(shard, wanted)
        if data is None:
            return None
        if len(data) != size or crc32c(data[:-4]) != int.from_bytes(data[-4:], "little"):
            raise DamagedFileError(f"{self._source}: the index of shard {shard} is damaged")
        return np.frombuffer(data[:-4], dtype="<u8").reshape(count, 2)

    def _read(self, place: Place, part: Any = None) -> bytes | None:
        """The bytes of a member of the store, or a part of them; None where it is not there."""
        from zarr.buffer import default_buffer_prototype
        from zarr.core.sync import sync

        key = self._array.metadata.encode_chunk_key(place)
        getter = (self._array.store_path / key).get(default_buffer_prototype(), part)
        found = sync(getter)
        return None if found is None else found.to_bytes()

    def _undone(self, place: Place, data: bytes) -> bytes:
        """The bytes of a chunk before the codecs that came after `fhash.transform`."""
        from zarr.buffer import default_buffer_prototype
        from zarr.core.array_spec import ArrayConfig, ArraySpec
        from zarr.core.sync import sync

        prototype, array = default_buffer_prototype(), self._array
        dtype, config = array.metadata.dtype, ArrayConfig.from_dict({})
        spec = ArraySpec(self._coding.chunk, dtype, array.fill_value, config, prototype)

        async def undo() -> Any:
            buffer: Any = prototype.buffer.from_bytes(data)
            for codec in reversed(self._coding.after):
                (buffer,) = await codec.decode([(buffer, spec)])
            return buffer

        try:
            return bytes(sync(undo()).to_bytes())
        except MemoryError:
            raise
        except Exception as error:  # codecs raise all kinds
            raise DamagedFileError(
                f"{self._source}: chunk {place} of {self.name} is damaged: {condense(error)}"
            ) from error
