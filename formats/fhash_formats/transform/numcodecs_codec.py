"""The codec `fhash.transform` for numcodecs, and so for Zarr format 2; loaded by its entry point.

The bytes are, with little-endian numbers: the magic `FHC1`; the type as numpy writes it, without
byte order (such as `f4`); the number of axes (one byte), plus 128 for an array in Fortran order;
the lengths (uint64); the CRC-32 of all these (uint32); and the stream of one tile.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numcodecs.abc import Codec
from numcodecs.compat import ensure_bytes, ndarray_copy

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.values import as_array
from fhash_formats.transform.spec import TransformSpec
from fhash_formats.transform.tile import (
    DEFAULT_EFFORT,
    Quality,
    check_effort,
    check_missing,
    decode_chunk,
    encode_chunk,
    supported,
)

_MAGIC = b"FHC1"
"""First bytes of a coded array."""
_TYPES = {b"f2", b"f4", b"f8", b"i1", b"i2", b"i4", b"i8", b"u1", b"u2", b"u4", b"u8"}
"""Types that are coded."""
_FORTRAN = 128
"""Added to the number of axes of an array whose first axis is the one that varies fastest.

Zarr format 2 takes the decoded bytes in the order that it gave them in.
"""
_MAX_AXES = 32
"""Most axes of an array."""
_MAX_VALUES = 1 << 40
"""Most values of an array."""


class NumcodecsTransform(Codec):  # type: ignore[misc]
    """The codec for arrays of float16 to float64 and integers, with any number of axes.

    Args:
        max_error: as in `Quality`; exactly one of the three is given.
        max_error_rel: as in `Quality`.
        step: as in `Quality`.
        transform: transform along the last four axes (t, z, y, x); None for the one that codes each
            array best.
        effort: as in `encode_chunk`: 1 is the fastest, 9 tries the most.
        missing: values that stand for missing ones, among them the fill value of the array, which
            numcodecs does not hand on.

    Raises InputError.
    """

    codec_id = "fhash.transform"

    def __init__(
        self,
        *,
        max_error: float | None = None,
        max_error_rel: float | None = None,
        step: float | None = None,
        transform: TransformSpec | Mapping[str, Any] | None = None,
        effort: int = DEFAULT_EFFORT,
        missing: Sequence[float] = (),
    ) -> None:
        check_effort(effort)
        check_missing(missing)
        self.effort = effort
        self.missing = tuple(missing)
        self.quality = Quality(max_error=max_error, max_error_rel=max_error_rel, step=step)
        self.transform = (
            TransformSpec.from_dict(transform) if isinstance(transform, Mapping) else transform
        )

    def get_config(self) -> dict[str, Any]:
        """The JSON values that `from_config` takes."""
        config: dict[str, Any] = {"id": self.codec_id, **self.quality.to_dict()}
        if self.transform is not None:
            config["transform"] = self.transform.to_dict()
        if self.effort != DEFAULT_EFFORT:
            config["effort"] = self.effort
        if self.missing:
            config["missing"] = [np.asarray(value).item() for value in self.missing]
        return config

    def encode(self, buf: Any) -> bytes:
        """The bytes of an array. Raises InputError for bytes, which have no number type."""
        if isinstance(buf, bytes | bytearray):
            raise InputError("fhash.transform codes numbers: give an array, not bytes")
        values = as_array(buf)
        dtype = supported(values.dtype)
        fortran = values.flags.f_contiguous and not values.flags.c_contiguous
        axes = values.ndim + (_FORTRAN if fortran else 0)
        header = (
            _MAGIC
            + dtype.str[1:].encode("ascii")
            + struct.pack(f"<B{values.ndim}Q", axes, *values.shape)
        )
        data = encode_chunk(
            values,
            **self.quality.to_dict(),
            transform=self.transform,
            effort=self.effort,
            missing=self.missing,
        )
        return header + zlib.crc32(header).to_bytes(4, "little") + data

    def decode(self, buf: Any, out: Any = None) -> Any:
        """The array, with the shape, order and type that were coded, in this machine's byte order.

        Raises DamagedFileError.
        """
        data = ensure_bytes(buf)
        fortran, axes = divmod(data[6], _FORTRAN) if len(data) >= 11 else (0, 0)
        if len(data) < 11 or data[:4] != _MAGIC or data[4:6] not in _TYPES or axes > _MAX_AXES:
            raise DamagedFileError("these bytes are not of the codec fhash.transform")
        end = 7 + 8 * axes
        if zlib.crc32(data[:end]).to_bytes(4, "little") != data[end : end + 4]:
            raise DamagedFileError("the head of an array coded by fhash.transform is damaged")
        shape = struct.unpack_from(f"<{axes}Q", data, 7)
        if math.prod(shape) > _MAX_VALUES:
            raise DamagedFileError(f"an array coded by fhash.transform claims the shape {shape}")
        values = decode_chunk(memoryview(data)[end + 4 :], shape, data[4:6].decode("ascii"))
        values = np.asfortranarray(values) if fortran else values
        return values if out is None else ndarray_copy(values, out)
