"""Decoding of a tile, whole or in a region, by the native library (native/tile.cpp)."""

from __future__ import annotations

import ctypes
import os
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.arrays import Integers, Mask, Values
from fhash_formats.support.threads import usable_threads
from fhash_formats.transform.lifting import Transform
from fhash_formats.transform.predict import Predictor, values_of
from fhash_formats.transform.spec import TransformSpec
from fhash_formats.transform.tile_format import Shape, TileSettings
from fhash_formats.transform.values import OFFSET_UNIT, cast, clip_shifted, clipped, dequantise

_ARGUMENT, _MEMORY, _DAMAGED = -1, -2, -3
"""Statuses of the native library (fhash.h)."""
_TYPES = ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
"""Types of arrays in the order of their numbers in fhash.h, from 1."""


class _Error(ctypes.Structure):
    _fields_ = (("status", ctypes.c_int32), ("text", ctypes.c_char * 500))


class _Tile(ctypes.Structure):
    _fields_ = (
        ("shape", ctypes.c_int64 * 4),
        ("type", ctypes.c_int32),
        ("reserved", ctypes.c_int32),
        ("settings", ctypes.c_char_p),
        ("settings_size", ctypes.c_size_t),
    )


@lru_cache
def _context(threads: int) -> ctypes.c_void_p:
    """What calls that use so many threads share."""
    return ctypes.c_void_p(native.library().fhash_context_create(0, threads))


if hasattr(os, "register_at_fork"):  # a thread of the parent may have held the context's lock
    os.register_at_fork(after_in_child=_context.cache_clear)


def _tile(shape: Shape, dtype: np.dtype[Any], settings: TileSettings | None) -> _Tile:
    packed = None if settings is None else settings.packed
    number = _TYPES.index(f"{dtype.kind}{dtype.itemsize}") + 1
    return _Tile((ctypes.c_int64 * 4)(*shape), number, 0, packed, len(packed or b""))


def _call(name: str, tile: _Tile, *arguments: Any) -> None:
    """Call a function on a tile. Raises DamagedFileError, InputError or MemoryError."""
    error = _Error()
    context = _context(usable_threads())
    function = getattr(native.library(), name)
    status = function(context, ctypes.byref(tile), *arguments, ctypes.byref(error))
    if not status:
        return
    text = error.text.decode("utf-8", "replace")
    if status == _MEMORY:
        raise MemoryError(text)
    raise (DamagedFileError if status == _DAMAGED else InputError)(text)


def _stream(data: bytes | memoryview) -> tuple[ctypes.c_void_p, int]:
    """Address and size of a stream; the pointer keeps the bytes alive."""
    return np.frombuffer(data, np.uint8).ctypes.data_as(ctypes.c_void_p), len(data)


def _pointer(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def transform_for(settings: TileSettings, shape: Shape) -> Transform:
    """The transform of a tile; the same object for tiles of the same settings and shape."""
    return _transform(settings.transform, shape, settings.dtype.name)


@lru_cache(maxsize=64)
def _transform(spec: TransformSpec, shape: Shape, dtype: str) -> Transform:
    return Transform(spec, shape, np.dtype(dtype))


def decode_tile(
    data: bytes | memoryview,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings | None = None,
    lod: int = 0,
) -> Values:
    """The values (t, z, y, x) of a stream, in the type of the source.

    Args:
        data: the stream.
        shape: shape of the tile.
        dtype: type of the source.
        settings: settings that all tiles share; a stream's own settings replace them.
        lod: level of detail. n gives every 2^n-th vertex along z, y, x, low-passed, without head,
            residual, missing values and mask.

    Raises DamagedFileError for bytes that no encoder writes.
    """
    kind = np.dtype(dtype)
    values = np.empty(_lod_shape(shape, lod), kind)
    tile = _tile(shape, kind, settings)
    _call("fhash_tile_decode", tile, *_stream(data), lod, _pointer(values), None)
    return values


def decode_tile_mask(
    data: bytes | memoryview,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings | None = None,
) -> tuple[Values, Mask]:
    """The values of a stream as `decode_tile` gives them, and which of them are occupied.

    All values are occupied where the stream has no mask.
    """
    kind = np.dtype(dtype)
    values, mask = np.empty(shape, kind), np.empty(shape, np.bool_)
    tile = _tile(shape, kind, settings)
    _call("fhash_tile_decode", tile, *_stream(data), 0, _pointer(values), _pointer(mask))
    return values, mask


def decode_tile_table(
    data: bytes | memoryview,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings | None = None,
    lod: int = 0,
) -> Values:
    """The table (t, z, y, x) of a tile: its values before head, residual and rounding.

    They are finite, of `TileSettings.table_dtype` (float64 without settings). Where the tile is not
    coded by transform, they are its values; `center` stands for those that are not finite.
    Arguments and errors are those of `decode_tile`.
    """
    room = np.empty(_lod_shape(shape, lod), np.float64)
    wide, origin = ctypes.c_int32(), (ctypes.c_uint64 * 2)()
    tile, results = _tile(shape, np.dtype(dtype), settings), (ctypes.byref(wide), origin)
    _call("fhash_tile_table", tile, *_stream(data), lod, _pointer(room), *results)
    table = room if wide else room.reshape(-1).view(np.float32)[: room.size].reshape(room.shape)
    first = origin[0] - (origin[1] << 64)
    return table.astype(np.float64) + first if first else table


def linear_values(
    integers: Integers,
    transform: Transform,
    settings: TileSettings,
    lod: int = 0,
    *,
    in_place: bool = False,
) -> Values:
    """Values before head and residual, in the working type, clipped to the range.

    Args:
        integers: the quantised coefficients.
        transform: the transform of the tile.
        settings: settings of the tile.
        lod: level of detail, as in `decode_tile`.
        in_place: whether the integers may be overwritten.
    """
    if not lod:
        offsets = (offset / OFFSET_UNIT for offset in settings.offsets)
        numbers = (settings.step, *offsets, settings.center, settings.low, settings.high)
        values = transform.reconstruct(integers, numbers, in_place=in_place)
        if values is not None:
            return values
    coefficients = dequantise(integers, settings.step, settings.offsets, settings.dtype)
    return clip_shifted(
        transform.inverse(coefficients, lod), settings.center, settings.low, settings.high
    )


def predicted_values(
    integers: Integers, predictor: Predictor, settings: TileSettings
) -> npt.NDArray[np.float64]:
    """Values of a tile that is coded by prediction, clipped to the range."""
    values = values_of(integers, predictor)
    return np.clip(values, settings.low, settings.high, out=values)


def within_range(decoded: Values, settings: TileSettings) -> Values:
    """Decoded values in the type of the array, clipped to the range if the settings ask for it.

    In place. It takes no value farther from one that lies in the range.
    """
    return clipped(decoded, settings.low, settings.high) if settings.clip else decoded


def blank_unoccupied(decoded: Values, occupied: Mask | None, settings: TileSettings) -> Values:
    """Decoded values with NaN, or for integers the centre, wherever a mask has no bit; in place."""
    if occupied is not None:
        blank = np.array(np.nan) if decoded.dtype.kind == "f" else np.array(settings.center)
        decoded[~occupied] = cast(blank, decoded.dtype)
    return decoded


def _lod_shape(shape: Shape, lod: int) -> tuple[int, ...]:
    """Shape of a tile at a level of detail."""
    return (shape[0], *(-(-n // (1 << lod)) for n in shape[1:]))


def uncorrected(
    data: bytes | memoryview,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings,
    part: tuple[slice, ...],
) -> Values | None:
    """The values of a tile before its head, where nothing but `corrected_region` is left to do.

    They are less the origin of the settings. None for other tiles, and where the part is a large
    one.

    Raises DamagedFileError for bytes that no encoder writes.
    """
    table, done = np.empty(shape, np.float32), ctypes.c_int32()
    results = (_part(part), _pointer(table), ctypes.byref(done))
    tile = _tile(shape, np.dtype(dtype), settings)
    _call("fhash_tile_uncorrected", tile, *_stream(data), *results)
    return table if done else None


def corrected_region(
    table: Values, part: tuple[slice, ...], dtype: npt.DTypeLike, settings: TileSettings
) -> Values:
    """A part of the values of a tile, as `decode_tile` gives them, in a new array.

    table: what `uncorrected` gave. part: slices (t, z, y, x) with explicit ends.
    """
    values = np.empty([along.stop - along.start for along in part], dtype)
    t, z, y, x = table.shape
    tile = _tile((t, z, y, x), values.dtype, settings)
    _call("fhash_tile_part", tile, _pointer(table), _part(part), _pointer(values))
    return values


def _part(part: tuple[slice, ...]) -> Any:
    """First and last vertex along each axis."""
    return (ctypes.c_int64 * 8)(*(end for along in part for end in (along.start, along.stop)))
