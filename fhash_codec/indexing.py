"""Basic indexing as numpy has it, for a volume (t, z, y, x) that is decoded and not in memory."""

from __future__ import annotations

from collections.abc import Sequence
from types import EllipsisType

import numpy as np

from fhash_formats.errors import RegionError
from fhash_formats.series import AXES

Index = int | slice | EllipsisType
"""One part of an index."""


def expand_index(index: Index | tuple[Index, ...]) -> list[int | slice]:
    """One integer or slice per axis (t, z, y, x): full slices replace `...` and missing axes.

    Raises RegionError for other kinds of indices, and for too many parts.
    """
    parts = list(index) if isinstance(index, tuple) else [index]
    for part in parts:
        if part is not Ellipsis and (
            isinstance(part, bool) or not isinstance(part, int | np.integer | slice)
        ):
            raise RegionError(
                "a volume is indexed by integers, slices and '...', "
                f"not by {type(part).__name__}; take np.asarray of it for more"
            )
    ellipses = [number for number, part in enumerate(parts) if part is Ellipsis]
    if len(ellipses) > 1 or len(parts) - len(ellipses) > len(AXES):
        raise RegionError(f"a volume has 4 axes (t, z, y, x); the index has {len(parts)} parts")
    at = ellipses[0] if ellipses else len(parts)
    fill = [slice(None)] * (len(AXES) - len(parts) + len(ellipses))
    expanded = [*parts[:at], *fill, *parts[at + len(ellipses) :]]
    return [part for part in expanded if part is not Ellipsis]


def index_ranges(parts: Sequence[int | slice], shape: Sequence[int]) -> list[range]:
    """The positions along each axis that an expanded index names.

    Raises RegionError for an integer outside its axis.
    """
    return [
        _positions(part, length, axis)
        for part, length, axis in zip(parts, shape, AXES, strict=True)
    ]


def _positions(part: int | slice, length: int, axis: str) -> range:
    if isinstance(part, slice):
        return range(length)[part]
    if not -length <= part < length:
        raise RegionError(f"index {part} is outside axis {axis} of {length}")
    return range(part % length, part % length + 1)
