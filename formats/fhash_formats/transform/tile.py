"""Coding of a tile by libfhash (native/tile.cpp, encode.cpp, chunk.cpp)."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, FhashError, InputError, UnsupportedFileError
from fhash_formats.native import ffi, pointer
from fhash_formats.support.threads import usable_threads
from fhash_formats.support.values import Integers, Mask, Values, as_array
from fhash_formats.transform.predict import Predictor
from fhash_formats.transform.spec import KINDS, AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import Shape, TileSettings
from fhash_formats.transform.values import about_origin, at_origin

WEIGHT = 0.09
"""Squared steps of the plain quantiser that a bit is worth (best between 0.07 and 0.11 in
experiments)."""
OFFSETS = (-5, -1, 0, 0, 0, 0)
"""Shift, in 1/128 step, of the decoded magnitudes after the optimisation, see FORMAT.md, Decoding.

native/encode.hpp has the same, and SHARE."""
SHARE = 0.65
"""Step on the trellis as a share of the plain quantiser's of about the same error and bytes."""
TRELLIS_WEIGHT = 0.27
"""Squared steps on the trellis that a bit is worth (0.25 to 0.3 are alike in experiments)."""
TRELLIS_OFFSETS = (17, -10, -5, -3, -2, -1)
"""The same with two quantisers.

It is the mean over coefficients of many series, which differ by 3 or less.
"""
DENSITIES = (1, 8)
"""Thresholds per factor of two with which values may be filled."""

MAX_MISSING = 16
"""Values that an array may have for missing ones (native/chunk.cpp)."""

_MEMORY, _DAMAGED, _UNSUPPORTED = (
    ffi.integer_const(f"FHASH_ERROR_{name}") for name in ("MEMORY", "DAMAGED", "UNSUPPORTED")
)
_ERRORS: dict[int, type[FhashError]] = {
    _DAMAGED: DamagedFileError,
    _UNSUPPORTED: UnsupportedFileError,
}
"""Errors by their status in the native library; InputError for others."""
_OPTIONS = [name for name, _ in ffi.typeof("fhash_coding").fields]
"""Names of the options of a `Coding` that the library knows."""
_TYPES = ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
"""Types of arrays in the order of their numbers in fhash.h, from 1."""


@lru_cache
def context(threads: int) -> Any:
    """The context of calls that use so many threads."""
    return native.library().fhash_context_create(0, threads)


if hasattr(os, "register_at_fork"):  # a thread of the parent may have held the context's lock
    os.register_at_fork(after_in_child=context.cache_clear)


def _tile(shape: Shape, dtype: np.dtype[Any], settings: TileSettings | None) -> Any:
    """A `fhash_tile`; its settings keep the bytes that it points to."""
    number = _TYPES.index(f"{dtype.kind}{dtype.itemsize}") + 1
    if settings is None:
        return ffi.new("fhash_tile *", (shape, number))
    packed = settings.packed
    return ffi.new("fhash_tile *", (shape, number, 0, ffi.from_buffer(packed), len(packed)))


def _tile_of(values: Values, settings: TileSettings) -> Any:
    t, z, y, x = values.shape
    return _tile((t, z, y, x), values.dtype, settings)


def call(name: str, *arguments: Any) -> None:
    """Call a function between a context and room for an error; raises what `checked` raises."""
    checked(name, context(usable_threads()), *arguments)


def checked(name: str, *arguments: Any) -> None:
    """Call a function with room for an error behind its arguments.

    Raises DamagedFileError, UnsupportedFileError, InputError or MemoryError.
    """
    error = ffi.new("fhash_error *")
    status = getattr(native.library(), name)(*arguments, error)
    if not status:
        return
    text = ffi.string(error.text).decode("utf-8", "replace")
    if status == _MEMORY:
        raise MemoryError(text)
    raise _ERRORS.get(status, InputError)(text)


def _stream(data: bytes | memoryview) -> tuple[Any, int]:
    """The bytes of a stream, and their number."""
    return ffi.from_buffer(data), len(data)


@dataclass(frozen=True, kw_only=True)
class Coding:
    """Options of the encoder: how hard it works, what it keeps. A decoder needs none of them.

    Attributes:
        weight: squared quantiser steps that a bit is worth in rate-distortion optimisation; 0 for
            none.
        error: bound on |decoded - value| at every counted value, in units of the values. It is kept
            strictly; a tile that cannot keep it is stored without loss. None for no bound.
        aim: squared error that the choice of integers aims at, as a multiple of what coefficients
            predict (native/choose.cpp): the weight changes a little for it. 0 for none.
        joint: part of the correction of a head that values are coded less by, since it adds them
            when they decode; 0 for none.
        rounds: how often the values that are free to change are replaced by their decoded values.
        passes: 2 codes the integers that the optimisation chose once more, or searches the path
            through the trellis once more; 1 does not.
        filled: whether the values that are not counted are a good filling already, such as repeated
            border values. Otherwise the encoder looks for a better one.
        density: how thoroughly it looks; see `filled`.
        keep_missing: whether values that are not finite come back as they were.
        own_settings: whether the stream holds the settings.
        fast: whether coefficients and residual are coded by the fast coder, for more bytes.
        cut: logarithms of the lengths of blocks to the base 2, four bits each for t, z, y, x from
            the lowest on; 0 for those that pay where small regions are read (native/cut.cpp).
    """

    weight: float = 0.0
    error: float | None = None
    aim: float = 0.0
    joint: float = 0.0
    rounds: int = 0
    passes: int = 1
    filled: bool = False
    density: int = 1
    keep_missing: bool = True
    own_settings: bool = False
    fast: bool = False
    cut: int = 0


_DEFAULT_CODING = Coding()


@dataclass(frozen=True, kw_only=True)
class CodedTile:
    """A coded tile.

    Attributes:
        data: the stream.
        decoded: the values that the stream decodes to, in the type of the source.
        nonzero: number of coded integers that are not 0.
    """

    data: bytes
    decoded: Values
    nonzero: int


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
    call("fhash_tile_decode", tile, *_stream(data), lod, pointer(values), ffi.NULL)
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
    call("fhash_tile_decode", tile, *_stream(data), 0, pointer(values), pointer(mask))
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
    wide, origin = ffi.new("int32_t *"), ffi.new("uint64_t[2]")
    tile, results = _tile(shape, np.dtype(dtype), settings), (wide, origin)
    call("fhash_tile_table", tile, *_stream(data), lod, pointer(room), *results)
    table = room if wide[0] else room.reshape(-1).view(np.float32)[: room.size].reshape(room.shape)
    first = origin[0] - (origin[1] << 64)
    return table.astype(np.float64) + first if first else table


def encode_tile(
    values: Values,
    settings: TileSettings,
    coding: Coding = _DEFAULT_CODING,
    *,
    in_coreset: Mask | None = None,
) -> CodedTile:
    """Code the values of a tile.

    Args:
        values: the tile (t, z, y, x), of any real type, with the origin of the settings.
        settings: transform, step, range and so on.
        coding: options of the encoder.
        in_coreset: the values that count, of the same shape; None for all. Values that are not
            finite never count.

    Raises InputError for values that have no differences from the origin.
    """
    if not values.size:
        return CodedTile(data=b"", decoded=values.copy(), nonzero=0)
    return _coded(values, settings, coding, in_coreset)


def encode_for(tile: Values, quality: tuple[Any, ...], missing: Values) -> bytes:
    """The stream of a tile (t, z, y, x), with settings of its own, for a quality.

    quality: the numbers of `fhash_quality` (fhash.h). missing: values that stand for missing ones,
    of the tile's type.
    """
    *numbers, transform = quality
    t, z, y, x = tile.shape
    of = _tile((t, z, y, x), tile.dtype, None)
    room = np.empty(native.library().fhash_tile_bound(of), np.uint8)
    asked = ffi.new("fhash_quality *", (*numbers, transform, missing.size))
    size = ffi.new("size_t *")
    results = (pointer(room), room.size, size)
    given = (asked, pointer(missing if missing.size else None))
    call("fhash_tile_encode", of, pointer(tile), *given, *results)
    return room[: size[0]].tobytes()


def exact_tile(values: Values, occupied: Mask | None = None, *, origin: int = 0) -> CodedTile:
    """A tile stored without loss: its bytes, those of equal weight together, deflated.

    Args:
        values: the tile (t, z, y, x), of any real type.
        occupied: the mask, for a stream with one. Values outside of it become NaN, or 0 for
            integers.
        origin: integer that is subtracted from the values, where they have not lost it yet.
    """
    if origin:
        coded = exact_tile(about_origin(values, origin), occupied)
        return replace(coded, decoded=at_origin(coded.decoded, origin, values.dtype))
    return _coded(values, None, _DEFAULT_CODING, occupied)


def _coded(
    values: Values, settings: TileSettings | None, coding: Coding, mask: Mask | None
) -> CodedTile:
    """The coded tile; without settings it is stored without loss."""
    values = np.ascontiguousarray(values)
    given = None if mask is None else np.ascontiguousarray(mask, np.bool_)
    options = {name: getattr(coding, name) for name in _OPTIONS}
    options["error"] = -1 if coding.error is None else coding.error
    asked, decoded = ffi.new("fhash_coding *", options), np.empty_like(values)
    data, size, nonzero = ffi.new("uint8_t **"), ffi.new("size_t *"), ffi.new("int64_t *")
    t, z, y, x = values.shape
    call(
        "fhash_tile_code",
        _tile((t, z, y, x), values.dtype, settings),
        pointer(values),
        pointer(given),
        asked,
        pointer(decoded),
        *(data, size, nonzero),
    )
    try:
        stream = bytes(ffi.buffer(data[0], size[0]))
    finally:
        native.library().fhash_tile_free(data[0])
    return CodedTile(data=stream, decoded=decoded, nonzero=nonzero[0])


def with_trellis(settings: TileSettings) -> TileSettings:
    """The settings with two quantisers in place of the plain one, at about the same error."""
    return replace(settings, trellis=True, step=settings.step * SHARE, offsets=TRELLIS_OFFSETS)


def plain_step(settings: TileSettings) -> float:
    """The step with which the plain quantiser errs about as much, in units of the values."""
    return settings.step / SHARE if settings.trellis else settings.step


def filled(
    target: Values, counted: Mask, finite: Mask, settings: TileSettings, density: int = 1
) -> Values:
    """`target` (t, z, y, x) with fill values where it is not counted.

    The search starts from the present values, which often continue the counted ones, or from the
    mean of the counted values, whichever takes fewer bits. The present values stay where they take
    no more bytes than the result.

    Args:
        target: the tile, in the working type.
        counted: the values to keep.
        finite: where the tile has present values.
        settings: settings of the tile; the step is the one the fill values are made for.
        density: thresholds per factor of two, one of DENSITIES. 0 goes on from a filling that was
            made for other settings, by a few thresholds.
    """
    result = np.array(target, settings.dtype, order="C")
    masks = [np.ascontiguousarray(mask, np.bool_) for mask in (counted, finite)]
    pointers = [pointer(array) for array in (*masks, result)]
    call("fhash_tile_fill", _tile_of(result, settings), *pointers[:2], density, pointers[2])
    return result


def forward(values: Values, settings: TileSettings) -> Values:
    """Coefficients of a tile (t, z, y, x): a new array of the working type, low bands first.

    Entries beyond a basis's rank are 0. Raises InputError for a basis that cannot encode, and
    DamagedFileError for one of another length than its axis.
    """
    values = np.ascontiguousarray(values, settings.dtype)
    result = np.empty_like(values)
    call("fhash_tile_forward", _tile_of(values, settings), pointer(values), pointer(result))
    return result


def predicted_size(integers: Integers, counted: Mask | None, predictor: Predictor) -> int:
    """The bytes that integers of a tile (t, z, y, x) take where a predictor codes them.

    counted: the integers that must come back, a mask; None for all.
    """
    settings = TileSettings(
        transform=NO_TRANSFORM,
        step=1.0,
        center=0.0,
        low=0.0,
        high=0.0,
        predictor=predictor,
    )
    given, size = np.ascontiguousarray(integers, np.int32), ffi.new("int64_t *")
    mask = None if counted is None else np.ascontiguousarray(counted, np.bool_)
    tile = _tile_of(given, settings)
    call("fhash_tile_foretold", tile, pointer(given), pointer(mask), size)
    return int(size[0])


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
    table, done = np.empty(shape, np.float32), ffi.new("int32_t *")
    results = (_part(part), pointer(table), done)
    tile = _tile(shape, np.dtype(dtype), settings)
    call("fhash_tile_uncorrected", tile, *_stream(data), *results)
    return table if done[0] else None


def decode_region(
    data: bytes | memoryview,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings | None,
    part: tuple[slice, ...],
) -> Values | None:
    """A part of the values of a tile, as `decode_tile` gives them, from the blocks that it needs.

    None where the tile has no blocks, or so many are needed that it is as well decoded whole.

    part: slices (t, z, y, x) with explicit ends.

    Raises DamagedFileError for bytes that no encoder writes.
    """
    values = np.empty([along.stop - along.start for along in part], dtype)
    done = ffi.new("int32_t *")
    tile = _tile(shape, values.dtype, settings)
    call("fhash_tile_region", tile, *_stream(data), _part(part), pointer(values), done)
    return values if done[0] else None


def corrected_region(
    table: Values, part: tuple[slice, ...], dtype: npt.DTypeLike, settings: TileSettings
) -> Values:
    """A part of the values of a tile, as `decode_tile` gives them, in a new array.

    table: what `uncorrected` gave. part: slices (t, z, y, x) with explicit ends.
    """
    values = np.empty([along.stop - along.start for along in part], dtype)
    t, z, y, x = table.shape
    tile = _tile((t, z, y, x), values.dtype, settings)
    call("fhash_tile_part", tile, pointer(table), _part(part), pointer(values))
    return values


def _part(part: tuple[slice, ...]) -> list[int]:
    """First and last vertex along each axis."""
    return [end for along in part for end in (along.start, along.stop)]


NO_TRANSFORM = TransformSpec(axes=(AxisTransform(kind="none"),) * 4)
"""The shortest description of a transform."""
DEFAULT_EFFORT = 2
"""Least effort that makes trials."""
_MAX_EFFORT = 9
"""Highest effort, as for containers."""


@dataclass(frozen=True, kw_only=True)
class Quality:
    """The quality asked of a chunk: exactly one of the three. Raises InputError.

    Attributes:
        max_error: bound on |decoded - value|, in units of the values, kept strictly; 0 is lossless.
        max_error_rel: the same bound as a fraction of the range of the chunk's finite values, but
            for those that a store may have put there, see `encode_chunk`.
        step: quantiser step, in units of the values, without a bound.
    """

    max_error: float | None = None
    max_error_rel: float | None = None
    step: float | None = None

    def __post_init__(self) -> None:
        given = self.to_dict()
        if len(given) != 1:
            named = " and ".join(given) if given else "none"
            raise InputError(
                f"fhash.transform needs one of max_error, max_error_rel and step; given: {named}"
            )
        for name, value in given.items():
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or not 0 <= value < math.inf
            ):
                raise InputError(f"{name} is {value!r:.40}; a finite number, 0 or more, is needed")
        if self.step == 0:
            raise InputError("step is 0; a number above 0 is needed (max_error 0 is lossless)")

    def to_dict(self) -> dict[str, float]:
        """The quality that is given, by its name."""
        qualities = {
            "max_error": self.max_error,
            "max_error_rel": self.max_error_rel,
            "step": self.step,
        }
        return {name: value for name, value in qualities.items() if value is not None}


def supported(dtype: npt.DTypeLike) -> np.dtype[Any]:
    """The type in this machine's byte order.

    Raises InputError unless the type is float16, float32, float64 or an integer.
    """
    kind = np.dtype(dtype)
    if kind.kind not in "fiu" or kind.itemsize > 8:
        raise InputError(
            f"fhash.transform codes float16, float32, float64 and integers, not {kind.name}"
        )
    return kind.newbyteorder("=")


def tile_shape(shape: tuple[int, ...]) -> Shape:
    """The shape (t, z, y, x) of a tile for an array of any number of axes.

    Fewer axes get ones in front. Of more than four, the leading ones become one.
    """
    lengths = (1, 1, 1, *shape)
    z, y, x = lengths[-3:]
    return math.prod(lengths[:-3]), z, y, x


def encode_chunk(
    values: Values,
    *,
    max_error: float | None = None,
    max_error_rel: float | None = None,
    step: float | None = None,
    transform: TransformSpec | Mapping[str, Any] | None = None,
    missing: Sequence[Any] = (),
    effort: int = DEFAULT_EFFORT,
) -> bytes:
    """The stream of an array.

    NaN, infinities and missing values come back bit by bit, and take no part in range or bound. So
    do planes of zeros, which stores have where nothing was written, and values that are farther
    from all others than these are from each other, such as -999 in a file that says only in an
    attribute what it means.

    Args:
        values: array of a type that `supported` accepts; its axes become those of `tile_shape`.
        max_error: as in `Quality`; exactly one of the three is given.
        max_error_rel: as in `Quality`.
        step: as in `Quality`.
        transform: transform along (t, z, y, x); None for the one that codes best in a trial.
        missing: values that stand for missing ones, at most 16: the fill value of the store, and
            others such as `missing_value` of CF.
        effort: 1 tries nothing; 2 to 9 try transforms, steps and two quantisers, on ever larger
            parts of the array.

    Raises InputError.
    """
    check_effort(effort)
    quality = Quality(max_error=max_error, max_error_rel=max_error_rel, step=step)
    values = as_array(values)
    tile = np.ascontiguousarray(values, dtype=supported(values.dtype)).reshape(
        tile_shape(values.shape)
    )
    spec = None if transform is None else _spec_from(transform)
    given = [KINDS.index(axis.kind) << 4 | axis.depth for axis in spec.axes] if spec else [0] * 4
    error, share = quality.max_error, quality.max_error_rel
    if share == 0:
        error, share = 0.0, None
    asked = (-1.0 if error is None else error, share or 0.0, quality.step or 0.0)
    named = _missing_values(missing, tile.dtype)
    return encode_for(tile, (*asked, effort, bool(spec), given), named) if tile.size else b""


def check_missing(missing: Any) -> None:
    """Raises InputError for anything but a list of at most MAX_MISSING numbers."""
    values = np.array(missing)
    if values.ndim != 1 or values.dtype.kind not in "iuf" or len(values) > MAX_MISSING:
        raise InputError(
            f"missing is {missing!r:.60}; a list of at most {MAX_MISSING} numbers is needed"
        )


def _missing_values(missing: Sequence[Any], dtype: np.dtype[Any]) -> Values:
    """Values that stand for missing ones, in the type of an array. Raises InputError."""
    check_missing(missing)
    cast = np.empty(len(missing), dtype)
    for number, value in enumerate(missing):
        with np.errstate(all="ignore"):
            cast[number] = np.asarray(value).astype(dtype)
        if dtype.kind in "iu" and cast[number] != value:
            raise InputError(f"missing has {value!r:.40}, which is no {dtype}")
    return cast


def check_effort(effort: Any) -> None:
    """Raises InputError for an effort that is no whole number from 1 to 9."""
    if type(effort) is not int or not 1 <= effort <= _MAX_EFFORT:
        raise InputError(
            f"effort is {effort!r:.40}; a whole number from 1 to {_MAX_EFFORT} is needed"
        )


def decode_chunk(data: bytes | memoryview, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Values:
    """The values of a stream, with the shape and type that were coded.

    Raises DamagedFileError for bytes that no encoder writes.
    """
    if not math.prod(shape):
        return np.empty(shape, dtype)
    return (
        decode_tile(data, tile_shape(shape), supported(dtype))
        .reshape(shape)
        .astype(dtype, copy=False)
    )


def _spec_from(transform: TransformSpec | Mapping[str, Any]) -> TransformSpec:
    return transform if isinstance(transform, TransformSpec) else TransformSpec.from_dict(transform)
