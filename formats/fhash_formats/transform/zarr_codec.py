"""The array-to-bytes codec `fhash.transform` for Zarr format 3; zarr loads it by its entry point.

    zarr.create_array(
        store,
        shape=...,
        chunks=...,
        dtype="float32",
        fill_value=np.nan,
        serializer=TransformCodec(max_error=0.01),
        compressors=None,
    )

Each chunk is one tile, which has a checksum. Do not compress the chunks again: use
`compressors=None`. The fill value of the array comes back exactly, and takes no part in range and
bound. So do the values of `missing`: a codec does not see attributes such as `missing_value`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from zarr.abc.codec import ArrayBytesCodec

from fhash_formats.errors import InputError
from fhash_formats.support.values import as_array
from fhash_formats.transform.spec import TransformSpec
from fhash_formats.transform.stream import KEY, ArrayAxes, settings_of, take_axes
from fhash_formats.transform.tile import (
    DEFAULT_EFFORT,
    Quality,
    check_effort,
    check_missing,
    decode_chunk,
    decode_tile,
    encode_chunk,
    encode_tile,
    supported,
    tile_shape,
)
from fhash_formats.transform.tile_format import TileSettings

if TYPE_CHECKING:
    from zarr.abc.buffer import Buffer, NDBuffer
    from zarr.core.array_spec import ArraySpec
    from zarr.core.common import JSON
    from zarr.core.dtype.wrapper import TBaseDType, TBaseScalar, ZDType

NAME = "fhash.transform"
"""Name of the codec in Zarr metadata."""


@dataclass(frozen=True, kw_only=True, repr=False)
class TransformCodec(ArrayBytesCodec):
    """The codec for arrays of float16 to float64 and integers, with any number of axes.

    The quality and `transform`, or `settings`, or `reading` is given.

    Attributes:
        max_error: as in `Quality`; exactly one of the three is given.
        max_error_rel: as in `Quality`, relative to the range of each chunk, which is that of the
            array at most.
        step: as in `Quality`.
        transform: transform along the last four axes (t, z, y, x); None for the one that codes each
            chunk best.
        effort: as in `encode_chunk`: 1 is the fastest, 9 tries the most.
        missing: values that stand for missing ones beside the array's fill value.
        settings: settings that all chunks share, as in containers.
        reading: whether the codec only decodes streams with their own settings, as in containers
            whose configuration is empty.
        axes: for each axis of the array, the axis "t", "z", "y" or "x" of its tiles, or "" for one
            along which chunks have length 1. By default the last four axes are these, and those
            before them are taken together with t.

    Raises InputError for other combinations.
    """

    is_fixed_size = False

    max_error: float | None = None
    max_error_rel: float | None = None
    step: float | None = None
    transform: TransformSpec | Mapping[str, Any] | None = None
    effort: int = DEFAULT_EFFORT
    missing: Sequence[float] = ()
    settings: TileSettings | None = None
    reading: bool = False
    axes: Sequence[str] | None = None

    def __post_init__(self) -> None:
        if self.axes is not None:
            object.__setattr__(self, "axes", ArrayAxes.of(self.axes).names)
        if self.settings is None and not self.reading:
            Quality(max_error=self.max_error, max_error_rel=self.max_error_rel, step=self.step)
            check_effort(self.effort)
            check_missing(self.missing)
            object.__setattr__(self, "missing", tuple(self.missing))
            if isinstance(self.transform, Mapping):
                object.__setattr__(self, "transform", TransformSpec.from_dict(self.transform))
        elif (
            (self.max_error, self.max_error_rel, self.step, self.transform) != (None,) * 4
            or self.effort != DEFAULT_EFFORT
            or len(self.missing)
            or (self.reading and self.settings)
        ):
            raise InputError(
                "settings that all chunks share, and reading, leave nothing else to be given"
            )

    @classmethod
    def from_dict(cls, data: dict[str, JSON]) -> Self:
        """The codec from its metadata, `{"name": ..., "configuration": ...}`. Raises InputError."""
        configuration = data.get("configuration", {})
        if data.get("name") != NAME or not isinstance(configuration, Mapping):
            raise InputError(
                f"codec {data.get('name')!r:.40} with {configuration!r:.60} is no {NAME}"
            )
        configuration, given = take_axes(configuration)
        axes = None if given is None else given.names
        if "settings" in configuration or not configuration:
            settings = settings_of(configuration)
            return cls(settings=settings, reading=settings is None, axes=axes)
        keys = ("max_error", "max_error_rel", "step", "transform", "effort", "missing")
        unknown = [key for key in configuration if key not in keys]
        if unknown:
            raise InputError(f"{NAME}: unknown key {unknown[0]!r:.40}; known: {', '.join(keys)}")
        values: dict[str, Any] = dict(configuration)
        return cls(**values, axes=axes)

    def to_dict(self) -> dict[str, JSON]:
        """The inverse of `from_dict`."""
        configuration: dict[str, Any]
        if self.settings is not None:
            configuration = {"settings": self.settings.to_text()}
        elif self.reading:
            configuration = {}
        else:
            quality = Quality(
                max_error=self.max_error, max_error_rel=self.max_error_rel, step=self.step
            )
            configuration = {**quality.to_dict()}
            if isinstance(self.transform, TransformSpec):
                configuration["transform"] = self.transform.to_dict()
            if self.effort != DEFAULT_EFFORT:
                configuration["effort"] = self.effort
            if self.missing:
                configuration["missing"] = [np.asarray(value).item() for value in self.missing]
        if self.axes is not None:
            configuration[KEY] = list(self.axes)
        return {"name": NAME, "configuration": configuration}

    def validate(
        self,
        *,
        shape: tuple[int, ...],
        dtype: ZDType[TBaseDType, TBaseScalar],
        chunk_grid: Any,
    ) -> None:
        """Raises InputError for a type that is not coded, and for axes of another array."""
        supported(dtype.to_native_dtype())
        if self.axes is not None and len(self.axes) != len(shape):
            raise InputError(f"{NAME}: axes {list(self.axes)} of an array with {len(shape)} axes")

    def __repr__(self) -> str:
        """One line: settings may hold all weights of a head."""
        shared = self.settings
        given = {
            "max_error": self.max_error,
            "max_error_rel": self.max_error_rel,
            "step": self.step if shared is None else shared.step,
            "head": None if shared is None else shared.head is not None or None,
            "mask": None if shared is None else shared.mask is not None or None,
            "reading": self.reading or None,
        }
        told = (f"{name}={value!r}" for name, value in given.items() if value is not None)
        return f"TransformCodec({', '.join(told)})"

    def evolve_from_array_spec(self, array_spec: ArraySpec) -> Self:
        """The codec itself: no option depends on the array.

        Raises InputError for a type that is not coded.
        """
        supported(array_spec.dtype.to_native_dtype())
        return self

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Raises NotImplementedError: the size is unknown before the chunk is coded."""
        raise NotImplementedError

    def _encode_sync(self, chunk_array: NDBuffer, chunk_spec: ArraySpec) -> Buffer | None:
        if self.reading:
            raise InputError(
                f"{NAME} without a configuration only decodes: "
                "give max_error, max_error_rel or step to write"
            )
        # Filters of numcodecs give one axis, and decoding knows the shape alone.
        values = as_array(chunk_array.as_ndarray_like()).reshape(chunk_spec.shape)
        if self.axes is not None:
            values = ArrayAxes.of(self.axes).to_tile(values)
        if self.settings is None:
            data = encode_chunk(
                values,
                max_error=self.max_error,
                max_error_rel=self.max_error_rel,
                step=self.step,
                transform=self.transform,
                missing=(chunk_spec.fill_value, *self.missing),
                effort=self.effort,
            )
        else:
            tile = np.ascontiguousarray(values, dtype=supported(values.dtype)).reshape(
                tile_shape(values.shape)
            )
            data = encode_tile(tile, self.settings).data
        return chunk_spec.prototype.buffer.from_bytes(data)

    def _decode_sync(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        data, shape = chunk_data.to_bytes(), chunk_spec.shape
        dtype = chunk_spec.dtype.to_native_dtype()
        axes = None if self.axes is None else ArrayAxes.of(self.axes)
        tile = tile_shape(shape) if axes is None else axes.tile_shape(shape)
        if self.settings is None:
            values = decode_chunk(data, tile, dtype)
        else:
            values = decode_tile(data, tile, supported(dtype), self.settings)
            values = values.astype(dtype, copy=False)
        values = values.reshape(shape) if axes is None else axes.from_tile(values)
        return chunk_spec.prototype.nd_buffer.from_numpy_array(values)

    async def _encode_single(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer | None:
        return await asyncio.to_thread(self._encode_sync, chunk_data, chunk_spec)

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        return await asyncio.to_thread(self._decode_sync, chunk_data, chunk_spec)
