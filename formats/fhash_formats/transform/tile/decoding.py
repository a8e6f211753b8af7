"""The bytes of a tile to values: decode, undo the transform, correct, bound; and what the encoder shares of it.

The encoder computes the same values by the same operations in the same order, so that it knows what every decoder gets.
"""

from __future__ import annotations

import zlib
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.axes.bands import band_table
from fhash_formats.transform.axes.lifting import Transform
from fhash_formats.transform.axes.spec import TransformSpec
from fhash_formats.transform.entropy.coder import decode_integers
from fhash_formats.transform.entropy.predict import decode_predicted, values_of
from fhash_formats.transform.entropy.predictor import Predictor
from fhash_formats.transform.entropy.table import single_band
from fhash_formats.transform.tile.sections import (
    EXACT,
    Shape,
    exact_values,
    little,
    no_levels,
    parts_of,
    restored,
    settings_from,
    unpack_mask,
)
from fhash_formats.transform.tile.settings import TileSettings
from fhash_formats.transform.values.elementwise import cast, clip_shifted, corrected
from fhash_formats.transform.values.quantise import dequantise

__all__ = [
    "decode_tile",
    "decode_tile_mask",
    "linear_values",
    "outside",
    "predicted_values",
    "transform_for",
]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]


def transform_for(settings: TileSettings, shape: Shape) -> Transform:
    """The transform of a tile, kept for tiles of the same shape."""
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

    settings: those shared by all tiles, unless the stream has its own. lod: every 2^lod-th vertex along z, y, x, low-passed, without head,
    residual, missing values and mask. Raises DamagedFileError for bytes that no encoder writes.
    """
    return _decode(data, shape, dtype, settings, lod)[0]


def decode_tile_mask(
    data: bytes | memoryview,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings | None = None,
) -> tuple[Values, Mask]:
    """The values of a stream as `decode_tile` gives them, and which are occupied: all, where the stream has no mask."""
    values, mask = _decode(data, shape, dtype, settings, 0)
    return values, np.ones(shape, bool) if mask is None else mask


def _decode(
    data: bytes | memoryview,
    shape: Shape,
    dtype: npt.DTypeLike,
    settings: TileSettings | None,
    lod: int,
) -> tuple[Values, Mask | None]:
    kind = np.dtype(dtype)
    parts = parts_of(data)
    if parts.settings is not None:
        settings = settings_from(parts.settings)
    missing = b"" if parts.missing is None else bytes(parts.missing)
    if parts.flags & EXACT:
        assert parts.body is not None
        values = exact_values(parts.body, shape, kind)
        mask = None if parts.mask is None else unpack_mask(parts.mask, no_levels(shape))
        return values[_every(lod)] if lod else values, mask
    if settings is None:
        raise DamagedFileError("a coded tile has no settings")
    largest = _check_numbers(settings, kind)
    if parts.body is None:
        result = cast(np.full(_lod_shape(shape, lod), settings.center), kind)
        if lod:
            return result, None
        mask = np.zeros(shape, bool) if parts.masked else None
        return restored(outside(result, mask, settings), missing), mask
    predictor = settings.predictor
    transform = None
    if not parts.predicted:
        # Before anything is decoded: the bands of what does not fit would lie beyond the tile.
        try:
            transform = transform_for(settings, shape)
        except InputError as error:
            raise DamagedFileError(
                f"the settings of a coded tile do not fit its shape: {error}"
            ) from error
        integers = decode_integers(parts.body, shape, band_table(settings.transform, shape))
    elif predictor is not None:
        integers = decode_predicted(parts.body, shape, predictor)
    else:
        raise DamagedFileError("a coded tile is by prediction, of which its settings know nothing")
    crc = zlib.crc32(little(integers))
    residual = None
    if parts.residual is not None:
        residual = decode_integers(parts.residual, shape, single_band(shape))
        crc = zlib.crc32(little(residual), crc)
    if crc != parts.digest:
        raise DamagedFileError("the decoded integers of a tile differ from their digest")
    if transform is None:
        assert predictor is not None
        found = predicted_values(integers, predictor, settings)
        if lod:
            return cast(found[_every(lod)], kind), None
        mask = None if parts.mask is None else _mask_of(parts.mask, found, settings)
        return restored(outside(cast(found, kind), mask, settings), missing), mask
    if lod:
        coarse = transform.inverse(
            dequantise(integers, settings.step, settings.offsets, settings.dtype), lod=lod
        )
        return cast(_shifted(coarse, settings), kind), None
    linear = linear_values(integers, transform, settings)
    mask = None if parts.mask is None else _mask_of(parts.mask, linear, settings)
    base = linear if settings.head is None else settings.head.apply(linear)
    found = corrected(base, residual, settings.quantum, kind)
    # Only with a residual can values leave the range.
    if residual is not None and settings.quantum * 2.0**31 > largest / 2 and np.isinf(found).any():
        raise DamagedFileError(f"a residual of a coded tile is beyond {kind}")
    return restored(outside(found, mask, settings), missing), mask


def _check_numbers(settings: TileSettings, kind: np.dtype[Any]) -> float:
    """Refuse settings that make infinities of finite values in the type of the source or in the working type; the largest such number."""
    types = [settings.dtype] if kind.kind != "f" else [settings.dtype, kind]
    largest = min(float(np.finfo(name).max) for name in types)
    if (
        kind.kind == "f"
        and max(abs(settings.low), abs(settings.high), abs(settings.center)) > largest
    ):
        raise DamagedFileError(f"the range of a coded tile or its centre is beyond {largest:.6g}")
    return largest


def linear_values(
    integers: npt.NDArray[np.int32], transform: Transform, settings: TileSettings
) -> Values:
    """Decoded values in the working type, before head and residual."""
    return _shifted(
        transform.inverse(dequantise(integers, settings.step, settings.offsets, settings.dtype)),
        settings,
    )


def predicted_values(
    integers: npt.NDArray[np.int32], predictor: Predictor, settings: TileSettings
) -> npt.NDArray[np.float64]:
    """Values by prediction, within the range."""
    values = values_of(integers, predictor)
    return np.clip(values, settings.low, settings.high, out=values)


def _shifted(values: Values, settings: TileSettings) -> Values:
    """Values about the centre, within the range, in place."""
    return clip_shifted(values, settings.center, settings.low, settings.high)


def outside(decoded: Values, occupied: Mask | None, settings: TileSettings) -> Values:
    """Decoded values with NaN, or the centre for whole numbers, where a mask says that nothing is; in place."""
    if occupied is not None:
        nothing = np.array(np.nan) if decoded.dtype.kind == "f" else np.array(settings.center)
        decoded[~occupied] = cast(nothing, decoded.dtype)
    return decoded


def _mask_of(packed: bytes | memoryview, linear: Values, settings: TileSettings) -> Mask:
    if settings.mask is None:
        raise DamagedFileError("a coded tile has a mask, of which its settings know nothing")
    with np.errstate(over="ignore"):
        return unpack_mask(packed, settings.mask.levels(linear.astype(settings.dtype, copy=False)))


def _every(lod: int) -> tuple[slice, ...]:
    return (slice(None), *[slice(None, None, 1 << lod)] * 3)


def _lod_shape(shape: Shape, lod: int) -> tuple[int, ...]:
    return (shape[0], *(-(-n // (1 << lod)) for n in shape[1:]))
