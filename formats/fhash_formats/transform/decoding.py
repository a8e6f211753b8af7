"""Decoding of a tile, whole or in a region."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.arrays import Integers, Mask, Values
from fhash_formats.support.threads import in_threads
from fhash_formats.transform.coder import decode_integers, single_band
from fhash_formats.transform.lifting import Transform, band_table
from fhash_formats.transform.predict import (
    Predictor,
    decode_differences,
    decode_predicted,
    values_of,
)
from fhash_formats.transform.spec import TransformSpec
from fhash_formats.transform.tile_format import (
    DIFFERENCES,
    EMPTY,
    EXACT,
    LABELS,
    PREDICTED,
    TRANSFORMED,
    Shape,
    TileSettings,
    TileStream,
    parse_stream,
    restore_missing,
    unpack_labelled,
    unpack_mask,
    unpack_planes,
    zero_levels,
)
from fhash_formats.transform.values import (
    OFFSET_UNIT,
    at_origin,
    cast,
    clip_shifted,
    clipped,
    corrected,
    dequantise,
)

Decoded = tuple[Values, Mask | None]
"""Values in the type of the source, and which are occupied; None for a stream without a mask."""


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
    return _decode(data, shape, dtype, settings, lod)[0]


def decode_tile_mask(
    data: bytes | memoryview,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings | None = None,
) -> tuple[Values, Mask]:
    """The values of a stream as `decode_tile` gives them, and which of them are occupied.

    All values are occupied where the stream has no mask.
    """
    values, mask = _decode(data, shape, dtype, settings, 0)
    return values, np.ones(shape, bool) if mask is None else mask


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
    table, origin = table_about_origin(parse_stream(data), shape, dtype, settings, lod)
    return table.astype(np.float64) + origin if origin else table


def table_about_origin(
    stream: TileStream,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings | None,
    lod: int = 0,
) -> tuple[Values, int]:
    """The table of a tile less the origin of its settings, in their working type; and the origin.

    The other arguments and the errors are those of `decode_tile_table`.
    """
    settings = _own(stream, settings)
    kind = np.dtype(dtype) if settings is None else _coded_type(settings, np.dtype(dtype))
    if settings is None or stream.kind != TRANSFORMED:
        values = _decode_stream(stream, shape, kind, settings, lod)[0]
        working = np.dtype(np.float64) if settings is None else settings.dtype
        with np.errstate(over="ignore"):
            values = values.astype(working)
        values[~np.isfinite(values)] = 0.0 if settings is None else settings.center
        return values, 0 if settings is None else settings.origin
    _check_numbers(settings, kind)
    without = replace(stream, residual=None)
    table = _linear_and_residual(without, shape, settings, lod)[0]
    return table, settings.origin


def _decode(
    data: bytes | memoryview,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings | None,
    lod: int,
) -> Decoded:
    stream = parse_stream(data)
    settings, kind = _own(stream, settings), np.dtype(dtype)
    if settings is None or not settings.origin:
        return _decode_stream(stream, shape, kind, settings, lod)
    values, mask = _decode_stream(stream, shape, _coded_type(settings, kind), settings, lod)
    return at_origin(values, settings.origin, kind), mask


def _own(stream: TileStream, shared: TileSettings | None) -> TileSettings | None:
    """The settings of a stream: its own, or those that all tiles share."""
    return shared if stream.settings is None else TileSettings.from_bytes(stream.settings)


def _coded_type(settings: TileSettings, kind: np.dtype[Any]) -> np.dtype[Any]:
    """The type of what is coded of an array; raises DamagedFileError for one without an origin."""
    try:
        return settings.differences_of(kind)
    except InputError as error:
        raise DamagedFileError(f"the settings of a coded tile do not fit: {error}") from error


def _decode_stream(
    stream: TileStream,
    shape: Shape,
    kind: np.dtype[Any],
    settings: TileSettings | None,
    lod: int,
) -> Decoded:
    """The values of a stream less the origin of its settings, and which are occupied."""
    if stream.kind == EXACT:
        return _decode_exact(stream, shape, kind, lod)
    if stream.kind == DIFFERENCES:
        assert stream.body is not None, "a stream of differences has a body"
        return decode_differences(stream.body, shape, kind)[_every(lod)], None
    if settings is None and not (stream.kind == LABELS and not stream.masked):
        raise DamagedFileError("a coded tile has no settings")
    if stream.kind == LABELS:
        return _decode_labelled(stream, shape, kind, settings, lod)
    assert settings is not None
    largest = _check_numbers(settings, kind)
    if stream.kind == EMPTY:
        values = cast(np.full(_lod_shape(shape, lod), settings.center), kind)
        mask = np.zeros(shape, bool) if stream.masked else None
    elif stream.kind == PREDICTED:
        values, mask = _decode_predicted(stream, shape, kind, settings, lod)
    else:
        values, mask = _decode_transformed(stream, shape, kind, settings, lod, largest)
    if lod:
        return values, None
    return restore_missing(blank_unoccupied(values, mask, settings), stream.missing), mask


def _decode_exact(stream: TileStream, shape: Shape, kind: np.dtype[Any], lod: int) -> Decoded:
    """The values and mask of a tile that is stored without loss."""
    assert stream.body is not None, "an exact stream has a body"
    values = unpack_planes(stream.body, prod(shape), kind).reshape(shape)
    mask = None if stream.mask is None else unpack_mask(stream.mask, zero_levels(shape))
    return values[_every(lod)] if lod else values, mask


def _decode_labelled(
    stream: TileStream,
    shape: Shape,
    kind: np.dtype[Any],
    settings: TileSettings | None,
    lod: int,
) -> Decoded:
    """The values and mask of a tile of labels."""
    assert stream.body is not None, "a stream of labels has a body"
    values, mask = unpack_labelled(stream.body, shape, kind, masked=stream.masked)
    if settings is not None:
        values = blank_unoccupied(values, mask, settings)
    return (values[_every(lod)], None) if lod else (values, mask)


def _decode_predicted(
    stream: TileStream,
    shape: Shape,
    kind: np.dtype[Any],
    settings: TileSettings,
    lod: int,
) -> Decoded:
    """The values and mask of a tile that is coded by prediction."""
    if settings.predictor is None:
        raise DamagedFileError("a tile is coded by prediction, but its settings have no predictor")
    assert stream.body is not None, "a predicted stream has a body"
    integers = decode_predicted(stream.body, shape, settings.predictor)
    values = predicted_values(integers, settings.predictor, settings)
    if lod:
        return within_range(cast(values[_every(lod)], kind), settings), None
    mask = None if stream.mask is None else _unpack_mask(stream.mask, values, settings)
    return within_range(cast(values, kind), settings), mask


def _decode_transformed(
    stream: TileStream,
    shape: Shape,
    kind: np.dtype[Any],
    settings: TileSettings,
    lod: int,
    largest: float,
) -> Decoded:
    """The values and mask of a tile that is coded by transform.

    largest: the largest number of the type of the source and of the working type.
    """
    linear, residual = _linear_and_residual(stream, shape, settings, lod)
    if lod:
        return within_range(cast(linear, kind), settings), None
    mask = None if stream.mask is None else _unpack_mask(stream.mask, linear, settings)
    # The mask is decoded by now, so that the head may overwrite what it corrects.
    base = linear if settings.head is None else settings.head.apply(linear, in_place=True)
    values = corrected(base, residual, settings.quantum, kind)
    # Without a residual the values are within the range, and finite; clipped ones are in the end.
    may_exceed = not settings.clip and settings.quantum * 2.0**31 > largest / 2
    if residual is not None and may_exceed and np.isinf(values).any():
        raise DamagedFileError(f"a residual of a coded tile is beyond {kind}")
    return within_range(values, settings), mask


def _linear_and_residual(
    stream: TileStream, shape: Shape, settings: TileSettings, lod: int
) -> tuple[Values, Integers | None]:
    """The values of a tile that is coded by transform, before head and residual, and its residual.

    The residual is left out at a level of detail.
    """
    # Built before anything is decoded: the bands of a spec that does not fit lie beyond the tile.
    try:
        transform = transform_for(settings, shape)
    except InputError as error:
        raise DamagedFileError(
            f"the settings of a coded tile do not fit its shape: {error}"
        ) from error
    body, rest = stream.body, stream.residual
    assert body is not None, "a transformed stream has a body"

    def coefficients() -> Integers:
        table = band_table(settings.transform, shape)
        return decode_integers(body, shape, table, trellis=settings.trellis, fast=stream.fast)

    residual = None
    if rest is None or lod:
        integers = coefficients()
    else:
        decoders = [
            coefficients,
            partial(decode_integers, rest, shape, single_band(shape), fast=stream.fast),
        ]
        integers, residual = in_threads(_call, decoders)
    return linear_values(integers, transform, settings, lod, in_place=True), residual


def _call(decode: Any) -> Integers:
    integers: Integers = decode()
    return integers


def _check_numbers(settings: TileSettings, kind: np.dtype[Any]) -> float:
    """The largest number of the type of the source and of the working type.

    Raises DamagedFileError for settings that turn finite values into infinities in either type.
    """
    types = [settings.dtype] if kind.kind != "f" else [settings.dtype, kind]
    largest = min(float(np.finfo(name).max) for name in types)
    if (
        kind.kind == "f"
        and max(abs(settings.low), abs(settings.high), abs(settings.center)) > largest
    ):
        raise DamagedFileError(f"the range of a coded tile or its centre is beyond {largest:.6g}")
    return largest


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


def _unpack_mask(packed: bytes | memoryview, linear: Values, settings: TileSettings) -> Mask:
    """The mask in a section, decoded by means of the decoded values."""
    if settings.mask is None:
        raise DamagedFileError("a coded tile has a mask, but its settings have no mask levels")
    with np.errstate(over="ignore"):
        return unpack_mask(packed, settings.mask.levels(linear.astype(settings.dtype, copy=False)))


def _every(lod: int) -> tuple[slice, ...]:
    """Slices of every 2^lod-th vertex along z, y, x."""
    return (slice(None), *[slice(None, None, 1 << lod)] * 3)


def _lod_shape(shape: Shape, lod: int) -> tuple[int, ...]:
    """Shape of a tile at a level of detail."""
    return (shape[0], *(-(-n // (1 << lod)) for n in shape[1:]))


SHARE = 4
"""A part is corrected alone where its head sees at most one SHARE-th of the tile's frames.

Who reads whole frames goes on to the next ones."""
REACH = (1, 2, 2, 2)
"""Farthest vertices along (t, z, y, x) that the inputs of a head come from."""

Part = tuple[slice, ...]
"""Slices (t, z, y, x) with explicit ends."""


def uncorrected(
    data: bytes | memoryview, shape: Shape, dtype: npt.DTypeLike, settings: TileSettings, part: Part
) -> Values | None:
    """The values of a tile before its head, where nothing but `corrected_region` is left to do.

    They are less the origin of the settings. None for other tiles, and where the part is a large
    one.

    Raises DamagedFileError for bytes that no encoder writes.
    """
    if settings.head is None:
        return None
    seen = [along.stop - along.start for along in _widened(part, shape, settings)]
    if SHARE * prod(seen[1:]) > prod(shape[1:]):
        return None
    stream = parse_stream(data)
    more = (stream.settings, stream.missing, stream.residual)
    if stream.kind != TRANSFORMED or stream.masked or any(x is not None for x in more):
        return None
    return table_about_origin(stream, shape, dtype, settings)[0]


def corrected_region(
    table: Values, part: Part, dtype: npt.DTypeLike, settings: TileSettings
) -> Values:
    """A part of the values of a tile, as `decode_tile` gives them, in a new array.

    table: what `uncorrected` gave.
    """
    assert settings.head is not None, "a tile without head is decoded whole"
    widened = _widened(part, table.shape, settings)
    # At the ends of the tile the head sees its edge either way; farther in, what it sees instead of
    # what was cut off is cut off again.
    base = settings.head.apply(table[widened])
    inner = tuple(
        slice(along.start - wide.start, along.stop - wide.start)
        for along, wide in zip(part, widened, strict=True)
    )
    kind = np.dtype(dtype)
    coded = settings.differences_of(kind)
    values = within_range(corrected(base[inner], None, 0.0, coded), settings)
    return at_origin(values, settings.origin, kind) if settings.origin else values


def _widened(part: Part, shape: tuple[int, ...], settings: TileSettings) -> Part:
    """A part and what its head sees around it."""
    assert settings.head is not None
    more = 1 if settings.head.cross else 0
    return tuple(
        slice(max(0, along.start - reach - more), min(n, along.stop + reach + more))
        for along, reach, n in zip(part, REACH, shape, strict=True)
    )
