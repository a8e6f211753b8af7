"""Coder of the chunks of an array in a container, and the axes of an array as those of a tile."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError
from fhash_formats.transform.predict import encode_differences
from fhash_formats.transform.tile import (
    decode_tile,
    decode_tile_mask,
    decode_tile_table,
    encode_tile,
    exact_tile,
)
from fhash_formats.transform.tile_format import (
    DIFFERENCES,
    Shape,
    TileSettings,
    parse_stream,
    seal,
)

KEY = "axes"
"""Key of the axes in the configuration of `fhash.transform`."""
TILE_AXES = ("t", "z", "y", "x")
"""Axes of a tile, in its order."""
NO_AXIS = ""
"""Name for an axis of the array that is none of the tile; chunks have length 1 along it."""


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


MAX_TILE_VERTICES = 1 << 27
"""Vertices of a tile. Decoding takes some 30 bytes each; a damaged file may claim any number."""


def settings_of(configuration: Mapping[str, Any]) -> TileSettings | None:
    """The settings in a configuration without axes; None where each stream has its own.

    Raises InputError or DamagedFileError for anything else.
    """
    if not configuration:
        return None
    if set(configuration) != {"settings"}:
        raise InputError("the configuration has settings, and axes, or is empty")
    return TileSettings.from_text(configuration["settings"])


class TransformCoder:
    """Coder of chunks of one type and shape.

    The settings are in the codec's configuration, or each chunk's stream has its own.

    Attributes:
        settings: settings that all chunks share; None where each stream has its own.
        masked: whether the chunks say which of their values are occupied.
        axes: axis of the tile for each axis of a chunk; None for the last ones of t, z, y, x.
    """

    def __init__(
        self, codecs: Sequence[Mapping[str, Any]], dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        """A coder from an array's metadata.

        Args:
            codecs: the codecs in the metadata; one, `{"name": ..., "configuration": ...}`, whose
                configuration has `settings`, the base64 of a packed block, or none, and `axes`.
            dtype: type of the values.
            shape: shape of a chunk, of at most 4 axes.

        Raises DamagedFileError for a configuration that is not allowed and for tiles that are too
        large, UnsupportedFileError for a second codec.
        """
        if prod(shape) > MAX_TILE_VERTICES:
            raise DamagedFileError(
                f"tiles of {prod(shape):,} vertices; the limit is {MAX_TILE_VERTICES:,}"
            )
        if len(codecs) != 1:
            raise UnsupportedFileError(
                "no codec may follow fhash.transform, whose chunks have a checksum of their own"
            )
        if len(shape) > 4:
            raise DamagedFileError(
                f"fhash.transform codes arrays of at most 4 axes, not {len(shape)}"
            )
        t, z, y, x = (1,) * (4 - len(shape)) + shape
        self._tile_shape: Shape = (t, z, y, x)
        try:
            configuration, self.axes = take_axes(codecs[0].get("configuration", {}))
            self.settings = settings_of(configuration)
            if self.axes is not None:
                self._tile_shape = self.axes.tile_shape(shape)
        except (InputError, DamagedFileError) as error:
            raise DamagedFileError(f"codec fhash.transform: {error}") from error
        self.masked = self.settings is not None and self.settings.mask is not None
        self._shape, self._dtype = shape, dtype.newbyteorder("=")

    def encode(self, chunk: npt.NDArray[Any]) -> bytes:
        """The stream of a full chunk, which keeps every bit where there are no settings."""
        tile = chunk.reshape(self._tile_shape) if self.axes is None else self.axes.to_tile(chunk)
        if self.settings is not None:
            return encode_tile(tile, self.settings).data
        body = encode_differences(np.ascontiguousarray(tile, self._dtype))
        return exact_tile(tile).data if body is None else seal(DIFFERENCES, [body])

    def check(self, data: memoryview | bytes) -> None:
        """Raises DamagedFileError for a stream that is damaged."""
        parse_stream(data)

    def decode(self, data: memoryview | bytes, lod: int = 0) -> npt.NDArray[Any]:
        """The full chunk, or with `lod` every 2^lod-th vertex along z, y, x.

        Raises DamagedFileError.
        """
        return self._decoded(decode_tile, data, lod)

    def decode_table(self, data: memoryview | bytes, lod: int = 0) -> npt.NDArray[Any]:
        """The table of the full chunk, see `decode_tile_table`; `lod` as in `decode`.

        Raises DamagedFileError.
        """
        return self._decoded(decode_tile_table, data, lod)

    def decode_masked(
        self, data: memoryview | bytes
    ) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
        """The full chunk, and which of its values are occupied. Raises DamagedFileError."""
        values, mask = decode_tile_mask(data, self._tile_shape, self._dtype, self.settings)
        if self.axes is not None:
            return self.axes.from_tile(values), self.axes.from_tile(mask)
        return values.reshape(self._shape), mask.reshape(self._shape)

    def _decoded(
        self, decode: Callable[..., npt.NDArray[Any]], data: memoryview | bytes, lod: int
    ) -> npt.NDArray[Any]:
        """The chunk of what `decode` makes of a tile at a level of detail.

        Tiles have less detail along their own z, y and x. Where one of these is the first axis of
        the array, along which a level of detail has every position, all of the tile is decoded.
        """
        whole = self.axes is not None and self.axes.names[0] != TILE_AXES[0]
        level = 0 if whole else lod
        values = decode(data, self._tile_shape, self._dtype, self.settings, level)
        if self.axes is None:
            return values.reshape(values.shape[4 - len(self._shape) :])
        chunk = self.axes.from_tile(values)
        every = slice(None, None, 1 << lod)
        return chunk[..., every, every, every] if whole and lod else chunk
