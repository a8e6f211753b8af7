"""A feature of the user's own: a mask in a file, with the shape of the series."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.registry import open_whole
from fhash_formats.series import Series


class Mask:
    """A mask over a series: `mask(step)` is the boolean frame (z, y, x).

    A file with a single frame serves every step.
    """

    def __init__(self, values: Series) -> None:
        self._values = values
        self.files = values.files

    def __call__(self, step: int) -> npt.NDArray[np.bool_]:
        """Frame (z, y, x), True where the file's value at this step is neither zero nor NaN.

        Raises InputError if the file cannot be read.
        """
        frame = self._values.read(step if self._values.shape[0] > 1 else 0)
        mask: npt.NDArray[np.bool_] = frame != 0
        return mask & ~np.isnan(frame) if frame.dtype.kind == "f" else mask

    def close(self) -> None:
        """Close the file."""
        self._values.close()


def open_mask(path: str | Path, shape: Sequence[int], var: str | None = None) -> Mask:
    """Open a mask for a series of `shape` (t, z, y, x).

    The file holds booleans or numbers of that shape, or of (z, y, x) for all steps alike, in any
    format that `open_series` reads. Raises InputError for another shape.
    """
    values = open_whole(path, Request(var=var, booleans=True, asked=False))
    if values.shape[1:] != tuple(shape[1:]) or values.shape[0] not in (1, shape[0]):
        values.close()
        raise InputError(
            f"{path}: the mask has shape {values.shape} (t, z, y, x), the series {tuple(shape)};"
            " it must be that, or one step of it"
        )
    return Mask(values)
