"""Dimensions, variables and attributes of an output of NetCDF or Zarr.

Where the region knows its source, the output has what the source had: its dimensions in their
order, coordinates in their types, auxiliary coordinates, bounds, grid mapping and attributes.
Elsewhere it has the four axes and their coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.series import AXES
from fhash_formats.source_metadata import (
    COORDINATES,
    NO_AXIS,
    SourceMetadata,
    SourceVariable,
    references,
)
from fhash_formats.support.attributes import PACKING, PLUMBING
from fhash_formats.writers.common.labels import (
    coordinate_attributes,
    safe_name,
    safe_names,
    variable_attributes,
)
from fhash_formats.writers.common.region import Region

__all__ = ["Beside", "Outline"]


@dataclass(frozen=True, kw_only=True)
class Outline:
    """An output without its values.

    Attributes:
        name: of the variable.
        dimensions: of the variable in the order of the output, each with its axis or NO_AXIS.
        lengths: of every dimension.
        attributes: of the variable, JSON values or numpy's; no packing.
        variables: the arrays beside it.
        file_attributes: of the file.
    """

    name: str
    dimensions: Mapping[str, str]
    lengths: Mapping[str, int]
    attributes: Mapping[str, Any]
    variables: tuple[SourceVariable, ...]
    file_attributes: Mapping[str, Any]

    @classmethod
    def of(cls, region: Region) -> Outline:
        """The outline of a region."""
        if region.metadata is not None:
            return _as_in_source(region, region.metadata)
        name, names = safe_names(region)
        return cls(
            name=name,
            dimensions={names[axis]: axis for axis in AXES},
            lengths={names[axis]: n for axis, n in zip(AXES, region.shape, strict=True)},
            attributes=variable_attributes(region),
            variables=tuple(_positions(region, axis, names[axis]) for axis in AXES),
            file_attributes={},
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each dimension of the variable."""
        return tuple(self.lengths[name] for name in self.dimensions)

    def ordered(self, by_axis: tuple[int, ...]) -> tuple[int, ...]:
        """Numbers for t, z, y and x, such as a chunk's lengths, in the order of the dimensions."""
        numbers = dict(zip(AXES, by_axis, strict=True))
        return tuple(numbers.get(axis, 1) for axis in self.dimensions.values())

    def place(self, step: int, frame: npt.NDArray[Any]) -> tuple[Any, npt.NDArray[Any]]:
        """The index of a frame (z, y, x) in the variable, and the values that belong there."""
        present = list(self.dimensions.values())
        index = tuple(
            step if axis == "t" else 0 if axis == NO_AXIS else slice(None) for axis in present
        )
        space = [axis for axis in AXES[1:] if axis in present]
        values = frame.reshape(
            [n for axis, n in zip(AXES[1:], frame.shape, strict=True) if axis in present]
        )
        order = [space.index(axis) for axis in present if axis in space]
        return index, values.transpose(order)


@dataclass(frozen=True, kw_only=True)
class Beside:
    """The rest of an output of several variables, each part once.

    Attributes:
        lengths: of every dimension.
        variables: arrays that no outline is of.
        attributes: of the file.
    """

    lengths: Mapping[str, int]
    variables: tuple[SourceVariable, ...]
    attributes: Mapping[str, Any]

    @classmethod
    def of(cls, outlines: Sequence[Outline]) -> Beside:
        """The rest of an output of some variables.

        outlines: of different names. Raises InputError where two do not agree on a length or an
        array: they cannot share an output.
        """
        lengths: dict[str, int] = {}
        variables: dict[str, SourceVariable] = {}
        attributes: dict[str, Any] = {}
        names = [outline.name for outline in outlines]
        for outline in outlines:
            for name, length in outline.lengths.items():
                if lengths.setdefault(name, length) != length:
                    raise _apart(outline, f"{length} of {name}, another {lengths[name]}")
            for each in outline.variables:
                if each.name not in names and not _same(
                    variables.setdefault(each.name, each), each
                ):
                    raise _apart(outline, f"another {each.name} than the one before")
            attributes = {**outline.file_attributes, **attributes}
        return cls(lengths=lengths, variables=tuple(variables.values()), attributes=attributes)


def _same(one: SourceVariable, other: SourceVariable) -> bool:
    """Whether two arrays beside variables have the same dimensions and values."""
    if tuple(one.dimensions) != tuple(other.dimensions):
        return False
    floats = one.values.dtype.kind == other.values.dtype.kind == "f"
    return bool(np.array_equal(one.values, other.values, equal_nan=floats))


def _apart(outline: Outline, what: str) -> InputError:
    return InputError(f"variable {outline.name} has {what}; write the variables one by one")


def _as_in_source(region: Region, metadata: SourceMetadata) -> Outline:
    """The outline of a region whose source is known, with its dimensions and all beside it."""
    name = safe_name(region.name)
    by_axis = dict(zip(AXES, region.shape, strict=True))
    lengths = {each: by_axis.get(axis, 1) for each, axis in metadata.dimensions.items()}
    variables = [each for each in metadata.variables if each.name != name]
    for each, axis in metadata.dimensions.items():
        if axis != NO_AXIS and metadata.named(each) is None and _is_told(region, axis):
            variables.append(_positions(region, axis, each))
    for variable in variables:
        lengths |= dict(zip(variable.dimensions, variable.values.shape, strict=True))
    names = {each.name for each in variables}
    attributes = _without_missing(metadata.variable_attributes, names)
    listed = str(attributes.pop(COORDINATES, "")).split()
    listed += [
        each.name
        for each in variables
        if each.is_coordinate and each.name not in (*listed, *metadata.dimensions)
    ]
    if listed:
        attributes[COORDINATES] = " ".join(listed)
    if region.units:
        attributes["units"] = region.units
    if name != region.name:
        attributes.setdefault("long_name", region.name)
    return Outline(
        name=name,
        dimensions=metadata.dimensions,
        lengths=lengths,
        attributes={key: value for key, value in attributes.items() if key not in PACKING},
        variables=tuple(variables),
        file_attributes=_without_plumbing(metadata.attributes),
    )


def _is_told(region: Region, axis: str) -> bool:
    """Whether positions of an axis tell more than that there are so many."""
    values = region.coords[axis].values
    return not np.array_equal(values, np.arange(values.size))


def _positions(region: Region, axis: str, name: str) -> SourceVariable:
    """The coordinate of an axis as float64."""
    coordinate = region.coords[axis]
    return SourceVariable(
        name=name,
        dimensions=(name,),
        values=coordinate.values,
        attributes=coordinate_attributes(axis, coordinate),
        is_coordinate=True,
    )


def _without_missing(attributes: Mapping[str, Any], names: set[str]) -> dict[str, Any]:
    """Attributes without those that name variables which are not in the output."""
    missing = {key for key, name in references(attributes) if name not in names}
    kept = {key: value for key, value in attributes.items() if key not in missing - {COORDINATES}}
    if COORDINATES in missing:
        kept[COORDINATES] = " ".join(
            name for key, name in references(attributes) if key == COORDINATES and name in names
        )
    return _without_plumbing(kept)


def _without_plumbing(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in attributes.items() if key not in PLUMBING and key}
