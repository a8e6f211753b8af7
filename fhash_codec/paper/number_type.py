"""The numbers of a file that embeddings are stored as."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.network import Floats
from fhash_formats.errors import InputError


@dataclass(frozen=True, kw_only=True)
class NumberType:
    """The numbers of a file that embeddings are stored as.

    Attributes:
        dtype: type of the numbers, floating or unsigned.
        scale, offset: an embedding stored as an unsigned number is offset + scale * number.
    """

    dtype: np.dtype[Any]
    scale: float = 1.0
    offset: float = 0.0

    @classmethod
    def of(cls, values: Floats, kind: str) -> NumberType:
        """Return the number type named `kind` with the scale and offset that fit some embeddings.

        Raises InputError where the embeddings are not finite or do not fit in the type.
        """
        dtype = np.dtype(kind)
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
        if not (isfinite(low) and isfinite(high)):
            raise InputError(
                "embeddings are not finite: the training diverged; set a lower --learning-rate"
            )
        if dtype.kind == "u":
            # The range includes 0, so that the 0 of untrained vertices costs little.
            low, high = min(low, 0.0), max(high, 0.0)
        reached = high - low if dtype.kind == "u" else max(-low, high)
        if reached > float(np.finfo(np.float32 if dtype.kind == "u" else dtype).max):
            raise InputError(
                f"embeddings reach {reached:g}, more than {kind} holds; use --tables float32"
            )
        if dtype.kind == "f":
            return cls(dtype=dtype)
        # float32 holds numbers below its `tiny` with fewer digits. A scale that small would not
        # give back the embeddings.
        scale = (
            max((high - low) / np.iinfo(dtype).max, float(np.finfo(np.float32).tiny))
            if high > low
            else 1.0
        )
        return cls(dtype=dtype, scale=scale, offset=low)

    def stored(self, embeddings: Floats) -> npt.NDArray[Any]:
        """Return embeddings as numbers of the type, of the same shape."""
        if self.dtype.kind == "f":
            return embeddings.astype(self.dtype)
        return np.asarray(
            np.rint(embeddings / self.scale - self.offset / self.scale).astype(self.dtype)
        )

    @property
    def attributes(self) -> dict[str, float]:
        """The attributes by which a reader finds the embeddings again."""
        return {"offset": self.offset, "scale": self.scale} if self.dtype.kind == "u" else {}
