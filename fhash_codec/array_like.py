"""The side of a volume that makes it an array like numpy's: axes, basic indexing, conversion."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box, Spans
from fhash_codec.indexing import Index, expand_index, index_ranges, slice_of, step_blocks
from fhash_formats.series import AXES


class ArrayLike:
    """The array (t, z, y, x) that a volume is to numpy.

    A volume adds its shape and type, and how values of neighbouring steps are decoded.
    """

    dims = AXES
    ndim = 4
    shape: tuple[int, int, int, int]
    dtype: np.dtype[Any]

    def values_of_steps(
        self, steps: range, region: Spans | None = None, *, outside: str = "nan"
    ) -> npt.NDArray[Any]:
        """Values (t, z, y, x) of a region at neighbouring steps."""
        raise NotImplementedError

    def __getitem__(self, index: Index | tuple[Index, ...]) -> npt.NDArray[Any]:
        """Values by numpy's basic indexing: integers, slices and `...`, negative ones as usual.

        Raises RegionError (an IndexError) for an index outside the shape and for other indices.
        """
        parts = expand_index(index)
        ranges = index_ranges(parts, self.shape)
        steps, *space = ranges
        result = np.empty([len(positions) for positions in ranges], dtype=self.dtype)
        if result.size:
            region = Box.of((min(positions), max(positions) + 1) for positions in space)
            local = tuple(map(slice_of, space, region.first))
            for places, together in step_blocks(steps, region.shape):
                result[places] = self.values_of_steps(together, region)[:, *local]
        return result[tuple(slice(None) if isinstance(part, slice) else 0 for part in parts)]

    def __array__(
        self, dtype: npt.DTypeLike | None = None, copy: bool | None = None
    ) -> npt.NDArray[Any]:
        """All values, decoded."""
        if copy is False:
            raise ValueError(
                "a volume cannot become an array without a copy: its values are decoded"
            )
        values = self[...]
        return values if dtype is None else values.astype(dtype)

    def __len__(self) -> int:
        return self.shape[0]
