"""Settings with which tiles are coded: transform, step, range, trained head.

All tiles of an array share their settings, or a tile has its own.
"""

from __future__ import annotations

import base64
import binascii
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.number_types import is_wide_integer, is_within
from fhash_formats.transform.axes.spec import TransformSpec
from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.entropy.predictor import Predictor
from fhash_formats.transform.head.head import NeighbourHead
from fhash_formats.transform.values.quantise import OFFSET_UNIT

__all__ = ["TileSettings"]

_REQUIRED = frozenset({"transform", "step", "center", "range"})
"""Keys of settings that have no default."""
_SWITCHES = ("double", "clip", "labels", "many_labels", "trellis")
"""Keys of settings that are true or false."""
_KEYS = _REQUIRED | {
    "offsets",
    "quantum",
    "head",
    "mask",
    "predictor",
    "origin",
    *_SWITCHES,
}
"""All keys of settings."""
_LARGEST = sys.float_info.max
"""Largest magnitude of a number; whole numbers of JSON may be larger."""
_LISTS = "range is [low, high] and offsets are three whole numbers, six with trellis"
"""Message for a range or offsets that are no lists."""


@dataclass(frozen=True, kw_only=True)
class TileSettings:
    """Settings of a tile. Raises InputError for values that are not allowed.

    Attributes:
        transform: kinds, depths and bases along (t, z, y, x).
        step: quantiser step, in units of the values; > 0.
        center: value that is coded as zero, in units of the values.
        low: lower end of the range to which values are clipped, before head and residual.
        high: upper end of that range.
        offsets: reconstruction offsets of magnitudes 1, 2 and more, in 1/128 step. With `trellis`
            six: of magnitudes 1, 2, 3, 4, of odd ones from 5 on, and of even ones from 6 on.
        double: whether the arithmetic is in float64; otherwise it is in float32.
        quantum: step of the residual that keeps a bound, in units of the values; 0 without bound.
        head: the trained correction; None for none.
        mask: likelihood of the occupancy by decoded values; every tile then has a mask. None for
            tiles without masks.
        predictor: predictor of tiles that are coded by prediction instead of the transform; None
            where no tile is.
        clip: whether decoded values are clipped to the range once more at the end, in the type of
            the array, so that neither residual nor rounding takes them beyond it. Files up to
            version 1.1 never are.
        labels: whether tiles may be coded as labels, without loss.
        many_labels: whether such tiles may have 65,536 labels instead of 256; needs `labels`.
        trellis: whether coefficients are quantised by two quantisers in turn (entropy/trellis.py).
            Integers are then in steps, of which each quantiser has every other one.
        origin: integer that is subtracted from the values before anything else, for arrays of
            64-bit integers alone; `center`, `low` and `high` are then those of the differences.
    """

    transform: TransformSpec
    step: float
    center: float
    low: float
    high: float
    offsets: tuple[int, ...] = (0, 0, 0)
    double: bool = False
    quantum: float = 0.0
    head: NeighbourHead | None = None
    mask: MaskLevels | None = None
    predictor: Predictor | None = None
    clip: bool = False
    labels: bool = False
    many_labels: bool = False
    trellis: bool = False
    origin: int = 0

    def __post_init__(self) -> None:
        for name in ("step", "center", "low", "high", "quantum"):
            _check_finite(name, getattr(self, name))
        if not (self.step > 0 and self.quantum >= 0 and self.low <= self.high):
            raise InputError(
                f"step {self.step}, quantum {self.quantum}, range {self.low} to {self.high} "
                "do not fit together"
            )
        smallest, largest = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
        if not (self.double or smallest < self.step < largest):
            raise InputError(f"step {self.step} is not for float32")
        if len(self.offsets) != (6 if self.trellis else 3) or not all(
            type(offset) is int and abs(offset) <= OFFSET_UNIT for offset in self.offsets
        ):
            raise InputError(
                f"offsets are {self.offsets!r:.60}; {'six' if self.trellis else 'three'} whole "
                f"numbers within +-{OFFSET_UNIT} are needed"
            )
        if self.head is not None and self.double:
            raise InputError("a head works in float32 only")
        if type(self.origin) is not int or not -(1 << 63) <= self.origin < 1 << 64:
            raise InputError(f"origin is {self.origin!r:.40}; a 64-bit integer is needed")
        if self.many_labels and not self.labels:
            raise InputError("many_labels needs labels")

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the arithmetic."""
        return np.dtype(np.float64 if self.double else np.float32)

    @property
    def table_dtype(self) -> np.dtype[Any]:
        """The type of the table of a tile: that of the arithmetic, or float64 with an origin."""
        return np.dtype(np.float64) if self.origin else self.dtype

    def differences_of(self, dtype: np.dtype[Any]) -> np.dtype[Any]:
        """The type of what is coded of an array: int64 with an origin, else that of the array.

        Raises InputError for an array whose type has no such origin.
        """
        if not self.origin:
            return dtype
        if not (is_wide_integer(dtype) and is_within(self.origin, dtype)):
            raise InputError(f"an array of {dtype} has no values about the origin {self.origin}")
        return np.dtype(np.int64)

    def to_dict(self) -> dict[str, Any]:
        """JSON values, without the settings that have their default."""
        result: dict[str, Any] = {
            "transform": self.transform.to_dict(),
            "step": self.step,
            "center": self.center,
            "range": [self.low, self.high],
        }
        if any(self.offsets):
            result["offsets"] = list(self.offsets)
        if self.double:
            result["double"] = True
        if self.quantum:
            result["quantum"] = self.quantum
        if self.head is not None:
            result["head"] = base64.b64encode(self.head.to_bytes()).decode("ascii")
        if self.mask is not None:
            result["mask"] = self.mask.to_dict()
        if self.predictor is not None:
            result["predictor"] = self.predictor.to_dict()
        if self.clip:
            result["clip"] = True
        if self.labels:
            result["labels"] = True
        if self.many_labels:
            result["many_labels"] = True
        if self.trellis:
            result["trellis"] = True
        if self.origin:
            result["origin"] = self.origin
        return result

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TileSettings:
        """The inverse of `to_dict`. Raises InputError or DamagedFileError for anything else."""
        unknown = sorted(str(key)[:40] for key in set(values) - _KEYS)
        if unknown:
            raise InputError(f"unknown setting {unknown[0]!a}; known: {', '.join(sorted(_KEYS))}")
        missing = sorted(_REQUIRED - set(values))
        if missing:
            raise InputError(f"setting {missing[0]} is missing")
        low, high = _range(values["range"])
        switches = {name: values.get(name, False) for name in _SWITCHES}
        for name, switch in switches.items():
            if not isinstance(switch, bool):
                raise InputError(f"{name} is true or false")
        offsets = values.get("offsets", [0] * (6 if switches["trellis"] else 3))
        if not isinstance(offsets, list | tuple):
            raise InputError(_LISTS)
        mask, predictor = values.get("mask"), values.get("predictor")
        return cls(
            transform=TransformSpec.from_dict(values["transform"]),
            step=values["step"],
            center=values["center"],
            low=low,
            high=high,
            offsets=tuple(offsets),
            **switches,
            origin=values.get("origin", 0),
            quantum=values.get("quantum", 0.0),
            head=_unpack_head(values.get("head")),
            mask=None if mask is None else MaskLevels.from_dict(mask),
            predictor=None if predictor is None else Predictor.from_dict(predictor),
        )


def _check_finite(name: str, value: Any) -> None:
    """Raises InputError unless a setting is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
        raise InputError(f"{name} is {value!r:.40}; a finite number is needed")


def _range(values: Any) -> tuple[Any, Any]:
    """The ends of a range; `TileSettings` checks that they are numbers. Raises InputError."""
    if not isinstance(values, list | tuple) or len(values) != 2:
        raise InputError(_LISTS)
    return values[0], values[1]


def _unpack_head(text: Any) -> NeighbourHead | None:
    """The head in base64. Raises DamagedFileError."""
    if text is None:
        return None
    try:
        packed = base64.b64decode(text, validate=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise DamagedFileError("the head is not base64") from error
    return _head_of(packed)


@lru_cache(maxsize=64)
def _head_of(packed: bytes) -> NeighbourHead:
    # Decoding a head, and coding it again to check it, takes half of what opening a file does.
    return NeighbourHead.from_bytes(packed)
