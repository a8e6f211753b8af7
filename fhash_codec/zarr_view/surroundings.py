"""Arrays beside the values: auxiliary coordinates, bounds and grid mappings of the source.

They are as the source stores them, and a reader of CF decodes them as there. Left out are texts,
and arrays whose name or lengths another array of the group has.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, MutableMapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.volume import Volume
from fhash_codec.zarr_view.arrays import ViewArray
from fhash_codec.zarr_view.levels import Level
from fhash_formats.series import AXES
from fhash_formats.source_metadata import (
    COORDINATES,
    NAMING,
    SourceVariable,
    references,
    without_names,
)
from fhash_formats.support.attributes import PLUMBING, json_attributes
from fhash_formats.support.slabs import slab_shape
from fhash_formats.writers.common.labels import safe_name

__all__ = ["arrays_beside", "naming_attributes", "positions_along", "shown_axes"]

CHUNK_BYTES = 1 << 20
"""Bytes of a chunk of such an array."""
FILL = "_FillValue"


def shown_axes(volume: Volume) -> tuple[int, ...]:
    """The numbers of the axes (t, z, y, x) that the source has; all where it does not say.

    An axis that was made up has length 1. One axis stays in any case.
    """
    metadata = volume.metadata
    if metadata is None:
        return tuple(range(len(AXES)))
    known = (
        number
        for number, axis in enumerate(AXES)
        if metadata.along(axis) is not None or volume.shape[number] > 1
    )
    return tuple(known) or (0,)


def arrays_beside(
    volume: Volume, level: Level, dimensions: Mapping[str, str], lengths: MutableMapping[str, int]
) -> Iterator[tuple[str, ViewArray]]:
    """Yield the arrays beside the values of a level, with their names.

    Args:
        volume: the volume.
        level: the level; arrays along its axes are cut to its vertices.
        dimensions: name of the dimension of each axis that is shown, by "t", "z", "y" or "x".
        lengths: of the dimensions of the group by name; those of further dimensions are added.
    """
    metadata = volume.metadata
    if metadata is None:
        return
    if level.lod:
        metadata = metadata.cut(
            {
                axis: list(range(n)[level.vertices(number)])
                for number, (axis, n) in enumerate(zip(AXES[1:], volume.shape[1:], strict=True))
            }
        )
    for variable in metadata.variables:
        if variable.name in metadata.dimensions or safe_name(variable.name) != variable.name:
            continue
        values, names = _squeezed(variable, metadata.dimensions, dimensions)
        if values.dtype.kind not in "iuf" or 0 in values.shape or len(set(names)) < len(names):
            continue
        found = dict(zip(names, values.shape, strict=True))
        if any(lengths.get(name, n) != n for name, n in found.items()):
            continue
        lengths.update(found)
        yield variable.name, _array(values, names, variable.attributes)


def positions_along(volume: Volume, axis: str) -> npt.NDArray[Any]:
    """Positions along an axis "t", "z", "y" or "x", in the source's type where that has them."""
    values = volume.coords[axis].values
    metadata = volume.metadata
    name = None if metadata is None else metadata.along(axis)
    stored = None if metadata is None or name is None else metadata.named(name)
    if stored is None or stored.dimensions != (name,) or stored.values.dtype.kind not in "iuf":
        return values
    native = stored.values.astype(stored.values.dtype.newbyteorder("="))
    same = native.shape == values.shape and native.astype(np.float64).tobytes() == values.tobytes()
    return native if same else values


def naming_attributes(raw: Mapping[str, Any], there: Collection[str]) -> dict[str, Any]:
    """Attributes that name other arrays, as far as these are there.

    raw: all attributes of an array. there: names of the arrays beside the values.
    """
    naming = {
        key: text
        for key, text in raw.items()
        if key in (COORDINATES, *NAMING) and isinstance(text, str)
    }
    absent = {name for _, name in references(naming) if name not in there}
    naming = without_names(naming, absent)
    broken = {key for key, name in references(naming) if name in absent}
    return {key: text for key, text in naming.items() if key not in broken}


def _squeezed(
    variable: SourceVariable, axes: Mapping[str, str], dimensions: Mapping[str, str]
) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    """The values without dimensions that the values of the volume do not have, and their names.

    axes: axis of each dimension of the source. dimensions: name in the group of each axis shown.
    """
    values, names = np.asarray(variable.values), []
    for number, name in reversed(list(enumerate(variable.dimensions))):
        if name not in axes:
            names.append(name)
        elif axes[name] in dimensions:
            names.append(dimensions[axes[name]])
        else:
            values = np.take(values, 0, axis=number)
    return np.asarray(values), tuple(reversed(names))


def _array(
    values: npt.NDArray[Any], names: tuple[str, ...], attributes: Mapping[str, Any]
) -> ViewArray:
    native = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("=")).reshape(
        values.shape
    )
    kept = json_attributes(attributes, without=PLUMBING)
    fill = kept.get(FILL)
    if not isinstance(fill, int) or native.dtype.kind == "f":
        # xarray takes `_FillValue` of floats as bits in base64, which no other library does.
        kept.pop(FILL, None)
        if isinstance(fill, int | float):
            kept.setdefault("missing_value", fill)
    return ViewArray(
        shape=native.shape,
        chunk_shape=slab_shape(native.shape, native.dtype.itemsize, CHUNK_BYTES),
        dtype=native.dtype,
        dimension_names=names,
        attributes=kept,
        fill=None,
        read=lambda region: native[region],
        holds=lambda region: True,
    )
