"""Arrays: metadata, values of a chunk as bytes, tiles that lie together in a member."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.zip_file import MAX_MEMBER
from fhash_formats.native import crc32c
from fhash_formats.support.threads import chunk_region
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.values import ZSTD_LEVEL

if TYPE_CHECKING:
    from fhash_formats.transform.stream import TransformCoder
    from fhash_formats.transform.tile_format import TileSettings

Codec = Mapping[str, Any]
"""A codec as Zarr v3 names it: {"name": str, "configuration": {...}}."""

CRC32C: Codec = {"name": "crc32c"}

_CRC = struct.Struct("<I")
_LITTLE: Codec = {"name": "bytes", "configuration": {"endian": "little"}}


class PlainCoder:
    """The coder of ordinary arrays: `bytes` (little-endian, C order), `zstd`, then `crc32c`."""

    def __init__(
        self, codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        """A coder of full chunks. codecs: what `plain_codecs` gave; shape: any."""
        self._level, self._stored = codecs[1]["configuration"]["level"], dtype.newbyteorder("<")

    def encode(self, chunk: npt.NDArray[Any]) -> bytes:
        """The bytes of a full chunk, and their CRC-32C."""
        from numcodecs.zstd import compress

        try:
            packed = compress(np.ascontiguousarray(chunk, dtype=self._stored), self._level)
        except RuntimeError as error:
            if "not enough memory" in str(error):
                raise MemoryError(str(error)) from error
            raise
        return with_crc32c(packed)


def _transform_coder(
    codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> TransformCoder:
    """The coder of `fhash.transform`, loaded only for containers that have this codec."""
    from fhash_formats.transform.stream import TransformCoder

    return TransformCoder(codecs, dtype, shape)


TRANSFORM = "fhash.transform"
ARRAY_CODECS: dict[str, Callable[..., PlainCoder | TransformCoder]] = {
    "bytes": PlainCoder,
    TRANSFORM: _transform_coder,
}
"""Coder by the name of the first codec; the coder is given all codecs."""


def transform_codecs(settings: TileSettings) -> list[Codec]:
    """The codecs of an array whose tiles share some settings."""
    return [{"name": TRANSFORM, "configuration": {"settings": settings.to_text()}}]


def with_mlp(codec: Codec, mlp: Mapping[str, Any]) -> Codec:
    """The codec of tiles with the MLP that the header has apart from their settings."""
    from fhash_formats.transform.head import NeighbourHead
    from fhash_formats.transform.tile_format import TileSettings

    configuration = codec["configuration"]
    settings = TileSettings.from_text(configuration["settings"], NeighbourHead.from_json(mlp))
    return {**codec, "configuration": {**configuration, "settings": settings.to_text()}}


def without_mlp(codec: Codec) -> tuple[Codec, Mapping[str, Any] | None]:
    """The codec of tiles without its MLP, and that as a header has it."""
    from fhash_formats.transform.tile_format import TileSettings

    configuration = codec["configuration"]
    if "settings" not in configuration:
        return codec, None
    settings = TileSettings.from_text(configuration["settings"])
    if settings.head is None:
        return codec, None
    apart = {**configuration, "settings": settings.to_text(apart=True)}
    return {**codec, "configuration": apart}, settings.head.to_json()


def chunk_coder(
    codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> PlainCoder | TransformCoder:
    """The coder for chunks of this number type and full shape."""
    return ARRAY_CODECS[codecs[0]["name"]](codecs, dtype, shape)


def plain_codecs(dtype: np.dtype[Any], level: int = ZSTD_LEVEL) -> list[Codec]:
    """The codecs of ordinary arrays, in the form in which the zarr library writes them."""
    first = {"name": "bytes"} if dtype.itemsize == 1 else _LITTLE
    return [first, {"name": "zstd", "configuration": {"level": level, "checksum": False}}, CRC32C]


def with_crc32c(data: bytes) -> bytes:
    """`data` followed by its CRC-32C: the codec `crc32c`."""
    return data + _CRC.pack(crc32c(data))


MAX_TOGETHER = 1 << 20
"""Tiles of a member that a reader accepts."""
SINGLE_MEMBER_TILES = 4096
"""Tiles up to which `tiles_together` puts a whole array into one member."""
TILES = "tiles"
"""Attribute of the index of tiles: what they are."""
PACKAGE = "fhash"
"""Package that decodes tiles, which the attribute names for readers of other libraries."""

Index = tuple[int, ...]


def tiles_together(grid: Sequence[int], sizes: npt.NDArray[np.int64] | None = None) -> Index:
    """Numbers of tiles along each axis that a writer lays into one member, of an array of a `grid`.

    One member holds the whole array up to SINGLE_MEMBER_TILES. A larger array gets a member for
    each layer of tiles along the first axis. Members beyond the limits of the format are halved,
    along the first axis first, so that C order stays the order of the file.

    sizes: coded bytes of each tile in C order; None for an array that is not that large.
    """
    counts = [grid[0] if prod(grid) <= SINGLE_MEMBER_TILES else 1, *grid[1:]]
    for axis in range(len(counts)):
        while counts[axis] > 1 and _beyond_limits(counts, grid, sizes):
            counts[axis] = -(-counts[axis] // 2)
    return tuple(counts)


def _beyond_limits(
    counts: Sequence[int], grid: Sequence[int], sizes: npt.NDArray[np.int64] | None
) -> bool:
    """Whether members of so many tiles along each axis have too many, or too many bytes."""
    if prod(counts) > MAX_TOGETHER:
        return True
    if sizes is None:
        return False
    total = np.reshape(sizes, grid)
    for axis, count in enumerate(counts):
        total = np.add.reduceat(total, range(0, grid[axis], count), axis=axis)
    return int(total.max()) > MAX_MEMBER


MAX_DIMENSIONS = 8
"""Axes of an array."""


@dataclass(frozen=True, kw_only=True)
class ArrayMetadata:
    """Shape, number type, chunking and codecs of an array.

    The chunks of an array of tiles are coded by `fhash.transform`. A member of the file holds one
    chunk, or several tiles in C order; an index then has the bytes of each.

    Every length is at least 1. The last chunks along an axis are stored in full, padded with 0.

    Attributes:
        together: tiles of a member along each axis; None for an array that has none.
        mlp: that of the header, which the tiles need.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_shape: tuple[int, ...]
    codecs: Sequence[Mapping[str, Any]]
    together: tuple[int, ...] | None = None
    mlp: Mapping[str, Any] | None = None
    dimension_names: tuple[str | None, ...] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def coder(self) -> PlainCoder | TransformCoder:
        """The coder of full chunks."""
        codecs = self.codecs
        if self.mlp is not None:
            codecs = [with_mlp(codecs[0], self.mlp)]
        return chunk_coder(codecs, self.dtype, self.chunk_shape)

    @property
    def tiles(self) -> TransformCoder | None:
        """The coder of an array whose chunks are tiles; None for another one."""
        return None if isinstance(self.coder, PlainCoder) else self.coder

    @property
    def coding(self) -> str:
        """Name of the first codec."""
        return str(self.codecs[0]["name"])

    @property
    def grid(self) -> tuple[int, ...]:
        """Number of chunks along each axis."""
        return tuple(-(-n // chunk) for n, chunk in zip(self.shape, self.chunk_shape, strict=True))

    @property
    def members(self) -> tuple[int, ...]:
        """Number of members along each axis."""
        together = self.together or (1,) * len(self.shape)
        return tuple(-(-n // count) for n, count in zip(self.grid, together, strict=True))

    @property
    def indexed(self) -> bool:
        """Whether members hold several tiles, whose bytes the index has."""
        return self.together is not None and prod(self.together) > 1

    def chunks_of(self, member: Index) -> Iterator[Index]:
        """The chunks of a member, in the order in which they lie in it."""
        together = self.together or (1,) * len(self.shape)
        return product(
            *(
                range(i * count, min((i + 1) * count, n))
                for i, count, n in zip(member, together, self.grid, strict=True)
            )
        )

    def in_order(self) -> Iterator[Index]:
        """Yield the chunks in the order in which they lie in the file."""
        for member in product(*map(range, self.members)):
            yield from self.chunks_of(member)

    def member_name(self, member: Index) -> str:
        """Name of a member below that of its array: "c/0/0" of a chunk, "t/0" of tiles."""
        if self.together is None:
            return "c/" + "/".join(str(i) for i in member)
        return f"t/{int(np.ravel_multi_index(member, self.members))}"

    def index_chunk(self, member: Index, sizes: Sequence[int]) -> bytes:
        """The chunk of the index of a member whose tiles have so many bytes."""
        assert self.together is not None
        chunk = np.zeros(self.together, dtype=np.uint32)
        there = (n - i * k for i, k, n in zip(member, self.together, self.grid, strict=True))
        part = chunk[tuple(slice(0, n) for n in there)]
        part[...] = np.reshape(sizes, part.shape)
        return PlainCoder(plain_codecs(chunk.dtype), chunk.dtype, self.together).encode(chunk)

    def region(self, index: Sequence[int]) -> tuple[slice, ...]:
        """The region of the array that a chunk holds, cut at the array's end."""
        return chunk_region(index, self.chunk_shape, self.shape)

    def to_dict(self) -> dict[str, Any]:
        """The array's zarr.json as JSON values; that of the index of an array of tiles."""
        shape, dtype, chunk = self.shape, self.dtype, self.chunk_shape
        codecs, attributes = self.codecs, dict(self.attributes)
        if self.together is not None:
            attributes[TILES] = {
                "codec": self.coding,
                "package": PACKAGE,
                "shape": list(shape),
                "data_type": dtype.name,
                "tile": list(chunk),
                **codecs[0]["configuration"],
            }
            shape, dtype, chunk = self.grid, np.dtype(np.uint32), self.together
            # An index without chunks names what it needs and no more.
            codecs = plain_codecs(dtype) if self.indexed else [_LITTLE]
        values: dict[str, Any] = {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(shape),
            "data_type": dtype.name,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk)}},
            # The separator of the default encoding is "/" where none is named.
            "chunk_key_encoding": {"name": "default"},
            "fill_value": 0.0 if dtype.kind == "f" else 0,
            "codecs": list(codecs),
        }
        if self.dimension_names is not None and self.together is None:
            values["dimension_names"] = list(self.dimension_names)
        if attributes:
            values["attributes"] = attributes
        return values

    @classmethod
    def from_dict(
        cls, values: Mapping[str, Any], mlp: Mapping[str, Any] | None = None
    ) -> ArrayMetadata:
        """The metadata in a zarr.json that libfhash has checked. mlp: that of the header."""
        attributes = dict(values.get("attributes", {}))
        tiles = attributes.pop(TILES, None)
        chunk = tuple(values["chunk_grid"]["configuration"]["chunk_shape"])
        if tiles is not None:
            configuration = {key: tiles[key] for key in ("settings", "axes") if key in tiles}
            return cls(
                shape=tuple(tiles["shape"]),
                dtype=DTYPES[tiles["data_type"]],
                chunk_shape=tuple(tiles["tile"]),
                codecs=[{"name": TRANSFORM, "configuration": configuration}],
                together=chunk,
                mlp=mlp,
                attributes=attributes,
            )
        names = values.get("dimension_names")
        return cls(
            shape=tuple(values["shape"]),
            dtype=DTYPES[values["data_type"]],
            chunk_shape=chunk,
            codecs=values["codecs"],
            dimension_names=None if names is None else tuple(names),
            attributes=attributes,
        )
