"""The tiles of a volume as the chunks of an array of Zarr, where they alone are its values."""

from __future__ import annotations

import base64
import struct
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from fhash_codec.coreset.boxes import Box
from fhash_codec.header import read_missing
from fhash_codec.provenance import figure_attributes, history_line, source_attributes
from fhash_codec.value_type import holds
from fhash_codec.volume import Volume
from fhash_formats.container import StoredArray
from fhash_formats.container.header import COMPACT, PLAIN_FEATURE, TABLE
from fhash_formats.container.sharding import Sharding
from fhash_formats.errors import InputError
from fhash_formats.series import AXES
from fhash_formats.source_metadata import NO_AXIS, with_history
from fhash_formats.support.slabs import chunk_region
from fhash_formats.transform.array_axes import NO_AXIS as NO_TILE_AXIS
from fhash_formats.transform.array_axes import TILE_AXES, ArrayAxes
from fhash_formats.writers.common.outline import Outline
from fhash_formats.writers.common.region import Region

if TYPE_CHECKING:
    from fhash_formats.transform.zarr_codec import TransformCodec

__all__ = ["FILL", "ChunkTable"]

FILL = "_FillValue"
"""Attribute that says which number stands for a missing value."""

Index = tuple[int, ...]


class ChunkTable:
    """The tiles of a volume in the dimensions of an array of Zarr.

    Attributes:
        path: of the container.
        outline: of the array, and of all beside it.
        dtype: of the values.
        chunk, shard: lengths of a chunk and of a shard of many; None without shards.
        grid: number of chunks along each dimension.
        sharding: division into shards; None without.
        codec: that decodes the chunks.
        fill: the number that stands for a missing value; None where there is none, or NaN.

    Raises InputError for a volume whose tiles alone are not its values.
    """

    def __init__(self, volume: Volume) -> None:
        self.path, self._volume = volume.path, volume
        _require_plain_tiles(volume)
        self._table = volume.container.arrays[TABLE]
        self.dtype = self._table.dtype
        self.fill = self._fill()
        self._check_missing()
        region = Region(
            name=volume.name,
            units=volume.units,
            dtype=self.dtype,
            shape=volume.shape,
            coords=volume.coords,
            attributes=volume.attrs,
            metadata=volume.metadata,
        )
        self.outline = _with_provenance(Outline.of(region), volume)
        made_up = set(AXES) - set(self.outline.dimensions.values())
        lengths = dict(zip(AXES, self._table.chunk_shape, strict=True))
        if any(lengths[axis] > 1 for axis in made_up):
            raise InputError(_refusal(volume, "tiles that are longer than an axis it made up"))
        self.chunk = self.outline.ordered(self._table.chunk_shape)
        self.grid = self.outline.ordered(self._table.grid)
        shard = self._table.shard_shape
        self.shard = None if shard is None else self.outline.ordered(shard)
        self.sharding = (
            None
            if self.shard is None
            else Sharding(shard_shape=self.shard, chunk_shape=self.chunk, codecs=())
        )

    @property
    def codec(self) -> TransformCodec:
        """The codec that decodes the chunks."""
        from fhash_formats.transform.zarr_codec import TransformCodec

        stored = self._table.axes
        names = TILE_AXES if stored is None else stored.names
        by_axis = dict(zip(AXES, names, strict=True)) | {NO_AXIS: NO_TILE_AXIS}
        axes = ArrayAxes(tuple(by_axis[axis] for axis in self.outline.dimensions.values()))
        told = None if axes.usual else axes.names
        if self._table.settings is None:
            return TransformCodec(reading=True, axes=told)
        return TransformCodec(settings=self._table.settings, axes=told)

    @property
    def stored_fill(self) -> Any:
        """The fill value as xarray has it among the attributes in Zarr."""
        assert self.fill is not None
        if self.dtype.kind != "f":
            return int(self.fill)
        return base64.standard_b64encode(struct.pack("<d", float(self.fill))).decode()

    def stream(self, index: Sequence[int]) -> bytes:
        """The bytes of a chunk. Raises DamagedFileError."""
        by_axis = dict(zip(self.outline.dimensions.values(), index, strict=True))
        place = tuple(by_axis.get(axis, 0) for axis in AXES)
        return bytes(self._table.coded(place))

    def _fill(self) -> int | float | None:
        """The number that stands for a missing value, as xarray's engine shows it."""
        volume = self._volume
        fill = volume.value_type.fill
        if self.dtype.kind == "f":
            return fill if "missing/bits" in volume.container.arrays else None
        told = volume.value_type.has_gaps
        if volume.metadata is not None:
            told = told or bool({FILL, "missing_value"} & set(volume.metadata.variable_attributes))
        return fill if told and fill is not None and holds(self.dtype, fill) else None

    def _check_missing(self) -> None:
        """Refuse a volume with missing vertices where the tiles have some value."""
        volume = self._volume
        if "missing/bits" not in volume.container.arrays:
            return
        for index in product(*map(range, self._table.grid)):
            steps, *space = chunk_region(index, self._table.chunk_shape, volume.shape)
            box = Box.of((along.start, along.stop) for along in space)
            missing = read_missing(volume.container, range(steps.start, steps.stop), box)
            if missing is None or not missing.any():
                continue
            values = self._table.read((steps, *space))[missing]
            known = np.zeros(values.shape, np.bool_) if self.fill is None else values == self.fill
            if values.dtype.kind == "f":
                known |= np.isnan(values)
            if not known.all():
                raise InputError(_refusal(volume, "missing values that its tiles do not tell"))


def _with_provenance(outline: Outline, volume: Volume) -> Outline:
    """An outline with the attributes that xarray's engine adds: the source, and the errors."""
    header, metadata = volume.container.header, volume.metadata
    of_file = (
        with_history({}, history_line(header))
        if metadata is None
        else {**outline.file_attributes, **source_attributes(metadata)}
    )
    attributes = {**outline.attributes, **figure_attributes(header)}
    return replace(outline, attributes=attributes, file_attributes=of_file)


def _require_plain_tiles(volume: Volume) -> None:
    """Raise InputError for a volume whose values are more than what its tiles decode to."""
    header = volume.container.header
    if header["model"]["profile"] != COMPACT:
        raise InputError(_refusal(volume, f"a model of the profile {volume.profile}"))
    if PLAIN_FEATURE in header["required_features"]:
        raise InputError(_refusal(volume, "tables of plain numbers"))
    table: StoredArray = volume.container.arrays[TABLE]
    if table.shape != volume.shape:
        raise InputError(_refusal(volume, "tiles of a part of its domain or of its steps alone"))
    if table.masked and table.dtype.kind != "f":
        raise InputError(_refusal(volume, "integers of which some have no value"))
    if table.dtype != volume.dtype and table.dtype != np.float16:
        kinds = f"tiles of {table.dtype} for values of {volume.dtype}"
        raise InputError(_refusal(volume, kinds))


def _refusal(volume: Volume, what: str) -> str:
    return (
        f"{volume.path}: {volume.name} has {what}, which an array of coded chunks cannot show; "
        f"fhash decode {volume.path} -o OUT.zarr writes the values, and fhash export --plain the"
        " model in plain numbers"
    )
