"""Axes of an array that its tiles are coded along, where they are not simply its last ones.

A chunk of an array (time, y, x) is by default a tile whose z is the time. `ArrayAxes` says
otherwise: along which axis of a tile each axis of the array is coded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError

__all__ = ["KEY", "NO_AXIS", "TILE_AXES", "ArrayAxes", "take_axes"]

KEY = "axes"
"""Key of the axes in the configuration of `fhash.transform`."""
TILE_AXES = ("t", "z", "y", "x")
"""Axes of a tile, in its order."""
NO_AXIS = ""
"""Name for an axis of the array that is none of the tile; chunks have length 1 along it."""

Shape = tuple[int, int, int, int]


@dataclass(frozen=True)
class ArrayAxes:
    """The axis of the tile for each axis of an array.

    Attributes:
        names: "t", "z", "y", "x", each at most once, or NO_AXIS.

    Raises InputError for other names.
    """

    names: tuple[str, ...]

    def __post_init__(self) -> None:
        named = [name for name in self.names if name != NO_AXIS]
        if not self.names or len(set(named)) < len(named) or not set(named) <= set(TILE_AXES):
            raise InputError(
                f"axes are {list(self.names)!r:.60}; for each axis of the array one of t, z, y, x,"
                ' each once, or "" where chunks have length 1'
            )

    @classmethod
    def of(cls, values: object) -> ArrayAxes:
        """The axes that a list of names says. Raises InputError for anything else."""
        if not isinstance(values, list | tuple) or not all(isinstance(v, str) for v in values):
            raise InputError(f"axes are {values!r:.60}; a list of names is needed")
        return cls(tuple(values))

    @property
    def usual(self) -> bool:
        """Whether an array with the key left out has the same axes."""
        return self.names == TILE_AXES[-len(self.names) :]

    def tile_shape(self, chunk: Sequence[int]) -> Shape:
        """The shape (t, z, y, x) of the tile of a chunk.

        Raises InputError for chunks with another number of axes, or longer than 1 along NO_AXIS.
        """
        if len(chunk) != len(self.names):
            raise InputError(f"chunks of {len(chunk)} axes; the codec has {len(self.names)}")
        lengths = dict(zip(self.names, chunk, strict=True))
        blank = [n for name, n in zip(self.names, chunk, strict=True) if name == NO_AXIS]
        if any(n != 1 for n in blank):
            raise InputError(f"chunks of {tuple(chunk)}; length 1 is needed along no axis of tiles")
        t, z, y, x = (lengths.get(axis, 1) for axis in TILE_AXES)
        return t, z, y, x

    def to_tile(self, chunk: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The tile (t, z, y, x) of a chunk, contiguous. Raises what `tile_shape` raises."""
        shape = self.tile_shape(chunk.shape)
        return np.ascontiguousarray(chunk.transpose(self._order)).reshape(shape)

    def from_tile(self, tile: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The chunk of a tile (t, z, y, x) of any lengths; the inverse of `to_tile`."""
        lengths = dict(zip(TILE_AXES, tile.shape, strict=True))
        ordered = tile.reshape([lengths.get(self.names[place], 1) for place in self._order])
        return ordered.transpose(np.argsort(self._order))

    @property
    def _order(self) -> list[int]:
        """Axes of the array in the order of the tile; those that are none of it come first."""
        ranks = (NO_AXIS, *TILE_AXES)
        return sorted(range(len(self.names)), key=lambda place: ranks.index(self.names[place]))


def take_axes(configuration: Mapping[str, Any]) -> tuple[dict[str, Any], ArrayAxes | None]:
    """A configuration of `fhash.transform` without its axes, and the axes; None without any.

    Raises InputError for axes that are not allowed.
    """
    rest = dict(configuration)
    if KEY not in rest:
        return rest, None
    return rest, ArrayAxes.of(rest.pop(KEY))
