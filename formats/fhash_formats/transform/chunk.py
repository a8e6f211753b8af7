"""Encoding of one chunk to a stated quality; the library searches transform and step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.support.arrays import Values
from fhash_formats.transform.spec import KINDS, AxisTransform, TransformSpec
from fhash_formats.transform.tile import decode_tile, encode_for
from fhash_formats.transform.tile_format import Shape

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
    fill: Any = 0,
    effort: int = DEFAULT_EFFORT,
) -> bytes:
    """The stream of an array.

    NaN and infinities come back where they were and take no part in range or bound. Stores put fill
    values where nothing was written, and beyond the end of an array. So these take no part in the
    range of `max_error_rel` either, nor does a value that is the only one of a plane at either end
    of an axis: a filter may have changed the fill value, and some stores do not tell it. Where
    parts of a chunk are written one after the other, the same holds for what the bound made of a
    fill value.

    Args:
        values: array of a type that `supported` accepts; its axes become those of `tile_shape`.
        max_error: as in `Quality`; exactly one of the three is given.
        max_error_rel: as in `Quality`.
        step: as in `Quality`.
        transform: transform along (t, z, y, x); None for the one that codes best in a trial.
        fill: the fill value of the store; None where it has none.
        effort: 1 tries nothing; 2 to 9 try transforms, steps and two quantisers, on ever larger
            parts of the array.

    Raises InputError.
    """
    check_effort(effort)
    quality = Quality(max_error=max_error, max_error_rel=max_error_rel, step=step)
    values = np.asarray(values)
    tile = np.ascontiguousarray(values, dtype=supported(values.dtype)).reshape(
        tile_shape(values.shape)
    )
    spec = None if transform is None else _spec_from(transform)
    given = [KINDS.index(axis.kind) << 4 | axis.depth for axis in spec.axes] if spec else [0] * 4
    error, share = quality.max_error, quality.max_error_rel
    if share == 0:
        error, share = 0.0, None
    asked = (-1.0 if error is None else error, share or 0.0, quality.step or 0.0)
    blank = None if fill is None else np.asarray(fill).astype(tile.dtype)
    return encode_for(tile, (*asked, effort, bool(spec), given), blank) if tile.size else b""


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
