"""All that belongs to a variable in its source: found by the CF conventions, read, and bounded.

A variable names its surroundings by attributes: `coordinates`, `grid_mapping`, `bounds` of these,
`formula_terms` and so on (CF 1.11, sections 4, 5, 7 and appendix A). What is small beside it is
kept, too. What is too large, or a field of its own, is left out, and one warning names it.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.errors import FhashWarning
from fhash_formats.readers.cf import Packing, with_times
from fhash_formats.readers.file_series import Request, condense
from fhash_formats.readers.layout import Layout, picks
from fhash_formats.readers.variables import FIELD_DIMENSIONS, Variable
from fhash_formats.series import (
    COORDINATES,
    NO_AXIS,
    Coordinate,
    SourceMetadata,
    SourceVariable,
    is_plain_name,
    references,
    without_names,
)
from fhash_formats.support.values import PLUMBING, UnknownValueError, stored_type, typed_attribute

MAX_ONE = 16 << 20
"""Bytes of one array beside the data: latitudes of 1400^2 vertices as float64."""
MAX_ALL = 64 << 20
"""Bytes of all arrays beside the data."""
MAX_TEXTS = 1 << 14
"""Texts of one array; they stand in the header."""
MAX_ARRAYS = 512
"""Number of arrays beside the data; a reader takes twice as many."""
MAX_TOLD = 12
"""Names in one warning."""
MAX_ATTRIBUTE = 64 << 10
"""Bytes of one attribute as JSON; those of a file stand in the header, too."""
DIGEST_BYTES = 256 << 20
"""Bytes of a file up to which its digest is taken: it is one more reading of the whole file, which
costs little beside an encoding, but minutes where the file lies on a slow disk."""
TEXT_BYTES = 32
"""Bytes that a text is counted as."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """The variable whose surroundings are asked for.

    Attributes:
        source: for messages.
        name: of the variable.
        dimensions: those that are kept, with their axis, or NO_AXIS.
        picked: index along each dimension that the user selected, by name.
        coordinates: names of coordinates that no attribute tells.
        used: names of further variables that are wanted, such as one that gave the positions.
        without: attributes of the variable that do not hold for its values.
        stored: number type of the stored values, where the decoded ones have another.
        path: of the file; None for data in memory.
        digested: whether the digest of the file is taken.
    """

    source: str
    name: str
    dimensions: Mapping[str, str] = field(default_factory=dict)
    picked: Mapping[str, int] = field(default_factory=dict)
    coordinates: Collection[str] = ()
    used: Collection[str] = ()
    without: Collection[str] = ()
    stored: str | None = None
    path: Path | None = None
    digested: bool = True


def kept_dimensions(
    source: str, name: str, layout: Layout, names: Sequence[str], select: Sequence[tuple[str, str]]
) -> tuple[dict[str, str], dict[str, int]]:
    """Dimensions that are kept, with their axis, and the index along those that the user selected.

    A dimension of length 1 that nobody selected along is kept, although it is no axis.

    names: of the dimensions in the file. select: the user's wishes, see `layout.picks`.
    """
    asked = picks(source, name, layout.dimensions, select)
    axes = iter(layout.axes)
    kept, picked = {}, {}
    for place, each in enumerate(names):
        if place in asked:
            picked[each] = asked[place]
        else:
            kept[each] = NO_AXIS if place in layout.picked else next(axes)
    return kept, picked


def named_dimensions(layout: Layout, coords: Mapping[str, Coordinate]) -> list[str]:
    """A name for each dimension of an array; one without a name has that of its axis."""
    axes = iter(layout.axes)
    others = [
        f"dim_{place}" if place in layout.picked else coords[next(axes)].name
        for place in range(len(layout.dimensions))
    ]
    pairs = zip(layout.dimensions, others, strict=True)
    return [other if each.name is None else each.name for each, other in pairs]


def surroundings(
    wanted: Wanted, variables: Mapping[str, Variable], attributes: Mapping[str, Any]
) -> SourceMetadata:
    """All that belongs to a variable; warns (FhashWarning) once, of all that is left out.

    variables: all that the variable can name. attributes: of the file.
    """
    left_out: dict[str, str] = {}
    found = _Collected(wanted, variables, left_out)
    own = variables[wanted.name]
    names = _named(wanted, own, variables, attributes)
    for name, is_coordinate in names.items():
        found.add(name, is_coordinate)
    whole = size_of(own.shape, own.dtype)
    for name, other in variables.items():
        if name in names or set(own.names) <= set(other.names):
            continue  # another field can be encoded itself
        if is_small(size_of(other.shape, other.dtype), whole):
            found.add(name, False)
        elif len(other.shape) < FIELD_DIMENSIONS:
            left_out[name] = "large, and nothing refers to it"
    kept = {key: value for key, value in own.attributes.items() if key not in (*wanted.without, "")}
    of_file = {key: value for key, value in attributes.items() if key != COORDINATES}
    metadata = SourceMetadata(
        dimensions=dict(wanted.dimensions),
        variable_attributes=without_names(
            _storable(kept, f"{wanted.name}:", left_out), left_out.keys()
        ),
        variables=tuple(found.variables),
        attributes=_storable(of_file, ":", left_out),
        stored=wanted.stored,
        file=None if wanted.path is None else wanted.path.name,
        digest=digest_of(wanted.path) if wanted.path is not None and wanted.digested else None,
    )
    warn_left_out(f"{wanted.source}: not everything beside {wanted.name} is kept", left_out)
    return metadata


def warn_left_out(what: str, left_out: Mapping[str, str]) -> None:
    """Warn once (FhashWarning) of all that is left out. left_out: the reason by name."""
    told = [f"{name} ({why})" for name, why in left_out.items()]
    rest = f" and {len(told) - MAX_TOLD} more" if len(told) > MAX_TOLD else ""
    if told:
        warnings.warn(f"{what}: {', '.join(told[:MAX_TOLD])}{rest}", FhashWarning, stacklevel=3)


def metadata_of(
    wanted: Wanted,
    variables: Mapping[str, Variable],
    attributes: Mapping[str, Any],
    layout: Layout,
    request: Request,
    packed: Packing | None,
    time: Coordinate,
) -> SourceMetadata:
    """All that belongs to a variable as it was arranged; see `surroundings`.

    wanted: without dimensions. packed: None where values are read as they are stored. time: of the
    series, which may stand for that of the file.
    """
    name, own = wanted.name, variables[wanted.name]
    kept, picked = kept_dimensions(wanted.source, name, layout, own.names, request.select)
    wanted = replace(
        wanted,
        dimensions=kept,
        picked=picked,
        stored=None if packed is None or packed.stored == packed.dtype else packed.stored.name,
        digested=request.digested,
    )
    selected = replace(own, attributes={**own.attributes, **layout.attributes()})
    found = surroundings(wanted, {**variables, name: selected}, attributes)
    growing = tuple(each for each in own.unlimited if each in found.dimensions)
    return with_times(replace(found, unlimited=growing), time)


def digest_of(path: Path) -> str | None:
    """SHA-256 of a file, hexadecimal; None for a folder and a file above DIGEST_BYTES."""
    if not path.is_file() or path.stat().st_size > DIGEST_BYTES:
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _named(
    wanted: Wanted,
    own: Variable,
    variables: Mapping[str, Variable],
    attributes: Mapping[str, Any],
) -> dict[str, bool]:
    """Names of all that belongs to a variable, in order, and whether each is a coordinate."""
    told = [*own.names, *_coordinates(own.attributes), *wanted.coordinates]
    # a coordinate that belongs to no variable alone, or to another one on the same vertices
    for each in (attributes, *(each.attributes for each in variables.values())):
        for name in _coordinates(each):
            if name in variables and set(variables[name].names) <= set(own.names):
                told.append(name)
    names: dict[str, bool] = {}
    waiting = [*told, *_references(own), *wanted.used]
    for name in waiting:  # which grows
        if name in variables and name != wanted.name and name not in names:
            names[name] = name in told
            waiting += _references(variables[name])
    return names


def _coordinates(attributes: Mapping[str, Any]) -> list[str]:
    text = attributes.get(COORDINATES)
    return text.split() if isinstance(text, str) else []


def _references(stored: Variable) -> list[str]:
    """Names in the attributes of a variable that name others, its coordinates excepted."""
    found = references(stored.attributes, loosely=True)
    return [name for key, name in found if key != COORDINATES]


class _Collected:
    """The arrays beside the data that were read, and what was left out and why."""

    def __init__(
        self, wanted: Wanted, variables: Mapping[str, Variable], left_out: dict[str, str]
    ) -> None:
        self.variables: list[SourceVariable] = []
        self._wanted, self._stored, self._left_out = wanted, variables, left_out
        self._bytes = 0
        own = variables[wanted.name]
        self._lengths = dict(zip(own.names, own.shape, strict=True))

    def add(self, name: str, is_coordinate: bool) -> None:
        """Read a variable, or note why it is left out."""
        stored, picked = self._stored[name], self._wanted.picked
        kept = [n for n, each in enumerate(stored.names) if each not in picked]
        dimensions = tuple(stored.names[n] for n in kept)
        problem = self._problem(dimensions, [stored.shape[n] for n in kept], stored.dtype)
        if not problem:
            try:
                read = stored.read(tuple(picked.get(each, slice(None)) for each in stored.names))
                values = np.asarray(read)
                problem = "" if stored_type(values) else f"values of type {values.dtype}"
            except Exception as error:  # filters and files raise all kinds
                problem = f"cannot be read: {condense(error)}"
        if problem:
            self._left_out[name] = problem
            return
        self._bytes += size_of(values.shape, values.dtype)
        self._lengths |= dict(zip(dimensions, values.shape, strict=True))
        self.variables.append(
            SourceVariable(
                name=name,
                dimensions=dimensions,
                values=values,
                attributes=_storable(stored.attributes, f"{name}:", self._left_out),
                is_coordinate=is_coordinate,
            )
        )

    def _problem(self, names: Sequence[str], shape: Sequence[int], dtype: np.dtype[Any]) -> str:
        """Why an array is left out, as far as is known before it is read; "" if it is not."""
        size = size_of(shape, dtype)
        pairs = zip(names, shape, strict=True)
        if len(set(names)) < len(names):
            return "its dimensions have no form in all formats"
        if len(self.variables) == MAX_ARRAYS:
            return f"more than {MAX_ARRAYS} arrays"
        if 0 in shape or any(self._lengths.get(each, length) != length for each, length in pairs):
            return "its dimensions do not fit"
        if dtype.kind not in "iufSUTO" or dtype.itemsize > 1 << 16:
            return f"values of type {dtype}"
        # of a plane, latitude and longitude have all dimensions
        if len(self._wanted.dimensions) > 2 and set(self._wanted.dimensions) <= set(names):
            return "a field of its own: it has all dimensions of the variable"
        if dtype.kind in "SUTO" and prod(shape) > MAX_TEXTS:
            return f"{prod(shape)} texts; {MAX_TEXTS} are kept"
        if size > MAX_ONE:
            return f"{size / 2**20:.0f} MiB; {MAX_ONE >> 20} are kept"
        if self._bytes + size > MAX_ALL:
            return f"all together are more than {MAX_ALL >> 20} MiB"
        return ""


def is_small(size: int, whole: int) -> bool:
    """Whether an array is kept beside a variable that nothing ties it to; both in bytes.

    It has less than a hundredth of its bytes, or than a KiB.
    """
    return size < max(whole / 100, 1 << 10)


def size_of(shape: Sequence[int], dtype: np.dtype[Any]) -> int:
    """Bytes of an array, of texts approximately."""
    return prod(shape) * (TEXT_BYTES if dtype.kind in "UTO" else dtype.itemsize)


def _storable(
    attributes: Mapping[str, Any], prefix: str, left_out: dict[str, str]
) -> dict[str, Any]:
    """The attributes that a container holds; the others are noted."""
    found = {}
    for key, value in attributes.items():
        if key in PLUMBING:
            continue
        try:
            size = len(json.dumps(typed_attribute(value)))
        except UnknownValueError:
            left_out[f"{prefix}{key}"] = "a value of no known type"
            continue
        if size > MAX_ATTRIBUTE or not is_plain_name(key):
            left_out[f"{prefix}{key}"] = f"{size} bytes" if is_plain_name(key) else "its name"
            continue
        found[key] = value
    return found
