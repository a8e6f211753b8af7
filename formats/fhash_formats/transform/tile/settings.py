"""What tiles are coded with: the transform, the step, the range, the trained head. Shared by all tiles of an array or a tile's own."""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.axes.spec import TransformSpec
from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.entropy.predictor import Predictor
from fhash_formats.transform.head.head import NeighbourHead
from fhash_formats.transform.values.quantise import OFFSET_UNIT

__all__ = ["TileSettings"]


@dataclass(frozen=True, kw_only=True)
class TileSettings:
    """Settings of a tile; raises InputError for values that are not allowed.

    Attributes:
        transform: kinds, depths and bases along (t, z, y, x).
        step: of the quantiser, in units of the values; 0 only where nothing is coded but the residual.
        center: value that stands for zero; low, high: the range to which decoded values are clipped.
        offsets: reconstruction offsets for magnitudes of 1, 2 and more, in 1/128 step.
        double: whether arithmetic is in float64 instead of float32.
        quantum: step of the residual that keeps a bound, in units of the values; 0 where there is none.
        head: the trained correction, None for none.
        mask: what decoded values say of the occupancy, which then stands in every tile; None for tiles without one.
        predictor: of tiles that are coded by prediction instead of the transform; None where none is.
    """

    transform: TransformSpec
    step: float
    center: float
    low: float
    high: float
    offsets: tuple[int, int, int] = (0, 0, 0)
    double: bool = False
    quantum: float = 0.0
    head: NeighbourHead | None = None
    mask: MaskLevels | None = None
    predictor: Predictor | None = None

    def __post_init__(self) -> None:
        for name in ("step", "center", "low", "high", "quantum"):
            value = getattr(self, name)
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or not math.isfinite(value)
            ):
                raise InputError(f"{name} is {value!r:.40}; a finite number is needed")
        if not (self.step > 0 and self.quantum >= 0 and self.low <= self.high):
            raise InputError(
                f"step {self.step}, quantum {self.quantum}, range {self.low} to {self.high} do not fit together"
            )
        if not (
            self.double
            or float(np.finfo(np.float32).tiny) < self.step < float(np.finfo(np.float32).max)
        ):
            raise InputError(f"step {self.step} is not for float32")
        if len(self.offsets) != 3 or not all(
            type(o) is int and abs(o) <= OFFSET_UNIT for o in self.offsets
        ):
            raise InputError(
                f"offsets are {self.offsets!r:.60}; three whole numbers within +-{OFFSET_UNIT} are needed"
            )
        if self.head is not None and self.double:
            raise InputError("a head works in float32 only")

    @property
    def dtype(self) -> np.dtype[Any]:
        """The working type."""
        return np.dtype(np.float64 if self.double else np.float32)

    @property
    def features(self) -> tuple[str, ...]:
        """What a reader must know beside the codec itself, by the names that containers require features by."""
        cross = self.head is not None and self.head.cross
        used = {
            "cross": cross,
            "mask": self.mask is not None,
            "predictor": self.predictor is not None,
        }
        return tuple(name for name, wanted in used.items() if wanted)

    def to_dict(self) -> dict[str, Any]:
        """JSON values, without those that are the default."""
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
        return result

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TileSettings:
        """From `to_dict`'s values; raises InputError or DamagedFileError for anything else."""
        known = {
            "transform",
            "step",
            "center",
            "range",
            "offsets",
            "double",
            "quantum",
            "head",
            "mask",
            "predictor",
        }
        unknown = sorted(str(key)[:40] for key in set(values) - known)
        if unknown:
            raise InputError(f"unknown setting {unknown[0]!a}; known: {', '.join(sorted(known))}")
        missing = sorted({"transform", "step", "center", "range"} - set(values))
        if missing:
            raise InputError(f"setting {missing[0]} is missing")
        span, offsets = values["range"], values.get("offsets", [0, 0, 0])
        if (
            not isinstance(span, list | tuple)
            or len(span) != 2
            or not isinstance(offsets, list | tuple)
        ):
            raise InputError("range is [low, high] and offsets are three whole numbers")
        if not isinstance(values.get("double", False), bool):
            raise InputError("double is true or false")
        head = values.get("head")
        try:
            packed = None if head is None else base64.b64decode(head, validate=True)
        except (binascii.Error, TypeError, ValueError) as error:
            raise DamagedFileError("the head is not base64") from error
        return cls(
            transform=TransformSpec.from_dict(values["transform"]),
            step=values["step"],
            center=values["center"],
            low=span[0],
            high=span[1],
            offsets=tuple(offsets),
            double=values.get("double", False),
            quantum=values.get("quantum", 0.0),
            head=None if packed is None else NeighbourHead.from_bytes(packed),
            mask=None if values.get("mask") is None else MaskLevels.from_dict(values["mask"]),
            predictor=None
            if values.get("predictor") is None
            else Predictor.from_dict(values["predictor"]),
        )
