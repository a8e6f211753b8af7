"""The codecs that a container may name: values of a chunk to bytes and back.

Every list of codecs ends in `crc32c`, so that any Zarr reader notices damage. The first codec makes
bytes of an array and decides which codecs may follow it. `ARRAY_CODECS` is the one place where
another first codec is added.
"""

from __future__ import annotations

import inspect
import struct
from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import (
    DamagedFileError,
    InputError,
    UnsupportedFileError,
)

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
CRC_BYTES = _CRC.size
"""Bytes of the CRC-32C behind a chunk."""
_ZSTD_MARK = 0xFD2FB528
_LITTLE: Codec = {"name": "bytes", "configuration": {"endian": "little"}}


class ChunkCoder(Protocol):
    """A coder of chunks of one number type and full shape.

    `decode` raises DamagedFileError before it allocates for bytes that do not fit. Three abilities
    are optional:

    - A coder that can decode with less detail has `decode(data, lod)`; level of detail 0 is all.
    - A coder whose chunks say which values are occupied has `masked` True and
      `decode_masked(data)`, which returns values and mask. Masks may lie in an array of their own:
      `join(data, mask)` makes the chunk that has its mask itself.
    - A coder that corrects its values last has `parted` True, `uncorrected(data, part)` and
      `corrected(table, part)`, by which a part of a chunk is had sooner than all of it.
    """

    def encode(self, chunk: npt.NDArray[Any]) -> bytes:
        """The bytes of a full chunk."""

    def decode(self, data: memoryview | bytes) -> npt.NDArray[Any]:
        """The full chunk in native byte order; it may be read-only."""


class PlainCoder:
    """The coder of ordinary arrays: `bytes` (little-endian, C order), then `zstd`."""

    def __init__(
        self, codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        """Raises UnsupportedFileError for codecs other than these two."""
        level = (
            codecs[1].get("configuration", {}).get("level")
            if len(codecs) == 2 and codecs[1]["name"] == "zstd"
            else None
        )
        if isinstance(level, bool) or not isinstance(level, int):
            raise UnsupportedFileError(
                f"codecs {_names(codecs)}; a container has bytes, zstd, crc32c"
            )
        expected = plain_codecs(dtype, level)[:-1]
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
        """The bytes of a full chunk."""
        from numcodecs.zstd import compress

        data: bytes = compress(np.ascontiguousarray(chunk, dtype=self._stored), self._level)
        return data

    def decode(self, data: memoryview | bytes) -> npt.NDArray[Any]:
        """The full chunk; raises DamagedFileError for data that are not a full chunk."""
        from numcodecs.zstd import decompress

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


def _transform_coder(
    codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> ChunkCoder:
    """The coder of `fhash.transform`, loaded only for containers that have this codec."""
    from fhash_formats.transform.stream import TransformCoder

    return TransformCoder(codecs, dtype, shape)


def _head_coder(
    codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> ChunkCoder:
    """The coder of `fhash.head`."""
    from fhash_formats.transform.parts import HeadCoder

    return HeadCoder(codecs, dtype, shape)


def _mask_coder(
    codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> ChunkCoder:
    """The coder of `fhash.mask`."""
    from fhash_formats.transform.parts import MaskCoder

    return MaskCoder(codecs, dtype, shape)


TRANSFORM = "fhash.transform"
HEAD = "fhash.head"
"""Codec of the head of a table, see `apart`."""
MASK = "fhash.mask"
"""Codec of the masks of a table's tiles, see `apart`."""
ARRAY_CODECS: dict[str, Callable[[Sequence[Codec], np.dtype[Any], tuple[int, ...]], ChunkCoder]] = {
    "bytes": PlainCoder,
    TRANSFORM: _transform_coder,
    HEAD: _head_coder,
    MASK: _mask_coder,
}
"""Coder by the name of the first codec; the coder is given all codecs but the last, `crc32c`."""


def transform_codecs(settings: TileSettings) -> list[Codec]:
    """The codecs of an array whose tiles share some settings."""
    return [{"name": TRANSFORM, "configuration": settings.to_dict()}, CRC32C]


class CheckedCoder:
    """A coder that puts the CRC-32C of a chunk's bytes behind them, and checks it on decoding."""

    def __init__(self, coder: ChunkCoder) -> None:
        self._coder = coder

    def encode(self, chunk: npt.NDArray[Any]) -> bytes:
        """The bytes of a full chunk and their CRC-32C."""
        return with_crc32c(self._coder.encode(chunk))

    def decode(
        self, data: memoryview, lod: int = 0, mask: memoryview | None = None
    ) -> npt.NDArray[Any]:
        """The full chunk at a level of detail; 0 is all of it.

        mask: the chunk's mask where it lies in an array of its own, without its CRC-32C.

        Raises DamagedFileError for damaged data, and InputError for another level of detail of a
        coder that has none.
        """
        coded = self._whole(data, mask)
        if lod == 0:
            return self._coder.decode(coded)
        if lod < 0 or "lod" not in inspect.signature(self._coder.decode).parameters:
            raise InputError(f"level of detail {lod}; the array has none but 0")
        return self._coder.decode(coded, lod)  # type: ignore[call-arg]

    @property
    def features(self) -> tuple[str, ...]:
        """Features that a reader of the chunks must know, besides that of the codec itself."""
        return tuple(getattr(self._coder, "features", ()))

    @property
    def settings(self) -> Any:
        """Settings that all chunks share, of a coder that has some (`TileSettings`); else None."""
        return getattr(self._coder, "settings", None)

    @property
    def axes(self) -> Any:
        """Axes of tiles along which the array is coded (`ArrayAxes`); None for the usual ones."""
        return getattr(self._coder, "axes", None)

    def decode_table(
        self, data: memoryview, lod: int = 0, mask: memoryview | None = None
    ) -> npt.NDArray[Any]:
        """The full chunk before it is corrected, for a coder that tells both apart.

        Raises DamagedFileError.
        """
        coded = self._whole(data, mask)
        decode = getattr(self._coder, "decode_table", None)
        values: npt.NDArray[Any] = decode(coded, lod) if decode else self._coder.decode(coded)
        return values

    @property
    def parted(self) -> bool:
        """Whether a part of a chunk may be had sooner than all of it, by the next two."""
        return bool(getattr(self._coder, "parted", False))

    def uncorrected(self, data: memoryview, part: tuple[slice, ...]) -> npt.NDArray[Any] | None:
        """The chunk as `corrected` takes it, for a coder that is `parted`.

        part: slices with explicit ends, of the values that will be wanted. The result is None
            where they are so many that `decode` takes no longer, and for chunks that are coded
            otherwise. Raises DamagedFileError.
        """
        table: npt.NDArray[Any] | None = self._coder.uncorrected(without_crc32c(data), part)  # type: ignore[attr-defined]
        return table

    def corrected(self, table: npt.NDArray[Any], part: tuple[slice, ...]) -> npt.NDArray[Any]:
        """A part of a chunk, with the bits of `decode`. table: what `uncorrected` gave."""
        values: npt.NDArray[Any] = self._coder.corrected(table, part)  # type: ignore[attr-defined]
        return values

    @property
    def masked(self) -> bool:
        """Whether the chunks say which of their values are occupied."""
        return bool(getattr(self._coder, "masked", False))

    def decode_masked(
        self, data: memoryview, mask: memoryview | None = None
    ) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
        """The full chunk and its mask, for a coder that is `masked`; raises DamagedFileError."""
        coded = self._whole(data, mask)
        values, occupied = self._coder.decode_masked(coded)  # type: ignore[attr-defined]
        return values, occupied

    def _whole(self, data: memoryview, mask: memoryview | None) -> memoryview | bytes:
        """The checked bytes of a chunk, with its mask put behind them."""
        coded = without_crc32c(data)
        if mask is None:
            return coded
        joined: bytes = self._coder.join(coded, mask)  # type: ignore[attr-defined]
        return joined


def chunk_coder(
    codecs: Sequence[Any], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> CheckedCoder:
    """The coder for chunks of this number type and full shape.

    Raises DamagedFileError for a list that is none of codecs, UnsupportedFileError for codecs that
    a container does not allow.
    """
    for codec in codecs:
        has_name = isinstance(codec, Mapping) and isinstance(codec.get("name"), str)
        if not has_name or not isinstance(codec.get("configuration", {}), Mapping):
            raise DamagedFileError("an array's codecs are not a list of {name, configuration}")
    if len(codecs) < 2 or codecs[-1] != CRC32C or codecs[0]["name"] not in ARRAY_CODECS:
        raise UnsupportedFileError(
            f"codecs {_names(codecs)}; "
            f"known are {', '.join(ARRAY_CODECS)} at the beginning and crc32c at the end"
        )
    return CheckedCoder(ARRAY_CODECS[codecs[0]["name"]](codecs[:-1], dtype, shape))


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


def crc32c(data: bytes | memoryview) -> int:
    """CRC-32C (Castagnoli) of `data`."""
    given = data if isinstance(data, bytes) else np.frombuffer(data, dtype=np.uint8).ctypes.data
    return int(native.library().fhash_crc32c(given, len(data), 0, 0))


def _names(codecs: Sequence[Codec]) -> str:
    return ascii(", ".join(codec["name"] for codec in codecs)[:200])
