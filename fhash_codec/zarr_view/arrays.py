"""Arrays of a view: metadata of Zarr v3, and chunks that are made when they are asked for."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.support.slabs import chunk_region

__all__ = ["Region", "ViewArray", "chunk_index", "chunk_key"]

EXACT_IN_JSON = 2**53
"""Integers up to this size are the same number in every JSON library, those of browsers too."""

Index = tuple[int, ...]
Region = tuple[slice, ...]

_INDEX = re.compile(r"(?:0|[1-9][0-9]{0,17})(?:/(?:0|[1-9][0-9]{0,17}))*")


@dataclass(frozen=True, kw_only=True)
class ViewArray:
    """An array whose chunks are plain little-endian values, without compression.

    Attributes:
        shape: length of each axis, at least 1.
        chunk_shape: of a chunk; those at the end of an axis are stored in full.
        dtype: an integer or float type, native byte order.
        dimension_names: names of the axes.
        attributes: JSON values.
        fill: the number where there is no value; None for NaN, or 0 of integers.
        read: values of a region, of `dtype`.
        holds: whether a region has any value; without one its chunk is left out, and every Zarr
            library puts `fill` in its place.
    """

    shape: Index
    chunk_shape: Index
    dtype: np.dtype[Any]
    dimension_names: tuple[str, ...]
    attributes: Mapping[str, Any]
    fill: int | float | None
    read: Callable[[Region], npt.NDArray[Any]]
    holds: Callable[[Region], bool]

    @cached_property
    def grid(self) -> Index:
        """Number of chunks along each axis."""
        return tuple(-(-n // c) for n, c in zip(self.shape, self.chunk_shape, strict=True))

    @cached_property
    def chunk_bytes(self) -> int:
        """Bytes of every chunk."""
        return prod(self.chunk_shape) * self.dtype.itemsize

    @cached_property
    def _fill(self) -> int | float:
        """The number where there is no value."""
        if self.fill is not None:
            return self.fill
        return float("nan") if self.dtype.kind == "f" else 0

    @cached_property
    def _leaves_out(self) -> bool:
        """Whether chunks without a value may be left out: their number survives JSON."""
        return self.dtype.kind == "f" or abs(self._fill) <= EXACT_IN_JSON

    def document(self) -> dict[str, Any]:
        """The array's metadata document, `zarr.json`."""
        endian = {"configuration": {"endian": "little"}} if self.dtype.itemsize > 1 else {}
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": self.dtype.name,
            "chunk_grid": {
                "name": "regular",
                "configuration": {"chunk_shape": list(self.chunk_shape)},
            },
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": _json_number(self._fill),
            "codecs": [{"name": "bytes", **endian}],
            "dimension_names": list(self.dimension_names),
            "attributes": dict(self.attributes),
        }

    def is_same(self, other: ViewArray) -> bool:
        """Whether another array has the same values, dimensions and attributes; both are read."""
        if self.document() != other.document():
            return False
        whole = tuple(slice(0, n) for n in self.shape)
        return bool(np.array_equal(self.read(whole), other.read(whole), equal_nan=True))

    def has(self, index: Index) -> bool:
        """Whether there is a chunk; one outside the grid is not, nor one without any value."""
        if len(index) != len(self.grid):
            return False
        if not all(0 <= i < n for i, n in zip(index, self.grid, strict=True)):
            return False
        return not self._leaves_out or self.holds(self._region(index))

    def indices(self) -> Iterator[Index]:
        """Yield the index of every chunk that there is, in C order."""
        return (index for index in product(*map(range, self.grid)) if self.has(index))

    def chunk(self, index: Index) -> bytes:
        """The bytes of a chunk that there is. Raises what reading the volume raises."""
        region = self._region(index)
        values = self.read(region)
        if values.shape != self.chunk_shape:
            full = np.full(self.chunk_shape, self._fill, dtype=self.dtype)
            full[tuple(slice(0, along.stop - along.start) for along in region)] = values
            values = full
        return values.astype(self.dtype.newbyteorder("<"), copy=False).tobytes()

    def _region(self, index: Index) -> Region:
        return chunk_region(index, self.chunk_shape, self.shape)


def chunk_index(text: str) -> Index | None:
    """The index that the end of a chunk's key stands for, such as "0/3/1"; None for other text."""
    return tuple(map(int, text.split("/"))) if _INDEX.fullmatch(text) else None


def chunk_key(index: Index) -> str:
    """The end of the key of a chunk: "c/0/3/1"."""
    return "/".join(("c", *map(str, index)))


def _json_number(number: int | float) -> int | float | str:
    """A fill value as Zarr writes it in JSON, which has no word for NaN and infinities."""
    if number != number:
        return "NaN"
    if number in (float("inf"), float("-inf")):
        return "Infinity" if number > 0 else "-Infinity"
    return number
