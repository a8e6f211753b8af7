"""The transform of each axis of a tile, and the JSON by which a user names it.

A wavelet of depth d splits an axis d times into a low and a high band, (n + 1) // 2 and n // 2
long. The low band stands first and is the one that is split again. A level on a length of 1 is the
identity. y and x with the same wavelet and depth are coupled: each level goes along y, then along
x, of the low-low quadrant only (a dyadic pyramid in the plane). Otherwise each axis is transformed
along its whole length on its own (packets).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fhash_formats.errors import InputError
from fhash_formats.transform.axes.basis import Basis

__all__ = ["AXES", "KINDS", "MAX_DEPTH", "WAVELETS", "AxisTransform", "TransformSpec"]

AXES = ("t", "z", "y", "x")
"""Names of the axes, in order."""
KINDS = ("none", "haar", "5/3", "9/7", "klt")
"""Kinds of transforms.

No transform; Haar, with the mean of a pair as its low band; LeGall 5/3; Cohen-Daubechies-Feauveau
9/7; the data's own basis (Karhunen-Loeve).
"""
WAVELETS = ("haar", "5/3", "9/7")
"""Kinds that split an axis into bands."""
MAX_DEPTH = 10
"""Most levels of a wavelet."""


@dataclass(frozen=True, kw_only=True)
class AxisTransform:
    """The transform along one axis. Raises InputError for values that do not fit together.

    Attributes:
        kind: one of KINDS.
        depth: number of levels, 1 to MAX_DEPTH for a wavelet and 0 for the others.
        basis: the basis of "klt"; None for the other kinds.
    """

    kind: str
    depth: int = 0
    basis: Basis | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"unknown transform {self.kind!r:.40}: choose from {', '.join(KINDS)}")
        if isinstance(self.depth, bool) or not isinstance(self.depth, int):
            raise InputError(f"the depth of a transform is a whole number, not {self.depth!r:.40}")
        shallowest, deepest = (1, MAX_DEPTH) if self.wavelet else (0, 0)
        if not shallowest <= self.depth <= deepest:
            raise InputError(
                f"the depth of {self.kind!r} is {shallowest} to {deepest}, not {self.depth!r:.40}"
            )
        if (self.kind == "klt") != isinstance(self.basis, Basis):
            raise InputError("'klt' needs a basis, and nothing else takes one")

    @property
    def wavelet(self) -> bool:
        """Whether the axis is split into bands."""
        return self.kind in WAVELETS

    def to_json(self) -> Any:
        """The JSON value: `"none"` or `[kind, depth]`. Raises InputError for a basis."""
        if self.basis is not None:
            raise InputError("a basis of the data's own is no JSON value")
        return [self.kind, self.depth] if self.wavelet else self.kind

    @classmethod
    def from_json(cls, value: Any) -> AxisTransform:
        """The inverse of `to_json`. Raises InputError for anything else."""
        if isinstance(value, str):
            return cls(kind=value)
        if isinstance(value, (list, tuple)) and len(value) == 2 and isinstance(value[0], str):
            return cls(kind=value[0], depth=value[1])
        raise InputError(f'a transform is "none" or [kind, depth], not {value!r:.60}')


@dataclass(frozen=True, kw_only=True)
class TransformSpec:
    """The transforms along (t, z, y, x). Raises InputError unless there are four.

    Attributes:
        axes: the transform of each axis.
    """

    axes: tuple[AxisTransform, AxisTransform, AxisTransform, AxisTransform]

    def __post_init__(self) -> None:
        if (
            not isinstance(self.axes, tuple)
            or len(self.axes) != 4
            or not all(isinstance(axis, AxisTransform) for axis in self.axes)
        ):
            raise InputError("a transform has four axes (t, z, y, x), each an AxisTransform")

    @property
    def coupled(self) -> bool:
        """Whether y and x form a pyramid: the same wavelet with the same depth."""
        y, x = self.axes[2:]
        return y.wavelet and (y.kind, y.depth) == (x.kind, x.depth)

    def to_dict(self) -> dict[str, Any]:
        """JSON values by axis.

        For example `{"t": ["haar", 2], "z": "none", "y": ["9/7", 4], "x": ["9/7", 4]}`.
        """
        return {name: axis.to_json() for name, axis in zip(AXES, self.axes, strict=True)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TransformSpec:
        """The inverse of `to_dict`.

        Raises InputError for a missing or unknown key and for a bad value; the message names the
        key.
        """
        if not isinstance(values, Mapping):
            raise InputError(
                f"a transform is a mapping with the keys {', '.join(AXES)}, not {values!r:.60}"
            )
        unknown = [key for key in values if key not in AXES]
        missing = [key for key in AXES if key not in values]
        if unknown or missing:
            named = f"unknown key {unknown[0]!r:.40}" if unknown else f"missing key {missing[0]!r}"
            raise InputError(f"transform: {named}; the keys are {', '.join(AXES)}")
        t, z, y, x = (_axis(key, values[key]) for key in AXES)
        return cls(axes=(t, z, y, x))


def _axis(key: str, value: Any) -> AxisTransform:
    try:
        return AxisTransform.from_json(value)
    except InputError as error:
        raise InputError(f"transform, key {key!r}: {error}") from error
