"""The codecs `fhash.head` and `fhash.mask` for Zarr format 3; zarr loads them by entry point.

So zarr shows the arrays of a container that have them. Both only read.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NoReturn, Self

from zarr.abc.codec import ArrayBytesCodec

from fhash_formats.errors import InputError
from fhash_formats.transform.parts import HeadCoder, MaskCoder

if TYPE_CHECKING:
    from zarr.core.array_spec import ArraySpec
    from zarr.core.buffer import Buffer, NDBuffer
    from zarr.core.common import JSON

__all__ = ["HeadCodec", "MaskCodec"]


@dataclass(frozen=True)
class _PartCodec(ArrayBytesCodec):
    """A codec without settings that decodes a part of a table, or says why it cannot."""

    is_fixed_size = False
    name: ClassVar[str]
    coder: ClassVar[type[HeadCoder | MaskCoder]]

    @classmethod
    def from_dict(cls, data: dict[str, JSON]) -> Self:
        """The codec from its metadata. Raises InputError for another name or settings."""
        if data.get("name") != cls.name or data.get("configuration", {}):
            raise InputError(f"codec {str(data)[:80]!a} is no {cls.name}, which has no settings")
        return cls()

    def to_dict(self) -> dict[str, JSON]:
        """The inverse of `from_dict`."""
        return {"name": self.name}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Raises NotImplementedError: the size is unknown."""
        raise NotImplementedError

    def _decode_sync(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        codecs, dtype = [self.to_dict()], chunk_spec.dtype.to_native_dtype()
        values = self.coder(codecs, dtype, chunk_spec.shape).decode(chunk_data.to_bytes())
        return chunk_spec.prototype.nd_buffer.from_numpy_array(values)

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        return await asyncio.to_thread(self._decode_sync, chunk_data, chunk_spec)

    async def _encode_single(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> NoReturn:
        raise InputError(f"{self.name} only decodes")


class HeadCodec(_PartCodec):
    """The codec of `mlp/parameters`: weights and biases of all layers, float32."""

    name = "fhash.head"
    coder = HeadCoder


class MaskCodec(_PartCodec):
    """The codec of `occupancy/mask`, whose values only `fhash_codec.open` decodes."""

    name = "fhash.mask"
    coder = MaskCoder
