"""All that belongs to the variable of a series of many files.

What has no time must be the same in all files; what has one is joined. Anything else is left out,
and one warning names it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.readers.common.surroundings import warn_left_out
from fhash_formats.series import Coordinate
from fhash_formats.source_metadata import (
    SourceMetadata,
    SourceVariable,
    is_plain_name,
    without_names,
)
from fhash_formats.support.attributes import PACKING
from fhash_formats.support.typed_values import typed_attribute

__all__ = ["joined_metadata"]

DIFFERS = "differs between the files"


def joined_metadata(
    source: str, parts: Iterable[SourceMetadata | None], time: Coordinate
) -> SourceMetadata | None:
    """The metadata of files one after the other; None where some file says nothing.

    source: the pattern of the files. time: of all steps. Warns (FhashWarning) of what is left out.
    """
    collected: _Joined | None = None
    for part in parts:
        if part is None:
            return None
        if collected is None:
            collected = _Joined(part, time)
        else:
            collected.add(part)
    if collected is None:
        return None
    metadata = collected.result(Path(source).name)
    warn_left_out(f"{source}: not everything beside the values is kept", collected.left_out)
    return metadata


class _Joined:
    """The metadata of some files, as far as they were added."""

    def __init__(self, first: SourceMetadata, time: Coordinate) -> None:
        self.left_out: dict[str, str] = {}
        self._first, self._time = first, time
        self._along = first.along("t")
        self._attributes = dict(first.attributes)
        self._own, self._stored = dict(first.variable_attributes), first.stored
        self._pieces = {each.name: [each] for each in first.variables}

    def add(self, part: SourceMetadata) -> None:
        """Add the next file."""
        if part.dimensions != self._first.dimensions:
            self.left_out["dimensions"] = DIFFERS
        for name, value in list(self._attributes.items()):
            if name != "history" and not _same_attribute(value, part.attributes.get(name)):
                del self._attributes[name]
                self.left_out[f":{name}"] = DIFFERS
        self._add_own(part)
        for name, pieces in list(self._pieces.items()):
            other = part.named(name)
            if other is None or not self._fits(pieces[0], other):
                del self._pieces[name]
                self.left_out[name] = DIFFERS
            elif self._has_time(other):
                pieces.append(other)

    def _add_own(self, part: SourceMetadata) -> None:
        """Keep the attributes of the variable that the next file has, too; a packing as a whole."""
        there = part.variable_attributes
        for name in [*self._own, *sorted(PACKING & (there.keys() - self._own.keys()))]:
            if not _same_attribute(self._own.get(name), there.get(name)):
                self._own.pop(name, None)
                self.left_out[name] = DIFFERS
        if PACKING & self.left_out.keys():
            for name in sorted(PACKING & self._own.keys()):
                del self._own[name]
                self.left_out[name] = f"of a packing that {DIFFERS}"
            self._stored = None
        elif part.stored != self._stored:
            self._stored = None

    def result(self, file: str) -> SourceMetadata:
        """The metadata of all files."""
        name = self._along or self._time.name
        dimensions = dict(self._first.dimensions)
        if self._along is None:
            if name in dimensions or not is_plain_name(name):
                name = "time_of_file"
            dimensions = {name: "t", **dimensions}
        stamped = self._time_variable(name)
        # bounds of times that each file counts in its own way mean nothing together
        lost = {str(each) for each in self._lost_with(stamped)}
        variables = [stamped]
        for each, pieces in self._pieces.items():
            if each != stamped.name and each not in lost:
                variables.append(_concatenated(pieces, self._along))
        self.left_out |= dict.fromkeys(lost & self._pieces.keys(), DIFFERS)
        kept = {each.name for each in variables}
        gone = {each.name for each in self._first.variables} - kept
        return replace(
            self._first,
            dimensions=dimensions,
            variables=tuple(variables),
            variable_attributes=without_names(self._own, gone),
            stored=self._stored,
            attributes=self._attributes,
            file=file,
            digest=None,
        )

    def _time_variable(self, dimension: str) -> SourceVariable:
        """The times of all steps, in the type of the first file where that holds them."""
        first = self._first.named(self._time.name)
        values: Any = self._time.values
        if first is None or first.attributes.get("units") != self._time.attributes.get("units"):
            # the numbers of the steps stand for times, as some file has none
            return SourceVariable(
                name=dimension,
                dimensions=(dimension,),
                values=values,
                attributes=dict(self._time.attributes),
                is_coordinate=True,
            )
        self.left_out.pop(first.name, None)
        if first.values.dtype.kind in "iuf":
            with np.errstate(over="ignore", invalid="ignore"):
                narrow = values.astype(first.values.dtype)
            values = narrow if np.array_equal(narrow.astype(np.float64), values) else values
        return replace(first, dimensions=(dimension,), values=values)

    def _lost_with(self, time: SourceVariable) -> list[Any]:
        """Names of the bounds of the times, unless all files count these in the same way."""
        pieces = self._pieces.get(time.name)
        if pieces is not None and self._along is not None:
            return []
        return [time.attributes[key] for key in ("bounds", "climatology") if key in time.attributes]

    def _has_time(self, variable: SourceVariable) -> bool:
        return self._along is not None and self._along in variable.dimensions

    def _fits(self, one: SourceVariable, other: SourceVariable) -> bool:
        """Whether two files have the same array, or two pieces of one along time."""
        if one.dimensions != other.dimensions or one.values.dtype != other.values.dtype:
            return False
        if not _same_attributes(one.attributes, other.attributes):
            return False
        if not self._has_time(one):
            return one.values.shape == other.values.shape and (
                one.values.tolist() == other.values.tolist()
                if one.values.dtype == object
                else one.values.tobytes() == other.values.tobytes()
            )
        shapes = [
            [
                n
                for name, n in zip(each.dimensions, each.values.shape, strict=True)
                if name != self._along
            ]
            for each in (one, other)
        ]
        return shapes[0] == shapes[1]


def _concatenated(pieces: list[SourceVariable], along: str | None) -> SourceVariable:
    """An array of all files."""
    first = pieces[0]
    if len(pieces) == 1 or along is None:
        return first
    axis = first.dimensions.index(along)
    return replace(first, values=np.concatenate([each.values for each in pieces], axis=axis))


def _same_attributes(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    return one.keys() == other.keys() and all(
        _same_attribute(value, other[name]) for name, value in one.items()
    )


def _same_attribute(one: Any, other: Any) -> bool:
    return json.dumps(typed_attribute(one)) == json.dumps(typed_attribute(other))
