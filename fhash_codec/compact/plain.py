"""The compact model in plain numbers (FORMAT.md, Plain files): tables, head and corrections.

`PlainArray` reads such a file as if it were the coded array of a compact file.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, lru_cache
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container import StoredArray
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.slabs import chunk_region, common_part
from fhash_formats.transform.head.head import Layer, NeighbourHead
from fhash_formats.transform.values.elementwise import cast

__all__ = ["PlainArray", "corrected", "correction_of", "correction_type", "head_of", "predicted"]

CACHED_TILES = 8
"""Corrected tiles that an open file keeps."""
MAX_FRACTION = 1e-3
"""Largest distance of a weight from a whole multiple of its unit, in units: float32 stores up to
127 of them with an error of 1e-5."""

Region = tuple[slice, ...]


def predicted(
    table: npt.NDArray[Any], head: NeighbourHead | None, dtype: np.dtype[Any]
) -> npt.NDArray[Any]:
    """Return what the head makes of the table (t, z, y, x) of a tile, in the type of the values."""
    with np.errstate(over="ignore", invalid="ignore"):
        return cast(table if head is None else head.apply(np.ascontiguousarray(table)), dtype)


def correction_type(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of the corrections of values of a type."""
    narrow = dtype.itemsize <= 2 or dtype == np.float32
    return np.dtype(np.float32 if narrow else np.float64)


def correction_of(values: npt.NDArray[Any], base: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return what takes predicted to decoded values, of one type; 0 where a value is not finite."""
    kind = correction_type(values.dtype)
    if values.dtype.kind != "f":
        # Modulo 2^64, so that neighbouring integers beyond 2^53 are still told apart.
        return (values.astype(np.int64) - base.astype(np.int64)).astype(kind)
    with np.errstate(invalid="ignore", over="ignore"):
        difference = values.astype(np.float64) - base.astype(np.float64)
    return np.where(np.isfinite(difference), difference, 0.0).astype(kind)


def corrected(base: npt.NDArray[Any], corrections: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return predicted values with their corrections, in their own type."""
    if base.dtype.kind != "f":
        with np.errstate(invalid="ignore"):
            return (base.astype(np.int64) + corrections.astype(np.int64)).astype(base.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        values: npt.NDArray[Any] = (base.astype(np.float64) + corrections).astype(base.dtype)
    return values


def head_of(model: Mapping[str, Any], arrays: Mapping[str, StoredArray]) -> NeighbourHead | None:
    """Return the head of a plain file. Raises DamagedFileError where its arrays do not fit it."""
    described = model["head"]
    if described is None:
        return None
    layers = []
    try:
        for number in range(1, len(described["hidden"]) + 2):
            weights, biases = (
                _integers(arrays[f"mlp/{kind}_{number}"]) for kind in ("weight", "bias")
            )
            layers.append(Layer.of(weights, biases))
        with np.errstate(over="ignore"):
            return NeighbourHead(
                layers=tuple(layers),
                sigma=described["sigma"],
                low=described["low"],
                high=described["high"],
                cross=described["cross"],
            )
    except (InputError, OverflowError) as error:
        raise DamagedFileError(f"the head of a plain file is damaged: {error}") from error


def _integers(array: StoredArray) -> tuple[npt.NDArray[np.int8], float]:
    """The whole numbers of an array of weights or biases, and their unit."""
    scale = float(array.attributes["scale"])
    with np.errstate(over="ignore", invalid="ignore"):
        numbers = array.read().astype(np.float64) / scale
        whole = np.abs(numbers - np.rint(numbers)) <= MAX_FRACTION
    if not whole.all() or np.abs(numbers).max() > 127:
        raise DamagedFileError(f"array {array.name} has numbers that are no multiples of its scale")
    return np.rint(numbers).astype(np.int8), scale


class PlainArray:
    """The values of a plain file, read as those of the coded array of a compact file."""

    masked = False

    def __init__(self, model: Mapping[str, Any], arrays: Mapping[str, StoredArray]) -> None:
        self._model, self._arrays = model, arrays
        self._table = arrays["tables/level_1"]
        self._corrections = arrays.get("corrections")
        self.shape = self._table.shape[:4]
        self.chunk_shape = tuple(model["tile"])
        self.dtype = np.dtype(model["values"])
        self._tile = lru_cache(maxsize=CACHED_TILES)(self._decode_tile)

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self._model["levels"])

    @cached_property
    def head(self) -> NeighbourHead | None:
        """The head of the file."""
        return head_of(self._model, self._arrays)

    def read(self, region: Region) -> npt.NDArray[Any]:
        """Return the values of a region, slices (t, z, y, x) with explicit ends."""
        if self.head is None:  # no value depends on others of its tile
            return self._decode(region)
        result = np.empty([along.stop - along.start for along in region], self.dtype)
        bounds = [(along.start, along.stop) for along in region]
        tiles = zip(region, self.chunk_shape, strict=True)
        for index in product(*(range(a.start // n, -(-a.stop // n)) for a, n in tiles)):
            target, source = common_part(index, self.chunk_shape, bounds)
            result[target] = self._tile(index)[source]
        return result

    def _decode_tile(self, index: tuple[int, ...]) -> npt.NDArray[Any]:
        """The values of a tile, as far as the array reaches."""
        return self._decode(chunk_region(index, self.chunk_shape, self.shape))

    def _decode(self, region: Region) -> npt.NDArray[Any]:
        """The values of a region that is one tile, or any region where there is no head."""
        base = predicted(self._table.read((*region, slice(0, 1)))[..., 0], self.head, self.dtype)
        if self._corrections is None:
            return base
        corrections = self._corrections.read(region)
        whole = base.dtype.kind != "f"
        sound = np.abs(corrections) <= 2.0**63 if whole else np.isfinite(corrections)
        if not sound.all():
            raise DamagedFileError("array corrections has numbers beyond the type of the values")
        return corrected(base, corrections)
