"""NRRD (.nrrd, .nhdr): a text header, and values in the same file or in others.

Source: teem.sourceforge.net/nrrd/format.html, NRRD0001 to NRRD0005. Encodings are raw, gzip, bzip2
and text. `kinds` say which axis is time and which one holds components. Positions come from `space
origin` and `space directions`, else from `axis mins` and `spacings`. Files of this project also
hold every coordinate exactly, as `coordinates_AXIS:=...`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.failures import Stamp, naming
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.grid import (
    axis_steps,
    component_by_number,
    component_variables,
    lattice,
)
from fhash_formats.readers.common.nrrd_header import (
    MAGIC,
    MAX_HEADER,
    Fields,
    directions_of,
    dtype_of,
    number_of,
    read_header,
    sizes_of,
    vectors,
    whole,
    words_of,
)
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.roles import role_of_name
from fhash_formats.readers.common.stored_bytes import (
    MAX_FILES,
    CompressedFile,
    NumbersInText,
    PlainFile,
    StoredArray,
    StoredBytes,
    in_files,
    numbered_files,
)
from fhash_formats.readers.common.variables import choose
from fhash_formats.series import AXES, AXIS_NAMES, Coordinate

SUFFIXES = (".nrrd", ".nhdr")


SPATIAL = ("domain", "space", "none", "???")
"""Kinds of axes that are positions, or say nothing."""

COLOURS = ("RGB-color", "RGBA-color", "HSV-color", "XYZ-color")


def matches(head: bytes, path: Path) -> bool:
    """Whether this is NRRD."""
    return head.startswith(MAGIC)


def open_nrrd(path: Path, request: Request) -> FileSeries:
    """Open the series in a NRRD file or behind a NRRD header.

    Raises InputError for colours, turned grids, more than four dimensions, and files that are cut;
    MissingInputError for a file of values that is not there.
    """
    source, stamp = str(path), Stamp.of(path)
    with naming(source):
        fields, pairs, end = read_header(path)
        sizes = sizes_of(fields)
        kinds = words_of(fields, "kinds", len(sizes), "domain")
        axes, vector = _axes(fields, pairs, sizes, kinds)
        dtype = dtype_of(fields)
        name = _content(fields, path)
        values = component_variables(
            name,
            1 if vector is None else sizes[vector],
            tuple(length for place, length in enumerate(sizes) if place != vector)[::-1],
            dtype,
            None,
        )
        var = component_by_number(request.var, values)
        variable = choose(source, values, var, booleans=request.booleans)
        _, component = variable.handle
        stored, files = _stored(path, fields, end, sizes, dtype, request)
        array = StoredArray(path, tuple(reversed(sizes)), dtype, stored)
        coords = _coordinates(fields, pairs, sizes, axes)
    slow = tuple(axis for axis in reversed(axes) if axis)
    if request.axes is not None and request.axes != slow:
        if len(request.axes) != len(slow):
            raise InputError(
                f"{source}: --axes {','.join(request.axes)} names {len(request.axes)} axes, the"
                f" array has {len(slow)}, the slowest first"
            )
        slow, coords = request.axes, {}

    def fetch(ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        if vector is None:
            return array.read(ranges)
        place = len(sizes) - 1 - vector
        all_of_it = slice(0, sizes[vector])
        read = array.read((*ranges[:place], all_of_it, *ranges[place:]))
        values: npt.NDArray[Any] = read.take(component, axis=place)
        return values

    units = fields.get("sample units", "").strip('" ')
    return FileSeries(
        source=source,
        name=variable.name,
        shape=variable.shape,
        dtype=dtype,
        axes=slow,
        fetch=fetch,
        stamp=stamp,
        coords=coords,
        attributes={"units": units} if units else {},
        close=stored.close,
        beside=files,
    )


def _axes(
    fields: Fields, pairs: Mapping[str, str], sizes: Sequence[int], kinds: Sequence[str]
) -> tuple[list[str], int | None]:
    """The axis of each dimension (fastest first), "" for components, and where those are.

    The file's kinds, labels and space directions say which dimension is time or components; the
    others are x, y and z in their order.
    """
    directions = directions_of(fields, len(sizes))
    axes = [""] * len(sizes)
    vector = None
    labels = re.findall(r'"((?:[^"\\]|\\.)*)"', fields.get("labels", ""))
    space = fields.get("space", "")
    for place, kind in enumerate(kinds):
        label = labels[place] if len(labels) == len(sizes) else ""
        if kind in COLOURS:
            raise InputError(f"its values are colours ({kind}); one number a vertex can be read")
        named = kind in (*SPATIAL, "list") and role_of_name(label) == "t"
        if kind == "time" or named or (kind == "list" and place == 3 and vector is None):
            axes[place] = "t"
        elif kind not in SPATIAL or (directions is not None and directions[place] is None):
            last_time = place == len(sizes) - 1 and (space.endswith("time") or kind in SPATIAL)
            if last_time and len(sizes) == 4:
                axes[place] = "t"
            elif vector is None:
                vector = place
            else:
                raise InputError(f"two of its dimensions hold components (kinds {' '.join(kinds)})")
    free = [place for place in range(len(sizes)) if not axes[place] and place != vector]
    letters = [axis for axis in ("x", "y", "z", "t") if axis not in axes]
    if len(free) > len(letters) or axes.count("t") > 1:
        raise InputError(
            f"its sizes {' '.join(map(str, sizes))} with the kinds {' '.join(kinds)} are more than"
            " time, z, y and x"
        )
    for place, axis in zip(free, letters, strict=False):
        axes[place] = axis
    return axes, vector


def _content(fields: Fields, path: Path) -> str:
    return fields.get("content", "").strip('" ') or path.stem


def _stored(
    path: Path,
    fields: Fields,
    end: int,
    sizes: Sequence[int],
    dtype: np.dtype[Any],
    request: Request,
) -> tuple[StoredBytes, list[Path]]:
    """The bytes of the values, and the other files that hold them."""
    size = prod(sizes) * dtype.itemsize
    if "data file" not in fields:
        return _one_file(path, fields, end, size, dtype), []
    files = _data_files(path, fields, sizes)
    request.require_inside(path, *files)
    stored = in_files(files, size, lambda file, part: _one_file(file, fields, 0, part, dtype))
    return stored, list(dict.fromkeys(files))


def _data_files(path: Path, fields: Fields, sizes: Sequence[int]) -> list[Path]:
    """The files of values: one, a list, or a pattern with its first and last number and stride."""
    text = fields["data file"]
    words = text.split() or [""]
    if words[:1] == ["LIST"]:
        listed = fields.get("list", "")
        if listed.count("\n") > MAX_FILES:
            raise InputError(f"its list is longer than {MAX_FILES} files")
        names = [line.strip() for line in listed.splitlines() if line.strip()]
        if not names:
            raise InputError("its list of files is empty")
        return [path.parent / name for name in names]
    if "%" in words[0] and len(words) in (4, 5):
        return numbered_files(path.parent, words[0], words[1:4], prod(sizes))
    return [path.parent / text]


def _one_file(
    path: Path, fields: Fields, start: int, size: int, dtype: np.dtype[Any]
) -> StoredBytes:
    """The bytes of one file, from `start` or what the header skips."""
    encoding = fields.get("encoding", "").lower()
    skip = whole(fields, "byte skip")
    start = _after_lines(path, start, whole(fields, "line skip"))
    if encoding == "raw":
        place = path.stat().st_size - size if skip == -1 else start + skip
        return PlainFile(path, start=place, size=size)
    if skip < 0:
        raise InputError("a byte skip of -1 belongs to the encoding raw")
    if encoding in ("txt", "text", "ascii"):
        return NumbersInText(path, dtype, start=start + skip, size=size)
    kind = {"gz": "deflate", "gzip": "deflate", "bz2": "bzip2", "bzip2": "bzip2"}.get(encoding)
    if kind is None:
        raise InputError(f"its encoding is {encoding!r}; raw, gzip, bzip2 and text can be read")
    if skip:
        raise InputError("it skips decompressed bytes, which is not supported")
    return CompressedFile(path, kind, start=start, size=size)


def _after_lines(path: Path, start: int, lines: int) -> int:
    if lines < 1:
        return start
    with path.open("rb") as file:
        file.seek(start)
        for _ in range(lines):
            if not file.readline(MAX_HEADER):
                raise InputError(f"{path} has fewer than the {lines} lines to skip")
        return file.tell()


def _coordinates(
    fields: Fields,
    pairs: Mapping[str, str],
    sizes: Sequence[int],
    axes: Sequence[str],
) -> dict[str, Coordinate]:
    """Coordinates of the axes that the header places."""
    coords = _even(fields, sizes, axes)
    units = re.findall(r'"([^"]*)"', fields.get("units", ""))
    if not units:  # those of space count no other dimension
        units = re.findall(r'"([^"]*)"', fields.get("spaceunits", ""))
        units += [""] * (len(sizes) - len(units))
    for axis, unit in zip(axes, units, strict=False):
        if axis in coords and unit:
            coords[axis] = replace(coords[axis], attributes={"units": unit})
    for axis in AXES:
        length = sizes[axes.index(axis)] if axis in axes else 1
        if f"coordinates_{axis}" in pairs:
            coords[axis] = _exact(pairs, axis, length)
    return coords


def _exact(pairs: Mapping[str, str], axis: str, length: int) -> Coordinate:
    """A coordinate that a file of this project lists, with its name and units."""
    try:
        values = np.array([float(word) for word in pairs[f"coordinates_{axis}"].split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (length,):
        raise InputError(f"coordinates_{axis} are not {length} numbers")
    extra = {
        key: pairs[f"{key}_{axis}"] for key in ("units", "calendar") if f"{key}_{axis}" in pairs
    }
    return Coordinate(
        name=pairs.get(f"name_{axis}") or AXIS_NAMES[axis], values=values, attributes=extra
    )


def _even(fields: Fields, sizes: Sequence[int], axes: Sequence[str]) -> dict[str, Coordinate]:
    """Coordinates from directions and origin, else from spacings and minima."""
    coords: dict[str, Coordinate] = {}
    directions = directions_of(fields, len(sizes))
    count = len(sizes)
    spacings = [number_of(word) for word in words_of(fields, "spacings", count, "nan")]
    minima = [number_of(word) for word in words_of(fields, "axis mins", count, "nan")]
    centred = [word == "cell" for word in words_of(fields, "centerings", count, "???")]
    for place, axis in enumerate(axes):
        if axis and (np.isfinite(spacings[place]) or np.isfinite(minima[place])):
            step = spacings[place] if np.isfinite(spacings[place]) else 1.0
            origin = minima[place] if np.isfinite(minima[place]) else 0.0
            first = 0.5 if centred[place] and np.isfinite(minima[place]) else 0.0
            coords[axis] = lattice(axis, origin, step, sizes[place], first=first)
    if directions is None:
        return coords
    placed = [(axes[place], each) for place, each in enumerate(directions) if each is not None]
    matrix = np.array([each for _, each in placed if len(each) == len(placed)])
    if matrix.shape != (len(placed), len(placed)):
        raise InputError(f"its space directions {fields['space directions']!r} fit no grid")
    order = sorted(range(len(placed)), key=lambda number: "xyzt".find(placed[number][0]))
    steps = axis_steps(matrix[order])
    origins = (vectors(fields.get("space origin", "")) or [None])[0] or (0.0,) * len(placed)
    if len(origins) != len(placed):
        raise InputError(f"its space origin {fields['space origin']!r} fits no grid")
    for number, step, origin in zip(order, steps, origins, strict=True):
        axis = placed[number][0]
        coords[axis] = lattice(axis, float(origin), float(step), sizes[axes.index(axis)])
    return coords
