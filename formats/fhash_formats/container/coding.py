"""The codecs that a container may name: values of a chunk to bytes and back.

The first codec makes bytes of an array and decides which codecs may follow it. Every chunk has a
CRC-32C: `fhash.transform` puts it into its streams, other lists of codecs end in `crc32c`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError
from fhash_formats.native import crc32c

if TYPE_CHECKING:
    from fhash_formats.transform.tile.settings import TileSettings

Codec = Mapping[str, Any]
"""A codec as Zarr v3 names it: {"name": str, "configuration": {...}}."""

ZSTD_LEVEL = 9
"""Level at which arrays are written; a reader takes any."""
ZSTD_MAX_RATIO = 32 << 10
"""Decoded bytes per byte of zstd data.

A block of at most 128 KiB takes at least a header of three bytes and one more (RFC 8878, 3.1.1.2).
"""
CRC32C: Codec = {"name": "crc32c"}

_CRC = struct.Struct("<I")
_ZSTD_MARK = 0xFD2FB528
_LITTLE: Codec = {"name": "bytes", "configuration": {"endian": "little"}}


class ChunkCoder(Protocol):
    """A coder of chunks of one number type and full shape. All methods raise DamagedFileError for
    bytes that do not fit, before they allocate for them.

    Attributes:
        settings: settings that all chunks share (`TileSettings`); None for a coder without any.
        axes: axes of tiles along which the array is coded (`ArrayAxes`); None for the usual ones.
        masked: whether the chunks say which of their values are occupied.
        parted: whether a part of a chunk may be had sooner than all of it, by the last two methods.
    """

    settings: Any
    axes: Any
    masked: bool
    parted: bool

    def encode(self, chunk: npt.NDArray[Any]) -> bytes:
        """The bytes of a full chunk."""

    def check(self, data: memoryview) -> None:
        """Raises DamagedFileError where the bytes of a chunk differ from their checksum."""

    def decode(self, data: memoryview, lod: int = 0) -> npt.NDArray[Any]:
        """The full chunk at a level of detail, in native byte order; it may be read-only.

        Raises InputError for a level of detail other than 0 of a coder that has none.
        """

    def decode_table(self, data: memoryview, lod: int = 0) -> npt.NDArray[Any]:
        """The full chunk before it is corrected, of a coder that tells both apart."""

    def decode_masked(self, data: memoryview) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
        """The full chunk and its mask, of a coder that is `masked`."""

    def uncorrected(self, data: memoryview, part: tuple[slice, ...]) -> npt.NDArray[Any] | None:
        """The chunk as `corrected` takes it, of a coder that is `parted`.

        part: slices with explicit ends, of the values that will be wanted. The result is None
            where they are so many that `decode` takes no longer, and for chunks that are coded
            otherwise.
        """

    def corrected(self, table: npt.NDArray[Any], part: tuple[slice, ...]) -> npt.NDArray[Any]:
        """A part of a chunk, with the bits of `decode`. table: what `uncorrected` gave."""


class PlainCoder:
    """The coder of ordinary arrays: `bytes` (little-endian, C order), `zstd`, then `crc32c`."""

    settings: Any = None
    axes: Any = None
    masked = False
    parted = False

    def __init__(
        self, codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        """Raises UnsupportedFileError for codecs other than these three."""
        level = (
            codecs[1].get("configuration", {}).get("level")
            if len(codecs) == 3 and codecs[1]["name"] == "zstd" and codecs[2] == CRC32C
            else None
        )
        if isinstance(level, bool) or not isinstance(level, int):
            raise UnsupportedFileError(
                f"codecs {_names(codecs)}; a container has bytes, zstd, crc32c"
            )
        expected = plain_codecs(dtype, level)
        # Zarr lets one-byte types state an endianness, which then means nothing.
        allowed = [expected[0], _LITTLE] if dtype.itemsize == 1 else [expected[0]]
        if codecs[0] not in allowed or codecs[1] != expected[1]:
            raise UnsupportedFileError(
                f"codecs {_names(codecs)} with settings that a container does not allow; "
                f"{expected} is allowed"
            )
        self._level, self._shape = level, shape
        self._stored, self._native = dtype.newbyteorder("<"), dtype.newbyteorder("=")
        self._size = prod(shape) * dtype.itemsize

    def encode(self, chunk: npt.NDArray[Any]) -> bytes:
        """The bytes of a full chunk, and their CRC-32C."""
        from numcodecs.zstd import compress

        return with_crc32c(compress(np.ascontiguousarray(chunk, dtype=self._stored), self._level))

    def check(self, data: memoryview) -> None:
        """Raises DamagedFileError where the CRC-32C differs."""
        without_crc32c(data)

    def decode(self, data: memoryview, lod: int = 0) -> npt.NDArray[Any]:
        """The full chunk; raises DamagedFileError for data that are not a full chunk.

        Raises InputError for a level of detail other than 0.
        """
        from numcodecs.zstd import decompress

        if lod:
            raise InputError(f"level of detail {lod}; the array has none but 0")
        data = without_crc32c(data)
        declared = zstd_content_size(data)
        if declared != self._size:
            raise DamagedFileError(f"zstd declares {declared} bytes; the chunk has {self._size}")
        if declared > ZSTD_MAX_RATIO * len(data):
            raise DamagedFileError(
                f"zstd declares {declared} bytes, which {len(data)} bytes cannot hold"
            )
        # The buffer has exactly the chunk's size, which bounds what a hostile frame can write.
        values = np.empty(self._shape, dtype=self._stored)
        try:
            decompress(data, values)
        except (RuntimeError, ValueError) as error:
            # zstd found no memory for its own work space: the data may be sound.
            if "Allocation error" in str(error):
                raise MemoryError("no memory to decompress a chunk") from error
            raise DamagedFileError(f"zstd data are damaged: {error}") from error
        return values.astype(self._native, copy=False)

    def decode_table(self, data: memoryview, lod: int = 0) -> npt.NDArray[Any]:
        """The full chunk, which nothing corrects."""
        return self.decode(data)

    def decode_masked(self, data: memoryview) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
        """Raises NotImplementedError: the chunks have no mask."""
        raise NotImplementedError

    def uncorrected(self, data: memoryview, part: tuple[slice, ...]) -> npt.NDArray[Any] | None:
        """Raises NotImplementedError: nothing is corrected."""
        raise NotImplementedError

    def corrected(self, table: npt.NDArray[Any], part: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Raises NotImplementedError: nothing is corrected."""
        raise NotImplementedError


def _transform_coder(
    codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> ChunkCoder:
    """The coder of `fhash.transform`, loaded only for containers that have this codec."""
    from fhash_formats.transform.stream import TransformCoder

    return TransformCoder(codecs, dtype, shape)


TRANSFORM = "fhash.transform"
ARRAY_CODECS: dict[str, Callable[[Sequence[Codec], np.dtype[Any], tuple[int, ...]], ChunkCoder]] = {
    "bytes": PlainCoder,
    TRANSFORM: _transform_coder,
}
"""Coder by the name of the first codec; the coder is given all codecs."""


def transform_codecs(settings: TileSettings) -> list[Codec]:
    """The codecs of an array whose tiles share some settings."""
    return [{"name": TRANSFORM, "configuration": {"settings": settings.to_text()}}]


def chunk_coder(codecs: Sequence[Any], dtype: np.dtype[Any], shape: tuple[int, ...]) -> ChunkCoder:
    """The coder for chunks of this number type and full shape.

    Raises DamagedFileError for a list that is none of codecs, UnsupportedFileError for codecs that
    a container does not allow.
    """
    for codec in codecs:
        has_name = isinstance(codec, Mapping) and isinstance(codec.get("name"), str)
        if not has_name or not isinstance(codec.get("configuration", {}), Mapping):
            raise DamagedFileError("an array's codecs are not a list of {name, configuration}")
    if not codecs or codecs[0]["name"] not in ARRAY_CODECS:
        raise UnsupportedFileError(
            f"codecs {_names(codecs)}; known are {', '.join(ARRAY_CODECS)} at the beginning"
        )
    return ARRAY_CODECS[codecs[0]["name"]](codecs, dtype, shape)


def plain_codecs(dtype: np.dtype[Any], level: int = ZSTD_LEVEL) -> list[Codec]:
    """The codecs of ordinary arrays, in the form in which the zarr library writes them."""
    first = {"name": "bytes"} if dtype.itemsize == 1 else _LITTLE
    return [first, {"name": "zstd", "configuration": {"level": level, "checksum": False}}, CRC32C]


def with_crc32c(data: bytes) -> bytes:
    """`data` followed by its CRC-32C: the codec `crc32c`."""
    return data + _CRC.pack(crc32c(data))


def without_crc32c(data: memoryview) -> memoryview:
    """`data` without the CRC-32C at their end; raises DamagedFileError where it differs."""
    if len(data) < _CRC.size:
        raise DamagedFileError(f"{len(data)} bytes are too few for a CRC-32C")
    coded = data[: -_CRC.size]
    if crc32c(coded) != _CRC.unpack(data[-_CRC.size :])[0]:
        raise DamagedFileError("its CRC-32C differs, the data are damaged")
    return coded


def zstd_content_size(data: memoryview | bytes) -> int | None:
    """The content size in the header of a zstd frame; None where the header has none.

    Raises DamagedFileError for data that do not begin with such a header (RFC 8878, 3.1.1.1).
    """
    if len(data) < 6 or int.from_bytes(data[:4], "little") != _ZSTD_MARK:
        raise DamagedFileError("not a zstd frame")
    descriptor = data[4]
    single_segment = bool(descriptor & 0x20)
    size_bytes = (1 if single_segment else 0, 2, 4, 8)[descriptor >> 6]
    at = 5 + (0 if single_segment else 1) + (0, 1, 2, 4)[descriptor & 3]
    if len(data) < at + size_bytes:
        raise DamagedFileError("the header of the zstd frame is cut short")
    if size_bytes == 0:
        return None
    return int.from_bytes(data[at : at + size_bytes], "little") + (256 if size_bytes == 2 else 0)


def _names(codecs: Sequence[Codec]) -> str:
    return ascii(", ".join(codec["name"] for codec in codecs)[:200])
