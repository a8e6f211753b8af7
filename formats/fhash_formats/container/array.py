"""Metadata of one array: the subset of Zarr v3 that a container uses, checked on reading."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import prod
from typing import Any

import numpy as np

from fhash_formats.container.coding import ChunkCoder, chunk_coder
from fhash_formats.container.sharding import Sharding, parse_sharding
from fhash_formats.errors import DamagedFileError, UnsupportedFileError
from fhash_formats.support.number_types import DTYPES
from fhash_formats.support.slabs import chunk_region

MAX_CHUNK_BYTES = 1 << 30
"""Bytes of a decoded inner chunk."""
MAX_DIMENSIONS = 8
"""Axes of an array."""
MAX_AXIS = 1 << 62
"""Length of an array or a chunk along one axis."""

_INDEX = re.compile(r"0|[1-9][0-9]{0,18}")
_KEYS = {
    "zarr_format",
    "node_type",
    "shape",
    "data_type",
    "chunk_grid",
    "chunk_key_encoding",
    "fill_value",
    "codecs",
}
_OPTIONAL_KEYS = {"attributes", "dimension_names", "storage_transformers"}


@dataclass(frozen=True, kw_only=True)
class ArrayMetadata:
    """Shape, number type, chunking and codecs of an array.

    A member of the file holds one chunk of `chunk_shape`. Where the codecs ask for shards
    (`sharding`), that chunk is a shard of many inner chunks, each decoded alone. Elsewhere the
    chunk is its own and only inner chunk.

    Every length is at least 1. The last inner chunks along an axis are stored in full, padded
    with 0. Raises DamagedFileError or UnsupportedFileError for what a container cannot hold.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_shape: tuple[int, ...]
    codecs: Sequence[Mapping[str, Any]]
    dimension_names: tuple[str | None, ...] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 1 <= len(self.shape) <= MAX_DIMENSIONS or len(self.chunk_shape) != len(self.shape):
            raise DamagedFileError(
                f"shape {self.shape} with chunks {self.chunk_shape}; "
                f"1 to {MAX_DIMENSIONS} axes are allowed"
            )
        if self.dimension_names is not None and len(self.dimension_names) != len(self.shape):
            raise DamagedFileError(
                f"{len(self.dimension_names)} dimension names for {len(self.shape)} axes"
            )
        if self.chunk_bytes > MAX_CHUNK_BYTES:
            raise DamagedFileError(
                f"chunks of {self.chunk_bytes} bytes; the limit is {MAX_CHUNK_BYTES}"
            )
        _ = self.coder  # which refuses unsuitable codecs

    @cached_property
    def sharding(self) -> Sharding | None:
        """Division of a member into inner chunks; None where the member is one chunk."""
        return parse_sharding(self.codecs, self.chunk_shape)

    @cached_property
    def coder(self) -> ChunkCoder:
        """The coder of full inner chunks."""
        codecs = self.codecs if self.sharding is None else self.sharding.codecs
        return chunk_coder(codecs, self.dtype, self.inner_shape)

    @property
    def coding(self) -> str:
        """Name of the first codec of inner chunks."""
        codecs = self.codecs if self.sharding is None else self.sharding.codecs
        return str(codecs[0]["name"])

    @property
    def inner_shape(self) -> tuple[int, ...]:
        """Shape of an inner chunk, the least that is decoded."""
        return self.chunk_shape if self.sharding is None else self.sharding.chunk_shape

    @property
    def chunk_bytes(self) -> int:
        """Bytes of a decoded inner chunk."""
        return prod(self.inner_shape) * self.dtype.itemsize

    @property
    def grid(self) -> tuple[int, ...]:
        """Number of members along each axis."""
        return tuple(-(-n // chunk) for n, chunk in zip(self.shape, self.chunk_shape, strict=True))

    @property
    def inner_grid(self) -> tuple[int, ...]:
        """Number of inner chunks along each axis."""
        return tuple(-(-n // chunk) for n, chunk in zip(self.shape, self.inner_shape, strict=True))

    def chunk_key(self, index: Sequence[int]) -> str:
        """Name of the member of a chunk, below that of its array: "c/0/0"."""
        return "c/" + "/".join(str(i) for i in index)

    def parse_key(self, key: str) -> tuple[int, ...]:
        """The index of a chunk from its name; raises DamagedFileError if the array lacks it."""
        prefix, *numbers = key.split("/")
        if (
            prefix == "c"
            and len(numbers) == len(self.shape)
            and all(_INDEX.fullmatch(number) for number in numbers)
        ):
            index = tuple(int(number) for number in numbers)
            if all(i < n for i, n in zip(index, self.grid, strict=True)):
                return index
        raise DamagedFileError(f"no chunk of the array's grid {self.grid}")

    def inner_region(self, index: Sequence[int]) -> tuple[slice, ...]:
        """The region of the array that an inner chunk holds, cut at the array's end."""
        return chunk_region(index, self.inner_shape, self.shape)

    def to_dict(self) -> dict[str, Any]:
        """The array's zarr.json as JSON values."""
        values: dict[str, Any] = {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": self.dtype.name,
            "chunk_grid": {
                "name": "regular",
                "configuration": {"chunk_shape": list(self.chunk_shape)},
            },
            # The separator of the default encoding is "/" where none is named.
            "chunk_key_encoding": {"name": "default"},
            "fill_value": 0.0 if self.dtype.kind == "f" else 0,
            "codecs": list(self.codecs),
        }
        if self.dimension_names is not None:
            values["dimension_names"] = list(self.dimension_names)
        if self.attributes:
            values["attributes"] = dict(self.attributes)
        return values

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ArrayMetadata:
        """The metadata in a zarr.json.

        Raises DamagedFileError or UnsupportedFileError that names the key.
        """
        missing = sorted(_KEYS - values.keys())
        if missing:
            raise DamagedFileError(f"key {missing[0]} is missing")
        check_keys(values, _KEYS | _OPTIONAL_KEYS)
        if values["data_type"] not in list(DTYPES):
            raise UnsupportedFileError(
                f"data_type is {_shown(values['data_type'])}; allowed: {', '.join(DTYPES)}"
            )
        shape = _lengths(values["shape"], "shape")
        chunk_shape = _chunk_shape(values["chunk_grid"])
        encoding = values["chunk_key_encoding"]
        if encoding not in (
            {"name": "default", "configuration": {"separator": "/"}},
            {"name": "default"},
        ):
            raise UnsupportedFileError(
                f"chunk_key_encoding is {_shown(encoding)}; only the default with '/' is allowed"
            )
        if isinstance(values["fill_value"], bool) or values["fill_value"] != 0:
            raise UnsupportedFileError(
                f"fill_value is {_shown(values['fill_value'])}; only 0 is allowed"
            )
        if values.get("storage_transformers", []) != []:
            raise UnsupportedFileError("storage_transformers are not allowed")
        if not isinstance(values["codecs"], list):
            raise DamagedFileError("codecs is not a list")
        return cls(
            shape=shape,
            dtype=DTYPES[values["data_type"]],
            chunk_shape=chunk_shape,
            codecs=values["codecs"],
            dimension_names=_dimension_names(values.get("dimension_names")),
            attributes=attributes_of(values),
        )


def check_keys(values: Mapping[str, Any], allowed: set[str]) -> None:
    """Raise UnsupportedFileError for a key of a zarr.json that is not allowed.

    A key whose object says that it need not be understood is ignored (Zarr v3, extension points).
    """
    for key in values.keys() - allowed:
        extension = values[key]
        if not isinstance(extension, Mapping) or extension.get("must_understand") is not False:
            raise UnsupportedFileError(f"key {_shown(key)} is not known")


def attributes_of(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The attributes in a zarr.json; raises DamagedFileError if they are no object."""
    attributes = values.get("attributes", {})
    if not isinstance(attributes, dict):
        raise DamagedFileError("attributes is not an object")
    return attributes


def _chunk_shape(grid: object) -> tuple[int, ...]:
    if (
        not isinstance(grid, Mapping)
        or grid.get("name") != "regular"
        or not isinstance(grid.get("configuration"), Mapping)
    ):
        raise UnsupportedFileError(f"chunk_grid is {_shown(grid)}; only regular grids are allowed")
    return _lengths(grid["configuration"].get("chunk_shape"), "chunk_shape")


def _lengths(value: object, key: str) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(type(n) is int and 1 <= n <= MAX_AXIS for n in value):
        raise DamagedFileError(
            f"{key} is {_shown(value)}; a list of whole numbers from 1 to {MAX_AXIS} is needed"
        )
    return tuple(value)


def _dimension_names(value: object) -> tuple[str | None, ...] | None:
    if value is None:
        return None
    if not isinstance(value, list) or not all(
        name is None or isinstance(name, str) for name in value
    ):
        raise DamagedFileError(f"dimension_names is {_shown(value)}; a list of names is needed")
    return tuple(value)


def _shown(value: object) -> str:
    return ascii(value)[:80]
