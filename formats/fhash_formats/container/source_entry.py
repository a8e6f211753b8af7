"""The header's `source` and the arrays `auxiliary/...`: read and checked, and written.

FORMAT.md, Source metadata, is the norm. A coordinate that has the bits of a container's own is
not stored again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import MAX_DIMENSIONS
from fhash_formats.container.record import MAX_LENGTH, Record
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.series import (
    AXES,
    AXIS_NAMES,
    NO_AXIS,
    Coordinate,
    SourceMetadata,
    SourceVariable,
    is_plain_name,
)
from fhash_formats.support.values import (
    DTYPES,
    MAX_BYTES,
    UnknownValueError,
    attribute_value,
    inline_array,
    inline_values,
    stored_type,
    type_of_name,
    typed_attribute,
)

SOURCE = "source"
"""Key of the header."""
AUXILIARY = "auxiliary/"
"""Prefix of the arrays."""
MAX_VARIABLES = 1024
"""Arrays beside the data that a reader takes."""
MAX_FURTHER = 16
"""Dimensions of the variable: four axes, and others of length 1."""


class Readable(Protocol):
    """An array of a container, as far as it is needed here."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each axis."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the numbers."""

    @property
    def attributes(self) -> Mapping[str, Any]:
        """Attributes, as JSON values."""


@dataclass(frozen=True, kw_only=True)
class _Entry:
    """One array beside the data, checked: where its values are, and all else."""

    name: str
    dimensions: tuple[str, ...]
    shape: tuple[int, ...]
    type_name: str
    attributes: Mapping[str, Any]
    is_coordinate: bool
    axis: str | None = None
    array: str | None = None
    values: npt.NDArray[Any] | None = None


class _Room:
    """The bytes that all arrays and attributes beside the data may take, decoded.

    Attributes:
        left: those that are not taken yet.
    """

    def __init__(self) -> None:
        self.left = MAX_BYTES

    def take(self, size: int) -> None:
        """Take some bytes; raises DamagedFileError where there are no more."""
        self.left -= size
        if self.left < 0:
            raise DamagedFileError(
                f"header key {SOURCE}: its values take more than {MAX_BYTES} bytes"
            )


def check_source(header: Mapping[str, Any], arrays: Mapping[str, Readable]) -> None:
    """Check the header's `source` and its arrays; raises DamagedFileError that names the key."""
    if SOURCE in header:
        _parsed(header, arrays, _Room())


def read_metadata(
    header: Mapping[str, Any], arrays: Mapping[str, Any], coords: Mapping[str, Coordinate]
) -> SourceMetadata | None:
    """The source of a container that `check_source` passed; None where it says nothing.

    arrays: StoredArray by name. coords: those of the container.
    """
    if SOURCE not in header:
        return None
    room = _Room()
    dimensions, entries = _parsed(header, arrays, room)
    entry = header[SOURCE]
    variables = []
    for each in entries:
        if each.values is not None:
            values = each.values
        elif each.axis is not None:
            values = narrowed(coords[each.axis].values, type_of_name(each.type_name))
        else:
            values = arrays[f"{AUXILIARY}{each.array}"].read()
        variables.append(
            SourceVariable(
                name=each.name,
                dimensions=each.dimensions,
                values=values.reshape(each.shape),
                attributes=each.attributes,
                is_coordinate=each.is_coordinate,
            )
        )
    return SourceMetadata(
        dimensions=dimensions,
        variable_attributes=_changed(
            entry.get("variable", {}), header["variable"]["attributes"], _Room()
        ),
        variables=tuple(variables),
        attributes=_changed(entry.get("attributes", {}), {}, _Room()),
        stored=entry.get("stored"),
        file=entry.get("file"),
        digest=entry.get("digest"),
        unlimited=tuple(entry.get("unlimited", ())),
    )


def _parsed(
    header: Mapping[str, Any], arrays: Mapping[str, Readable], room: _Room
) -> tuple[dict[str, str], list[_Entry]]:
    """The dimensions of the variable, and the arrays beside it, all checked."""
    top = Record(header, "header key ").record(SOURCE)
    names = _coordinate_names(header)
    dimensions = _dimensions(top, names)
    by_axis = dict(zip(AXES, header["domain"]["shape"], strict=True))
    for axis, length in by_axis.items():
        made_up = axis not in dimensions.values()
        top.need(not made_up or length == 1, "dimensions", f"axis {axis}, of length {length}")
    lengths = {name: by_axis.get(axis, 1) for name, axis in dimensions.items()}
    for name, length in _lengths(top).items():
        top.need(name not in lengths, "lengths", "other names than those of dimensions")
        lengths[name] = length
    for key in ("file", "digest", "date"):
        if top.has(key):
            top.text(key)
    if top.has("unlimited"):
        known = set(top.texts("unlimited")) <= set(dimensions)
        top.need(known, "unlimited", "names of dimensions")
    if top.has("stored"):
        top.choice("stored", tuple(DTYPES))
    _changed(header[SOURCE].get("variable", {}), header["variable"]["attributes"], room)
    _changed(header[SOURCE].get("attributes", {}), {}, room)
    records = top.records("variables") if top.has("variables") else []
    top.need(len(records) <= MAX_VARIABLES, "variables", f"at most {MAX_VARIABLES} of them")
    entries: list[_Entry] = []
    taken = {header["variable"]["name"]}
    for record in records:
        entry = _entry(record, header, arrays, names, dimensions, lengths, room)
        record.need(entry.name not in taken, "name" if record.has("name") else "axis", "one only")
        if entry.axis is None:
            room.take(prod(entry.shape) * type_of_name(entry.type_name).itemsize)
        taken.add(entry.name)
        entries.append(entry)
    return dimensions, entries


def _coordinate_names(header: Mapping[str, Any]) -> dict[str, str]:
    """Name of each axis in the source."""
    described = header.get("coordinates", {})
    return {
        axis: str(described.get(stored, {}).get("name", stored))
        for axis, stored in AXIS_NAMES.items()
    }


def _dimensions(top: Record, names: Mapping[str, str]) -> dict[str, str]:
    """Dimensions of the variable with their axes, in the source's order."""
    listed = top.get("dimensions")
    top.need(isinstance(listed, list) and len(listed) <= MAX_FURTHER, "dimensions", "a short list")
    found: dict[str, str] = {}
    for each in listed:
        pair = [names[each], each] if isinstance(each, str) and each in AXES else each
        top.need(
            isinstance(pair, list)
            and len(pair) == 2
            and pair[1] in (*AXES, NO_AXIS)
            and (is_plain_name(pair[0]) or pair is not each),
            "dimensions",
            "axes t, z, y, x, or pairs [name, axis]",
        )
        name, axis = pair
        again = name in found or (axis != NO_AXIS and axis in found.values())
        top.need(not again, "dimensions", "each name and axis once")
        found[name] = axis
    return found


def _lengths(top: Record) -> dict[str, int]:
    """Lengths of further dimensions, those of arrays beside the data alone."""
    if not top.has("lengths"):
        return {}
    top.record("lengths")
    lengths: dict[str, Any] = top.get("lengths")
    for name, length in lengths.items():
        good = is_plain_name(name) and type(length) is int and 1 <= length <= MAX_LENGTH
        top.need(good, "lengths", "whole numbers from 1 by name of a dimension")
    return lengths


def _entry(
    record: Record,
    header: Mapping[str, Any],
    arrays: Mapping[str, Readable],
    names: Mapping[str, str],
    dimensions: Mapping[str, str],
    lengths: Mapping[str, int],
    room: _Room,
) -> _Entry:
    """One entry of `variables`, checked."""
    axis = record.choice("axis", AXES) if record.has("axis") else None
    name = record.text("name") if record.has("name") or axis is None else names[axis]
    record.need(is_plain_name(name) or not record.has("name"), "name", "a plain name")
    own = next((key for key, each in dimensions.items() if each == axis), None)
    default = [own] if axis is not None and own is not None else []
    along = record.texts("dimensions") if record.has("dimensions") else default
    known = all(each in lengths for each in along) and len(set(along)) == len(along)
    record.need(known and len(along) <= MAX_DIMENSIONS, "dimensions", "known dimensions, once each")
    shape = tuple(lengths[each] for each in along)
    kind = record.text("dtype") if record.has("dtype") else "float64"
    dtype = type_of_name(kind)
    base: Mapping[str, Any] = {}
    array, values = None, None
    if axis is not None:
        length = header["domain"]["shape"][AXES.index(axis)]
        record.need(kind in DTYPES and prod(shape) == length, "axis", f"numbers, {length} of them")
        base = _base_attributes(header, axis) if name == names[axis] else {}
    elif record.has("array"):
        array = record.text("array")
        _check_array(array, arrays, shape or (1,), dtype)
    else:
        try:
            values = inline_array(record.get("values"), kind, shape, room.left)
        except DamagedFileError as error:
            raise DamagedFileError(f"header key {SOURCE}.variables: {name}: {error}") from error
    if record.has("coordinate"):
        record.need(isinstance(record.get("coordinate"), bool), "coordinate", "true or false")
    return _Entry(
        name=name,
        dimensions=tuple(along),
        shape=shape,
        type_name=kind,
        attributes=_changed(
            record.get("attributes") if record.has("attributes") else {}, base, room
        ),
        is_coordinate=record.get("coordinate") if record.has("coordinate") else axis is not None,
        axis=axis,
        array=array,
        values=values,
    )


def _check_array(
    place: str, arrays: Mapping[str, Readable], shape: Sequence[int], dtype: np.dtype[Any]
) -> None:
    name = f"{AUXILIARY}{place}"
    if name not in arrays:
        raise DamagedFileError(f"array {name} is missing")
    array = arrays[name]
    if array.shape != tuple(shape) or array.dtype != dtype:
        raise DamagedFileError(
            f"array {name} is {array.dtype} {array.shape}; the header asks for {dtype}"
            f" {tuple(shape)}"
        )


def _base_attributes(header: Mapping[str, Any], axis: str) -> Mapping[str, Any]:
    """Attributes of the coordinate of an axis."""
    described = header.get("coordinates", {}).get(AXIS_NAMES[axis], {})
    found: Mapping[str, Any] = described.get("attributes", {})
    return found


def narrowed(positions: npt.NDArray[np.float64], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Positions in another type, which holds them where the file is sound."""
    with np.errstate(over="ignore", invalid="ignore"):
        return positions.astype(dtype)


def _changed(changes: object, base: Mapping[str, Any], room: _Room) -> dict[str, Any]:
    """Attributes of a base, with some of them changed, added or, where null, left out."""
    if not isinstance(changes, Mapping):
        raise DamagedFileError(f"header key {SOURCE}: attributes are no object")
    found = {}
    for name, value in base.items():
        if name not in changes:
            found[name] = _natural(value, room)
    for name, value in changes.items():
        if value is None:
            continue
        if not is_plain_name(name):
            raise DamagedFileError(f"header key {SOURCE}: attribute {ascii(name)[:40]} has no name")
        found[name] = attribute_value(value, room.left)
        room.take(getattr(found[name], "nbytes", 0))
    return found


def _natural(value: Any, room: _Room) -> Any:
    """An attribute of a coordinate or variable of the header, which may be any JSON value."""
    try:
        found = attribute_value(value, room.left)
    except DamagedFileError:
        return value
    room.take(getattr(found, "nbytes", 0))
    return found


MAX_INLINE = 256
"""Values of an array that is written into the header. One of its own takes some 450 bytes more."""
_PLAIN = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,99}")


def describe_metadata(
    metadata: SourceMetadata,
    coords: Mapping[str, Coordinate],
    attributes: Mapping[str, Any],
) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """The header's `source`, and the arrays by name that belong to it.

    coords: those of the container, for "t", "z", "y" and "x". attributes: `variable.attributes` of
    the header; only what differs from them is written. Raises InputError for an attribute or array
    that no container holds.
    """
    names = {axis: coords[axis].name for axis in AXES}
    entry: dict[str, Any] = {
        "dimensions": [
            axis if axis and names[axis] == name else [name, axis]
            for name, axis in metadata.dimensions.items()
        ]
    }
    own = set(metadata.dimensions)
    lengths = {
        name: length
        for variable in metadata.variables
        for name, length in zip(variable.dimensions, variable.values.shape, strict=True)
        if name not in own
    }
    arrays: dict[str, npt.NDArray[Any]] = {}
    described = [_described(variable, metadata, coords, arrays) for variable in metadata.variables]
    optional = {
        "lengths": lengths,
        "unlimited": list(metadata.unlimited),
        "variables": described,
        "variable": _difference(metadata.variable_attributes, attributes),
        "attributes": _difference(metadata.attributes, {}),
        "stored": metadata.stored,
        "file": metadata.file,
        "digest": metadata.digest,
    }
    return entry | {key: value for key, value in optional.items() if value}, arrays


def _described(
    variable: SourceVariable,
    metadata: SourceMetadata,
    coords: Mapping[str, Coordinate],
    arrays: dict[str, npt.NDArray[Any]],
) -> dict[str, Any]:
    """One entry of `variables`; an array that needs one of its own is added to `arrays`."""
    kind = stored_type(variable.values)
    if kind is None:
        raise InputError(f"{variable.name}: values of type {variable.values.dtype} have no form")
    values = variable.values if kind not in DTYPES else variable.values.astype(DTYPES[kind])
    axis = _same_positions(variable, values, metadata, coords) if kind in DTYPES else None
    if axis is not None:
        same = coords[axis].name == variable.name
        entry: dict[str, Any] = {"axis": axis} | ({} if same else {"name": variable.name})
        base = coords[axis].attributes if same else {}
        if variable.dimensions != (metadata.along(axis),):
            entry["dimensions"] = list(variable.dimensions)
    else:
        entry, base = {"name": variable.name}, {}
        if variable.dimensions:
            entry["dimensions"] = list(variable.dimensions)
        listed = inline_values(values, kind) if _fits_header(values) else None
        if listed is None:
            stored = np.atleast_1d(values)
            equal = [name for name, array in arrays.items() if _same_bits(array, stored)]
            place = variable.name if _PLAIN.fullmatch(variable.name) else "variable"
            while AUXILIARY + place in arrays and not equal:
                place += "_"
            entry["array"] = equal[0].removeprefix(AUXILIARY) if equal else place
            arrays.setdefault(AUXILIARY + entry["array"], stored)
        else:
            entry["values"] = listed
    if kind != "float64":
        entry["dtype"] = kind
    if variable.is_coordinate != (axis is not None):
        entry["coordinate"] = variable.is_coordinate
    changed = _difference(variable.attributes, base)
    return entry | ({"attributes": changed} if changed else {})


def _same_bits(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> bool:
    """Whether two arrays have the same type, shape and bits."""
    alike = one.dtype == other.dtype and one.shape == other.shape
    return alike and one.tobytes() == other.tobytes()


def _fits_header(values: npt.NDArray[Any]) -> bool:
    """Whether values stand in the header: few of them, and texts in any case."""
    return values.size <= MAX_INLINE or values.dtype.kind not in "iuf"


def _same_positions(
    variable: SourceVariable,
    values: npt.NDArray[Any],
    metadata: SourceMetadata,
    coords: Mapping[str, Coordinate],
) -> str | None:
    """The axis whose positions are these values in every bit; None where there is none."""
    for axis in AXES:
        positions = coords[axis].values
        along = variable.dimensions == (metadata.along(axis),)
        scalar = variable.dimensions == () and coords[axis].name == variable.name
        if not (along or scalar) or values.size != positions.size:
            continue
        if values.dtype.kind in "iu" and not np.isfinite(positions).all():
            continue
        same = values.reshape(-1).astype(np.float64).tobytes() == positions.tobytes()
        if same and narrowed(positions, values.dtype).tobytes() == values.tobytes():
            return axis
    return None


def _difference(attributes: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes that a base of JSON values has not, or not so; null for those to be left out."""
    found: dict[str, Any] = {name: None for name in base if name not in attributes}
    for name, value in attributes.items():
        try:
            typed = typed_attribute(value)
        except UnknownValueError as error:
            raise InputError(f"attribute {name} has a value that cannot be stored") from error
        if name not in base or json.dumps(base[name]) != json.dumps(typed):
            found[name] = typed
    return found
