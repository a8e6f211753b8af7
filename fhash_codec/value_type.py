"""The types that values of a container decode to, and what stands where there is no value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box, Sizes
from fhash_formats.container import Container

Number = int | float


@dataclass(frozen=True, kw_only=True)
class ValueType:
    """Types of decoded values.

    Attributes:
        source: type of the source.
        floats: type of computed values: float64 for sources of float64 or of integers above 16
            bits, else float32.
        own: type in which values at vertices and steps lose nothing: the source's for integers that
            the file holds as integers of every step, else `floats`.
        has_gaps: whether some vertices have no value.
        fill: the number that stood in the source for a missing value; None where it is unknown.
    """

    source: np.dtype[Any]
    floats: np.dtype[Any]
    own: np.dtype[Any]
    has_gaps: bool
    fill: Number | None

    @classmethod
    def of(cls, container: Container) -> ValueType:
        """The types of a container."""
        header = container.header
        variable, model = header["variable"], header["model"]
        source = np.dtype(variable["dtype"])
        stored_as_integers = (
            source.kind in "iu"
            and model["profile"] == "compact"
            and model.get("values", model["tables"]) == source.name
            and model["levels"][0][0] == header["domain"]["shape"][0]
        )
        return cls(
            source=source,
            floats=decoded_type(source),
            own=source if stored_as_integers else decoded_type(source),
            has_gaps=_has_gaps(header) or "missing/bits" in container.arrays,
            fill=variable.get("fill"),
        )

    def of_array(self, fill: Number | None) -> tuple[np.dtype[Any], Number | None]:
        """The type of values in an array, and what stands in it where there is no value.

        Integers stay what they are if none is missing, or if the fill value is one of their type.
        A fill value that was not asked for is the source's own, and only for integers.

        fill: the number asked for; None for none. Returns None for the fill value where it is NaN.
        """
        if self.own.kind == "f":
            return self.own, fill
        chosen = self.fill if fill is None else fill
        if chosen is not None and not holds(self.own, chosen):
            chosen = None
        if chosen is not None or not self.has_gaps:
            return self.own, 0 if chosen is None else int(chosen)
        return self.floats, fill


def decoded_type(source: np.dtype[Any]) -> np.dtype[Any]:
    """The type of decoded values: a float wide enough for the source's own precision."""
    narrow = source.itemsize <= 2 or source == np.float32
    return np.dtype(np.float32 if narrow else np.float64)


def holds(dtype: np.dtype[Any], number: Number) -> bool:
    """Whether a type has this number exactly; floats have every number up to their largest."""
    if dtype.kind == "f":
        return number != number or abs(number) <= float(np.finfo(dtype).max)
    limits = np.iinfo(dtype)
    if not np.isfinite(float(number)) or number != int(number):
        return False
    return bool(limits.min <= int(number) <= limits.max)


def placed(
    values: npt.NDArray[Any], where: npt.NDArray[np.bool_], box: Box, shape: Sizes
) -> npt.NDArray[Any]:
    """Values (z, y, x) where a mask is True, in a box of an array of a shape that is NaN elsewhere.

    The values themselves where they are all of the array. Values and mask may have more axes before
    z, which the result has, too.
    """
    if box.shape == shape and where.all():
        return values
    result = np.full((*values.shape[:-3], *shape), np.nan, dtype=values.dtype)
    np.copyto(result[..., *box.slices()], values, where=where)
    return result


def filled(values: npt.NDArray[Any], fill: Number | None) -> npt.NDArray[Any]:
    """Floats with a fill value in place of NaN; None leaves them as they are."""
    return values if fill is None else np.where(np.isnan(values), values.dtype.type(fill), values)


def rounded(values: npt.NDArray[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Floats as the nearest integers of a type, 0 for NaN.

    The ends of 64-bit types are no floats: what rounding puts beyond them becomes the nearest float
    within.
    """
    limits = np.iinfo(dtype)
    low, high = float(limits.min), float(limits.max)
    if int(high) > limits.max:
        high = float(np.nextafter(high, 0))
    wide = np.nan_to_num(values.astype(np.float64), nan=0.0)
    return np.clip(np.rint(wide), low, high).astype(dtype)


def _has_gaps(header: Mapping[str, Any]) -> bool:
    """Whether some vertices of the domain are outside the coreset, by the header."""
    box = [[0, length] for length in header["domain"]["shape"][1:]]
    return bool(header["coreset_fraction"] < 1 or header["feature_bounding_box"] != box)
