"""`MaskArray`: masks of a table's tiles that lie in an array of their own."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.stored import ChunkIndex, StoredArray
from fhash_formats.errors import InputError

__all__ = ["MaskArray"]


class MaskArray(StoredArray):
    """The masks of a table's chunks in an array of their own: uint8, 1 where a value is occupied.

    A mask is decoded with the chunk of the table that it belongs to.
    """

    def attach(self, table: StoredArray) -> None:
        """Let the table find its masks here, and this array the values that decode them."""
        self._table, table.masks = table, self

    def _decode(
        self, index: ChunkIndex, lod: int = 0, *, table: bool = False
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any] | None]:
        """The mask of a chunk; `lod` other than 0 raises InputError."""
        if lod:
            raise InputError(f"level of detail {lod}; masks have none but 0")
        return self._table._mask(index, keep=True).astype(np.uint8), None

    def _decode_and_drop(self, index: ChunkIndex) -> None:
        # All masks are decoded where the table is verified.
        self.coded(index)
