"""Codecs of what a table keeps in arrays of its own: `fhash.head` and `fhash.mask`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError
from fhash_formats.transform.head.head import NeighbourHead

__all__ = ["HeadCoder", "MaskCoder", "head_parameters"]

FEATURE = "apart"
"""Feature of the format that a reader of these codecs must know."""


def head_parameters(data: bytes | memoryview) -> npt.NDArray[np.float32]:
    """Parameters (N,) of a packed head: of each layer its weights row by row, then its biases.

    Raises DamagedFileError for bytes that are no packed head.
    """
    layers = NeighbourHead.from_bytes(bytes(data)).layers
    return np.concatenate([numbers.ravel() for layer in layers for numbers in layer.parameters])


class HeadCoder:
    """Coder of the parameters of a head: float32 (N,), in one chunk.

    Attributes:
        features: features that a container with such an array requires.
    """

    features = (FEATURE,)

    def __init__(
        self, codecs: Sequence[Mapping[str, Any]], dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        """A coder from an array's metadata.

        Raises DamagedFileError for another type or number of axes, UnsupportedFileError for
        settings or a second codec.
        """
        _check_alone(codecs)
        if dtype != np.float32 or len(shape) != 1:
            raise DamagedFileError(f"a head is float32 with one axis, not {dtype} {shape}")
        self._shape = shape

    def encode(self, chunk: npt.NDArray[Any]) -> NoReturn:
        """Raises InputError: a head is packed from its whole numbers, not from parameters."""
        raise InputError("fhash.head only decodes; NeighbourHead.to_bytes packs a head")

    def decode(self, data: memoryview | bytes) -> npt.NDArray[np.float32]:
        """The parameters; raises DamagedFileError."""
        parameters = head_parameters(data)
        if parameters.shape != self._shape:
            raise DamagedFileError(
                f"a head has {parameters.size} parameters; its array has {self._shape[0]}"
            )
        return parameters


class MaskCoder:
    """Coder of the masks of a table's tiles: uint8 (t, z, y, x), one chunk for each tile.

    A mask is decoded with its tile only, since the decoded values say which vertices are likely
    occupied.

    Attributes:
        features: features that a container with such an array requires.
    """

    features = (FEATURE,)

    def __init__(
        self, codecs: Sequence[Mapping[str, Any]], dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        """A coder from an array's metadata.

        Raises DamagedFileError for another type, UnsupportedFileError for settings or a second
        codec.
        """
        _check_alone(codecs)
        if dtype != np.uint8:
            raise DamagedFileError(f"masks are uint8, not {dtype}")

    def encode(self, chunk: npt.NDArray[Any]) -> NoReturn:
        """Raises InputError: masks are coded with the table."""
        raise InputError("fhash.mask does not encode; masks are coded with their table")

    def decode(self, data: memoryview | bytes) -> NoReturn:
        """Raises InputError: a mask is decoded with its table."""
        raise InputError("a mask is decoded with the tile of its table, by fhash_codec.open")


def _check_alone(codecs: Sequence[Mapping[str, Any]]) -> None:
    """Raise UnsupportedFileError unless there is one codec, without settings."""
    if len(codecs) != 1 or codecs[0].get("configuration", {}):
        raise UnsupportedFileError(
            f"{codecs[0]['name']} has no settings, and crc32c comes right after it"
        )
