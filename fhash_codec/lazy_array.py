"""A volume as a lazy array of xarray, with the dimensions that its source had.

A key of xarray is split into steps and vertices along t, z, y and x, whatever the order of the
dimensions; an axis that was made up is squeezed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from xarray.backends import BackendArray
from xarray.core import indexing

from fhash_codec.coreset.boxes import Box
from fhash_codec.indexing import slice_of, step_blocks
from fhash_codec.shared_volumes import Handle, acquire, release
from fhash_codec.volume import Volume
from fhash_formats.series import AXES
from fhash_formats.source_metadata import NO_AXIS

__all__ = ["FhashArray", "Form"]


@dataclass(frozen=True, kw_only=True)
class Form:
    """The form in which a volume is shown.

    Attributes:
        dimensions: of the variable, each with its axis or NO_AXIS.
        lod: level of detail, None for every vertex.
        outside: as in `Volume.read`.
    """

    dimensions: Mapping[str, str]
    lod: int | None
    outside: str

    def vertices(self, volume: Volume) -> dict[str, range]:
        """Steps and vertices of the domain that are shown, by axis."""
        steps, *space = map(range, volume.shape)
        if self.lod is not None:
            space = list(volume.lod_vertices(self.lod))
        return dict(zip(AXES, (steps, *space), strict=True))

    def sizes(self, volume: Volume) -> dict[str, int]:
        """Length of each dimension."""
        lengths = {axis: len(along) for axis, along in self.vertices(volume).items()}
        return {name: lengths.get(axis, 1) for name, axis in self.dimensions.items()}

    def chunks(self, volume: Volume) -> dict[str, int]:
        """Length of a tile along each dimension."""
        t, *space = volume.chunks
        tile = dict(zip(AXES, (t, *(max(1, n >> (self.lod or 0)) for n in space)), strict=True))
        sizes = self.sizes(volume)
        return {name: min(tile.get(axis, 1), sizes[name]) for name, axis in self.dimensions.items()}


class FhashArray(BackendArray):
    """A variable of a container, decoded as it is indexed; pickled as its place."""

    def __init__(
        self, place: str, name: str, form: Form, storage_options: Mapping[str, Any] | None
    ) -> None:
        self._place, self._name, self._form = place, name, form
        self._options = storage_options
        self._handle: Handle | None = acquire(place, storage_options)
        self._digest = self._handle.digest
        volume = self._handle.volumes[name]
        self.shape = tuple(form.sizes(volume).values())
        self.dtype = volume.dtype if form.lod is None else volume.float_dtype

    def _opened(self) -> Handle:
        """The open file, for as long as it is held; InputError where it has been replaced."""
        handle = self._handle
        if handle is None or not handle.is_of_this_process():
            handle = self._handle = acquire(self._place, self._options, self._digest)
        return handle

    def release(self) -> None:
        """Close the file, unless others read from it; the next reading opens it again."""
        if self._handle is not None:
            release(self._handle)
            self._handle = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_handle": None}

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self._get
        )

    def _get(self, key: tuple[int | slice, ...]) -> npt.NDArray[Any]:
        """Values at whole numbers and slices, one for each dimension."""
        dimensions = list(self._form.dimensions.items())
        chosen = {
            axis: _positions(length, part)
            for (_, axis), length, part in zip(dimensions, self.shape, key, strict=True)
        }
        values = self._values({axis: chosen.get(axis, range(1)) for axis in AXES})
        # from t, z, y, x to the dimensions that there are, in their order
        present = [axis for _, axis in dimensions if axis != NO_AXIS]
        ordered = [axis for axis in AXES if axis in present]
        values = values.reshape([len(chosen[axis]) for axis in ordered])
        values = values.transpose([ordered.index(axis) for axis in present])
        for place, (_, axis) in enumerate(dimensions):
            if axis == NO_AXIS:
                values = np.expand_dims(values, place)
        left = (
            part if axis == NO_AXIS else slice(None) if isinstance(part, slice) else 0
            for (_, axis), part in zip(dimensions, key, strict=True)
        )
        return values[tuple(left)]

    def _values(self, ranges: Mapping[str, range]) -> npt.NDArray[Any]:
        """Values (t, z, y, x) at some of the steps and vertices that are shown."""
        # held until the values are there, even if another thread releases it
        handle, form = self._opened(), self._form
        volume = handle.volumes[self._name]
        result = np.empty([len(ranges[axis]) for axis in AXES], dtype=self.dtype)
        if not result.size:
            return result
        shown = form.vertices(volume)
        region = Box.of(
            (shown[axis][min(ranges[axis])], shown[axis][max(ranges[axis])] + 1)
            for axis in AXES[1:]
        )
        local = tuple(slice_of(ranges[axis], min(ranges[axis])) for axis in AXES[1:])
        if form.lod is not None:
            for number, step in enumerate(ranges["t"]):
                result[number] = volume.read_lod(step, form.lod, region)[local]
            return result
        for places, steps in step_blocks(ranges["t"], region.shape):
            values = volume.values_of_steps(steps, region, outside=form.outside)
            result[places] = values[:, *local]
        return result


def _positions(length: int, part: int | slice) -> range:
    """The positions that a number or slice of a key stands for."""
    if isinstance(part, slice):
        return range(length)[part]
    position = range(length)[part]
    return range(position, position + 1)
